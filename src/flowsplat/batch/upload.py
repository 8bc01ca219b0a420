"""Runs that are done, copied to where fsspec leads (https://filesystem-spec.readthedocs.io): a bucket, or another folder."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

from flowsplat.common.errors import InputError, describe_install, first_line
from flowsplat.common.progress import report

MANIFEST = "manifest.json"
_BLOCK_BYTES = 2**20
"""Bytes that are read at a time: 1 MiB, a round number."""


def open_url(url: str) -> tuple[Any, str]:
    """Return the file system of a URL, and the place in it.

    Raises:
        InputError: fsspec, or the package for such URLs, is not installed; or it is no such URL.
    """
    try:
        from fsspec.core import url_to_fs
    except ImportError as error:
        raise InputError(f"--upload needs fsspec: {describe_install('upload')}.") from error
    try:
        system, place = url_to_fs(url)
    except ImportError as error:
        raise InputError(f"--upload {url} needs another package: {first_line(error)}.") from error
    except (ValueError, OSError) as error:
        raise InputError(f"--upload {url} is no address that fsspec knows: {first_line(error)}.") from error
    return system, str(place).rstrip("/")


def upload(folder: Path, url: str) -> str:
    """Copy a folder to ``URL/<its name>``: its files first and ``manifest.json``, with size and SHA-256 of each, last.

    Where there is a manifest, all of it is there. Called again, it copies what differs from the manifest that is there.

    Returns:
        where it is.

    Raises:
        InputError: as ``open_url``.
    """
    system, root = open_url(url)
    target = f"{root}/{folder.name}"
    files = {path.relative_to(folder).as_posix(): path for path in sorted(folder.rglob("*")) if _counts(path, folder)}
    wanted = {name: {"size": path.stat().st_size, "sha256": _digest(path)} for name, path in files.items()}
    manifest, there = f"{target}/{MANIFEST}", {}
    if system.exists(manifest):
        try:
            there = dict(json.loads(system.cat_file(manifest))["files"])
        except (ValueError, KeyError, TypeError, RecursionError):
            there = {}
        if there == wanted:
            return f"{url.rstrip('/')}/{folder.name}"
        system.rm_file(manifest)
    for name, path in files.items():
        if there.get(name) != wanted[name]:
            system.makedirs(f"{target}/{name}".rpartition("/")[0], exist_ok=True)
            system.put_file(os.fspath(path), f"{target}/{name}")
    for place in system.find(target):  # what lies there, not what the manifest names, which could lead anywhere
        if place.startswith(f"{target}/") and place.removeprefix(f"{target}/") not in wanted:
            system.rm_file(place)
    partial = f"{target}/.{MANIFEST}.partial"
    system.pipe_file(partial, json.dumps({"version": 1, "files": wanted}, indent=1).encode())
    system.mv(partial, manifest)
    report(f"Copied: {len(files)} files to {target}")
    return f"{url.rstrip('/')}/{folder.name}"


def _counts(path: Path, folder: Path) -> bool:
    hidden = any(part.startswith(".") for part in path.relative_to(folder).parts)
    return path.is_file() and not path.is_symlink() and not hidden and path != folder / MANIFEST


def _digest(path: Path) -> str:
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while block := file.read(_BLOCK_BYTES):
            digest.update(block)
    return digest.hexdigest()
