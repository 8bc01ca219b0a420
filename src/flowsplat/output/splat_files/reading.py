"""Read static Gaussians from the one of three formats that a file is called after."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from flowsplat.common.errors import InputError, first_line
from flowsplat.common.progress import report
from flowsplat.output.splat_files.ply import read_ply
from flowsplat.output.splat_files.splat import read_splat
from flowsplat.output.splat_files.splats import Splats
from flowsplat.output.splat_files.spz import read_spz

_READERS: dict[str, Callable[[Path], Splats]] = {".ply": read_ply, ".splat": read_splat, ".spz": read_spz}
SUFFIXES = tuple(_READERS)
"""By which such files are known."""


def is_splat_file(path: Path) -> bool:
    """Return whether a file is called as one of them; a folder is none."""
    return Path(path).suffix.lower() in _READERS and not Path(path).is_dir()


def read_splats(path: str | Path) -> Splats:
    """Read a file of static 3D Gaussians.

    Args:
        path: of a ``.ply``, ``.splat`` or ``.spz``.

    Returns:
        all that can be drawn; how many cannot, because a value is not finite or beyond what float32 squares, or because their
        rotation is none, is reported.

    Raises:
        InputError: it is missing, damaged or truncated, too large, of another kind, or holds nothing that can be drawn.
    """
    path = Path(path)
    if path.suffix.lower() not in _READERS:
        raise InputError(f"{path} is none of {', '.join(SUFFIXES)}: only these files of 3D Gaussians can be read.")
    try:
        found = _READERS[path.suffix.lower()](path)
    except MemoryError as error:
        raise InputError(f"There is not enough memory to read {path}.") from error
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or first_line(error)}.") from error
    usable = found.keep_usable()
    if len(usable) == 0:
        raise InputError(f"{path} holds no Gaussian that can be drawn.")
    report_left_out(path.name, len(found) - len(usable), len(found))
    return usable


def report_left_out(name: str, left_out: int, count: int) -> None:
    """Say how many Gaussians of a file cannot be drawn, if there are some."""
    if left_out:
        reason = "a value is not finite or too large, or their rotation is none"
        report(f"{name}: {left_out:,} of {count:,} Gaussians are left out: {reason}.")
