"""Arguments that several commands have, and what is read of a command line before it is parsed: defaults depend on it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import tyro

Preset = Literal["fast", "default", "paper", "high"]
# Everywhere, -o or --out is where to write, and RUN is the folder that --out of run or prepare named.
Source = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="INPUT")]
Run = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
Out = Annotated[Path, tyro.conf.arg(aliases=("-o",), metavar="OUT")]
OutOfClip = Annotated[Path | None, tyro.conf.arg(aliases=("-o",), metavar="OUT")]
"""``Out`` of commands that choose one themselves: ``choose_out``."""
Target = Annotated[Path | None, tyro.conf.arg(name="out", aliases=("-o", "--path"), metavar="OUT")]
NO_PREFIX = tyro.conf.arg(name="")
"""Annotation of options in a dataclass: their names do not begin with that of the argument."""


def choose_out(source: Path, sequence: str | None = None) -> Path:
    """Return the folder of the run of a clip where none is named: ``out/NAME``, by the name of the clip.

    Args:
        source: file or folder that is read.
        sequence: which of its clips, where the folder holds several.

    Examples:
        >>> choose_out(Path("films/clip.mp4")).as_posix(), choose_out(Path("DAVIS"), "bear").as_posix()
        ('out/clip', 'out/bear')
    """
    folder = source.resolve()
    name = Path(sequence).name if sequence else (folder.name if source.is_dir() else folder.stem)
    return Path("out") / (name.strip(". ") or "clip")


def value_of(arguments: Sequence[str], option: str) -> str | None:
    """Return what follows an option, behind a space or =; None where it is not among them."""
    for k, argument in enumerate(arguments):
        if argument == option and k + 1 < len(arguments):
            return arguments[k + 1]
        if argument.startswith(option + "="):
            return argument[len(option) + 1 :]
    return None
