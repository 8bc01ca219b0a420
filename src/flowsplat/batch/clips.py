"""The clips of a batch: from files, folders of clips and lists; each with a name that stays."""

from __future__ import annotations

import hashlib
import json
import os
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin

import msgspec

from flowsplat.common.errors import InputError
from flowsplat.common.files import plain_name, read_json_lines, read_rows, read_text
from flowsplat.common.files.json_file import Text
from flowsplat.common.run_paths import RunPaths
from flowsplat.common.settings import list_setting_types, with_settings
from flowsplat.pipeline.config import RunConfig, check, find_setting
from flowsplat.pipeline.renamed_options import find_renamed_option
from flowsplat.scenes.formats.video import VIDEO_SUFFIXES
from flowsplat.scenes.ingest import kind_of_input

LISTS = (".txt", ".csv", ".tsv", ".jsonl", ".ndjson")
MAX_CLIPS = 1_000_000
"""Clips of one batch, at most: a list with more is a slip. A round number."""
MAX_FOLDER_DEPTH = 6
"""Folders within each other in which clips are looked for. Chosen by eye."""
MAX_NAME_CHARACTERS = 80
"""Characters of the readable part of an id. Chosen by eye."""
_TAKEN = ("batch.json", "index.html")
"""Names in OUT that no run can have."""
_ROW = dict[Annotated[str, msgspec.Meta(max_length=200)], Text | float | bool | list[Text | float] | None]


@dataclass(frozen=True)
class BatchClip:
    """One clip of a batch.

    Attributes:
        id: of its folder in OUT.
        path: of the input; absolute.
        config: all settings of its run.
    """

    id: str
    path: Path
    config: RunConfig


def find_clips(inputs: Sequence[Path], config: RunConfig, out: Path) -> list[BatchClip]:
    """Return the clips that inputs name, in their order; a clip that is named twice in the same way is one.

    Args:
        inputs: clips (all that ``run`` takes), folders of them, and lists: ``.txt`` with a path on every line, ``.csv``, ``.tsv``
            and ``.jsonl`` with ``path``, perhaps ``id``, and options of ``run`` by their names. Paths in a list are relative to it.
        config: settings of all, as far as a list says no others.
        out: nothing in it is a clip.

    Raises:
        InputError: an input does not exist, a list is none, an option in it is wrong, an id is given twice, or there is no clip.
    """
    config.input.check()
    check(config)
    clips: dict[str, BatchClip] = {}
    for source in inputs:
        for clip in _of_input(Path(source), config, Path(os.path.abspath(out))):
            known = clips.setdefault(clip.id.casefold(), clip)  # some file systems do not tell A from a
            if known != clip:
                raise InputError(f"{known.path} and {clip.path} would both be called {clip.id}: give other ids in a list.")
        if len(clips) > MAX_CLIPS:
            raise InputError(f"{source}: more than {MAX_CLIPS:,} clips: make several batches of them.")
    if not clips:
        raise InputError("There is no clip in what was given: give videos, folders of frames, folders of these, or lists.")
    return list(clips.values())


def _of_input(source: Path, config: RunConfig, out: Path) -> Iterator[BatchClip]:
    if source.suffix.lower() in LISTS and not source.is_dir():
        for where, row in _rows(source):
            yield _read_listed_clip(where, row, source.parent, config)
    elif source.is_dir() and _is_folder_of_clips(source):
        for path in _within(source, out):
            yield _clip(path, config)
    elif not source.exists():
        raise InputError(f"{source} does not exist.")
    else:
        yield _clip(source, config)


def _is_folder_of_clips(folder: Path) -> bool:
    if any(path.suffix.lower() in VIDEO_SUFFIXES and path.is_file() for path in folder.iterdir()):
        return True
    try:
        kind_of_input(folder)
    except InputError:
        return True
    return False


def _within(folder: Path, out: Path, depth: int = 0) -> Iterator[Path]:
    """Yield the clips in a folder, by name; what is hidden, or a run, is none."""
    for path in sorted(folder.iterdir()):
        if path.name.startswith(".") or Path(os.path.abspath(path)) == out or RunPaths(path).holds_run:
            continue
        if path.is_file():
            if path.suffix.lower() in VIDEO_SUFFIXES:
                yield path
        elif path.is_dir() and not (path.is_symlink() and depth):
            if not _is_folder_of_clips(path):
                yield path
            elif depth < MAX_FOLDER_DEPTH:
                yield from _within(path, out, depth + 1)


# -- lists


def _rows(source: Path) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield what a list says of each clip, and where it stands."""
    kind = source.suffix.lower()
    if kind == ".txt":
        for number, line in enumerate(read_text(source).splitlines(), 1):
            if line.strip() and not line.lstrip().startswith("#"):
                yield f"{source}, line {number}", {"path": line.strip()}
    elif kind in (".csv", ".tsv"):
        for number, row in read_rows(source):
            yield f"{source}, line {number}", {name: cell for name, cell in row.items() if cell}
    else:
        for number, value in read_json_lines(source, _ROW, 64 * 2**20):
            yield f"{source}, line {number}", value


def _read_listed_clip(where: str, row: Mapping[str, Any], folder: Path, config: RunConfig) -> BatchClip:
    """Return the clip of one row of a list."""
    path, name = row.get("path"), row.get("id")
    if not isinstance(path, str) or not path or "\0" in path:
        raise InputError(f"{where}: there is no path in it.")
    if name is not None:
        name = plain_name(name, f"{where}: the id")
        if name.lower() in _TAKEN:
            raise InputError(f"{where}: {name} is the name of another file in OUT: give another id.")
    types, changes = list_setting_types(RunConfig), {}
    for column, value in row.items():
        if column in ("path", "id"):
            continue
        setting = find_setting(column)
        if setting is None:
            now = find_renamed_option(column)
            why = f"is called {now} now" if now else "is no option of run: see flowsplat run --help-all"
            raise InputError(f"{where}: {column!r:.60} {why}.")
        try:
            changes[setting] = _value(value, types[setting], folder)
        except (msgspec.ValidationError, ValueError) as error:
            raise InputError(f"{where}: {column} cannot be {value!r:.60}.") from error
    try:
        own = with_settings(config, changes)
        own.input.check()
        check(own)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
    return _clip(folder / path, own, name)


def _value(value: Any, hint: Any, folder: Path) -> Any:
    """Return a value of a list as JSON holds the setting: texts of tables are read as what the setting is, files lie beside the
    list."""
    if isinstance(value, str):
        if value.lower() == "none" and type(None) in get_args(hint):
            return None
        if hint is Path or Path in get_args(hint):
            return str(folder / value)
        if get_origin(hint) is tuple:
            value = [part.strip() for part in value.split(";") if part.strip()]
    return msgspec.to_builtins(msgspec.convert(value, hint, strict=False))


# -- names


def _clip(path: Path, config: RunConfig, name: str | None = None) -> BatchClip:
    path = Path(os.path.abspath(path))
    return BatchClip(name or id_of(path, config), path, config)


def id_of(path: Path, config: RunConfig) -> str:
    """Return the name of a clip: its file's, and six digits of a hash of where it lies and what is taken from it.

    It depends on nothing else, so that a clip keeps its run when others come and go, and when its priors or its training change.

    >>> id_of(Path("/trip/day 1/IMG 0001.MOV"), RunConfig())
    'IMG-0001-...'
    """
    text = json.dumps([os.fsencode(path).hex(), msgspec.to_builtins(config.input)], sort_keys=True)
    digest = hashlib.sha256(text.encode()).hexdigest()[:6]
    stem = path.stem if path.suffix.lower() in VIDEO_SUFFIXES else path.name
    kept = "".join(c if c.isalnum() or c in "_-" else "-" for c in unicodedata.normalize("NFC", stem))
    readable = "-".join(part for part in kept.split("-") if part)
    while len(readable) > MAX_NAME_CHARACTERS or len(readable.encode(errors="replace")) > MAX_NAME_CHARACTERS:
        readable = readable[:-1]
    return f"{readable}-{digest}" if readable else f"clip-{digest}"


def of_shard(ids: Sequence[str], shard: str | None, environment: Mapping[str, str]) -> set[str]:
    """Return the ids that are this process's: all, or part ``i/n`` (1/n to n/n) by a hash of each, so that others move none.

    Args:
        shard: None = the task of a SLURM array that this process is, if it is one.

    Raises:
        InputError: it is no part.
    """
    if shard is not None:
        first, _, second = shard.partition("/")
        if not (first.isdecimal() and second.isdecimal() and 1 <= int(first[:9]) <= int(second[:9])):
            raise InputError(f"--shard {shard} is no part: give i/n, from 1/n to n/n, for example 2/8.")
        part, parts = int(first) - 1, int(second)
    elif "SLURM_ARRAY_TASK_ID" in environment:
        try:
            task, least, step, parts = (
                int(environment.get(f"SLURM_ARRAY_TASK_{name}", default))
                for name, default in (("ID", ""), ("MIN", "0"), ("STEP", "1"), ("COUNT", "1"))
            )
            part = (task - least) // step
        except (ValueError, ZeroDivisionError) as error:
            raise InputError("The variables SLURM_ARRAY_TASK_* are no numbers: give --shard i/n.") from error
        if not 0 <= part < parts:
            raise InputError(f"SLURM_ARRAY_TASK_ID {task} is none of the {parts} tasks from {least} on: give --shard i/n.")
    else:
        return set(ids)
    return {name for name in ids if int(hashlib.sha256(name.encode()).hexdigest()[:12], 16) % parts == part}
