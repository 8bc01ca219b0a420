"""What became of a cell, as a file: its figures, or why it failed, with the commit and the machine."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta
from typing_extensions import NotRequired, TypedDict

from flowsplat.common.errors import InputError
from flowsplat.common.files import check_json, read_json, write_json
from flowsplat.common.files.json_file import Count, Text
from flowsplat.common.source import source_state
from flowsplat_benchmarks.scripts.cpu_parts import machine as this_machine

RECORD_VERSION = 1
WITH_CHANGES = " with changes"
"""What stands behind a commit where the source has more."""
Name = Annotated[str, Meta(min_length=1, max_length=150)]
Seconds = Annotated[float, Meta(ge=0, le=1e11)]


class RecordFile(TypedDict):
    """A cell, as its file has it."""

    version: Count
    benchmark: Name
    scene: Name
    variant: Text
    seed: Count
    commit: Name
    machine: Name
    threads: Count | None
    seconds: Seconds | None
    failure: Text | None
    result: dict[str, Any]
    ended: NotRequired[Seconds | None]


@dataclass(frozen=True)
class Record:
    """A cell that was done, or that failed.

    Attributes:
        benchmark: which.
        scene: its clip, scene or world.
        variant: what else tells it from others of that benchmark.
        seed: of every random choice.
        commit: that last changed ``src``; ``with changes`` behind it where there were more.
        machine: on which, in words.
        threads: of the process; None = not known.
        seconds: by the clock, with all that it needed; None = not known.
        failure: why it failed, in a line; None = it did not.
        result: what the benchmark measured; empty where it failed.
        ended: when, in seconds since 1970; None = before those that say it.
        version: of the file.
    """

    benchmark: str
    scene: str
    variant: str
    seed: int
    commit: str
    machine: str
    threads: int | None = None
    seconds: float | None = None
    failure: str | None = None
    result: Mapping[str, Any] | None = None
    ended: float | None = None
    version: int = RECORD_VERSION

    def to_json(self) -> dict[str, Any]:
        """Return what its file holds."""
        return {**asdict(self), "result": dict(self.result or {})}

    def replaces(self, other: Record) -> bool:
        """Return whether this is to be kept in the place of another of the same cell: a newer one, and at one commit no failure in
        the place of figures."""
        if other.commit == self.commit and self.failure is not None and other.failure is None:
            return False
        return (self.ended or 0.0) >= (other.ended or 0.0)


def read_records(folder: Path) -> list[Record]:
    """Return the records of a folder, the newest last. Of those that do not say when they ended, which were measured before all
    others, the records of lists come first, then those with a file of their own.

    Raises:
        InputError: a file is damaged, or of another version.
    """
    lists: list[Record] = []
    single: list[Record] = []
    for path in sorted(folder.glob("[!.]*.json")):
        values = read_json(path)
        if isinstance(values, list):
            lists += [_check(path, value) for value in values]
        else:
            single.append(_check(path, values))
    return sorted(lists + single, key=lambda record: record.ended or 0.0)


def read_record(path: Path) -> Record:
    """Return the record of a file.

    Raises:
        InputError: it is damaged, or of another version.
    """
    return _check(path, read_json(path))


def write_record(path: Path, record: Record) -> None:
    """Write a record atomically.

    Raises:
        InputError: it cannot be written.
    """
    write_json(path, record.to_json())


def _check(path: Path, value: Any) -> Record:
    known = RecordFile.__annotations__
    check_json(path, value, RecordFile)
    if value["version"] != RECORD_VERSION:
        raise InputError(f"{path} is of version {value['version']}, and this flowsplat reads version {RECORD_VERSION}.")
    return Record(**{name: value[name] for name in known if name in value})


@cache
def describe_commit() -> str:
    """Return the commit that last changed ``src``, short; ``with changes`` behind it where there are more. Without git the state of
    the source."""
    folder = Path(__file__).parents[2]
    words = ["git", "-C", str(folder)]
    try:
        said = [
            subprocess.run([*words, *more], capture_output=True, text=True, check=True).stdout.strip()
            for more in (
                ("log", "-1", "--first-parent", "--format=%h", "--abbrev=7", "--", "."),
                ("status", "--porcelain", "--", "."),
            )
        ]
    except (OSError, subprocess.CalledProcessError):
        return source_state()
    commit, changes = said
    return (commit or source_state()) + (WITH_CHANGES if changes else "")


def describe_machine() -> str:
    """Return cores, processor and memory, in words."""
    facts = this_machine.describe()
    memory = f", {facts['memory_gib']:.0f} GiB" if facts["memory_gib"] else ""
    return f"{os.cpu_count()} cores of {facts['processor']} with {facts['instructions']}{memory}, {facts['system']}"
