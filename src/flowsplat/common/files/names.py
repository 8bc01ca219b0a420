"""Names that come out of files, or from a browser, and are to become names of files."""

from __future__ import annotations

from flowsplat.common.errors import InputError

MAX_NAME_BYTES = 150
"""Bytes in UTF-8: file systems take 255, and suffixes and the name of a file in the making come to it."""


def plain_name(name: object, what: str = "a name") -> str:
    """``name``, where a file can be called so in any folder; ``what`` says in the error what it was to name.

    A plain name is text that is printable, neither empty nor a place (``.``, ``..``, anything with ``/`` or ``\\``), begins neither
    with a dot (such files are hidden or half-written) nor with a space, and has at most ``MAX_NAME_BYTES`` bytes.

    Raises:
        InputError: it is none.
    """
    if not isinstance(name, str) or not name:
        reason = "it is empty" if name == "" else "it is no text"
    elif not name.isprintable():
        reason = "it holds characters that cannot be shown"
    elif "/" in name or "\\" in name:
        reason = "it leads to another folder"
    elif name[0] in ". ":
        reason = "it begins with a dot or a space"
    elif len(name.encode()) > MAX_NAME_BYTES:
        reason = f"it is longer than {MAX_NAME_BYTES} bytes"
    else:
        return name
    raise InputError(f"{what} {name!r:.60} cannot name a file: {reason}.")
