"""Data roots: folders with scenes that go by their names."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from pathlib import Path

from flowsplat.common.errors import InputError


def open_root(root: Path, holds: str) -> Path:
    """Return the root as a path.

    Raises:
        InputError: it is no folder; ``holds`` says what it should hold.
    """
    root = Path(root)
    if not root.is_dir():
        raise InputError(f"{root} is no folder: give the data root, which holds {holds}.")
    return root


def require_scenes(root: Path, names: Iterable[str], known: Collection[str]) -> None:
    """Refuse a name that no scene has.

    Raises:
        InputError: tells the names that there are.
    """
    for name in names:
        if name not in known:
            raise InputError(f"{root} has no scene {name!r}: choose from {', '.join(known)}.")
