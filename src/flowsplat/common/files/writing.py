"""Files that are either whole or not there: everything is written to a temporary name and then renamed."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import re
import stat
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from flowsplat.common.errors import InputError, WritingError
from flowsplat.common.files.opening import ordinary_file
from flowsplat.common.process_control import is_running

_PARTIAL = re.compile(r"\..+\.([0-9]{1,9})\.partial(\.[^.]+)?")
_NO_TEXT = re.compile(r"[\ud800-\udfff]")
_HASHED_EDGE_BYTES = 65536
"""Bytes at both ends of a file that enter its hash. Chosen by eye."""


@contextlib.contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` that becomes ``path`` when the block ends without an error.

    The temporary name keeps the suffix, so that writers which choose a format by suffix work.

    Raises:
        InputError: the folder cannot be written, or the disk is full.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    _refuse_special(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise make_writing_error(error, path) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def _refuse_special(path: Path) -> None:
    """Devices and pipes would be replaced by a file, where one may; nobody wants that.

    Raises:
        InputError: there is one of that name, or no file can be called so.
    """
    if "\0" in str(path):
        raise InputError(f"{path} cannot be the name of a file.")
    with contextlib.suppress(OSError):
        kind = stat.S_IFMT(os.stat(path).st_mode)
        if kind not in (stat.S_IFREG, stat.S_IFDIR):
            raise InputError(f"{path} is no ordinary file and is left alone: choose another name.")


def remove_partials(folder: Path) -> list[Path]:
    """Delete what killed processes left half-written anywhere under ``folder``, see ``atomic_path``.

    Returns:
        what was deleted.
    """
    deleted = []
    for path in Path(folder).rglob(".*.partial*"):
        named = _PARTIAL.fullmatch(path.name)
        if named is None or _is_written(int(named[1])) or path.is_symlink() or not path.is_file():
            continue
        with contextlib.suppress(OSError):
            path.unlink()
            deleted.append(path)
    return deleted


def _is_written(process: int) -> bool:
    """Return whether another process of that number lives here: it may still be writing, an export, say."""
    return process != os.getpid() and is_running(process)


def make_writing_error(error: OSError, path: Path) -> WritingError:
    """Return what to tell about a file that cannot be written."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return WritingError(f"The disk is full: cannot write {path}. Free some space and run the same command again.")
    if error.errno == errno.EFBIG:
        return WritingError(f"Cannot write {path}: files may not be that large here (ulimit -f).")
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return WritingError(f"No permission to write {path}. Choose another output folder with -o.")
    return WritingError(f"Cannot write {path}: {error.strerror or error}.")


def make_folder(path: Path) -> Path:
    """Create a folder with its parents.

    Raises:
        InputError: it cannot be created, or a file of that name is in the way.
    """
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise WritingError(f"{path} is a file, not a folder. Choose another output folder with -o.") from error
    except OSError as error:
        raise make_writing_error(error, Path(path)) from error
    return Path(path)


def hash_files(start: str, files: Iterable[tuple[str, Path]], whole: bool = False) -> str:
    """Return a short hash of ``start`` and of named files: of their names, sizes and both ends.

    Args:
        whole: read all of every file, not only its ends.

    Raises:
        InputError: a file cannot be read.
    """
    digest = hashlib.sha256(start.encode())
    for name, file in files:
        size = ordinary_file(file)
        try:
            digest.update(b"\n" + os.fsencode(name) + f" {size} ".encode())
            with open(file, "rb") as opened:
                left = size if whole else _HASHED_EDGE_BYTES
                while left > 0 and (data := opened.read(min(left, _HASHED_EDGE_BYTES))):  # a whole one may be gigabytes
                    digest.update(data)
                    left -= len(data)
                opened.seek(max(size - _HASHED_EDGE_BYTES, 0))
                digest.update(opened.read(_HASHED_EDGE_BYTES))
        except OSError as error:
            raise InputError(f"{file} cannot be read: {error.strerror}.") from error
    return digest.hexdigest()[:16]


def write_bytes(path: Path, data: bytes) -> None:
    """Write ``data`` atomically."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: Path, text: str) -> None:
    """Write ``text`` atomically as UTF-8."""
    write_bytes(path, text.encode(errors="backslashreplace"))  # names of files may hold what is no text


def write_json(path: Path, value: Any) -> None:
    """Write indented JSON atomically; NumPy scalars and arrays become numbers and lists. NaN is refused.

    Bytes of a file's name that are no text (lone surrogates, as Python has them) are written out, ``\\udcff``: no reader of JSON
    would take them.
    """

    def plain(item: Any) -> Any:
        if isinstance(item, np.ndarray):
            return item.tolist()
        if isinstance(item, np.generic):
            return item.item()
        if isinstance(item, Path):
            return str(item)
        raise TypeError(f"cannot write {type(item).__name__} as JSON")

    text = json.dumps(value, indent=1, default=plain, allow_nan=False, ensure_ascii=False)
    write_text(path, _NO_TEXT.sub(lambda found: f"\\\\u{ord(found[0]):04x}", text) + "\n")


def as_written(name: str) -> str:
    """Return what ``read_json`` gives back of a name that ``write_json`` wrote: the same, but where bytes of it are no text."""
    return _NO_TEXT.sub(lambda found: f"\\u{ord(found[0]):04x}", name)


def require_keys(path: Path, value: Mapping[str, Any], *keys: str) -> None:
    """Refuse an object of a JSON file that lacks something.

    Raises:
        InputError: names the file and the first key that is not there.
    """
    for key in keys:
        if key not in value:
            raise InputError(f"{path} is damaged: it has no {key!r}.")


def write_npz(path: Path, arrays: Mapping[str, np.ndarray], *, compressed: bool = False) -> None:
    """Write arrays atomically to one ``.npz``."""
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        (np.savez_compressed if compressed else np.savez)(file, **arrays)  # type: ignore[arg-type]
