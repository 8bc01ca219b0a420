"""A clip of the studio and what became of it: a folder, which is all that is known of it.

clip/NAME      the clip as it came
studio.json    what was chosen, and what is being done
run/           the folder of its run, as ``flowsplat run`` makes it; of a clip with cuts those of its shots are in it
run.log        what its processes said
poster.jpg     an image of it
downloads/     exports that are folders, packed
"""

from __future__ import annotations

import re
import secrets
import shutil
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from msgspec import Meta
from typing_extensions import NotRequired, TypedDict

from flowsplat.common.errors import InputError
from flowsplat.common.files import make_folder, plain_name, read_json, write_json
from flowsplat.common.files.json_file import Text, Versioned
from flowsplat.common.run_paths import RunPaths
from flowsplat.pipeline.shot_list import Shot, read_shots
from flowsplat.studio.choices import Choices, first_choices

VERSION = 1
RECORD = "studio.json"
ID = re.compile(r"[a-z0-9](?:[a-z0-9-]{0,60}[a-z0-9])?")
"""Names of projects: they are folders, and parts of addresses."""
MAX_ID_WORD_LENGTH = 30
"""Characters of the name of a clip that come into that of its project. Chosen by eye."""

Number = Annotated[float, Meta(ge=-1e12, le=1e12)]


class TaskFile(TypedDict):
    """A process that works on a project."""

    what: Text
    process: Annotated[int, Meta(ge=1)]
    begun: Text
    since: Number
    stopping: bool
    times: NotRequired[list[dict[str, Number]]]


class EndFile(TypedDict):
    """How the last process ended: ``done``, ``stopped`` or ``failed``."""

    what: Text
    state: Text
    message: Text


class ProjectFile(TypedDict):
    """What ``studio.json`` holds; more may stand there."""

    version: int
    name: Text
    made: Number
    choices: Choices
    ran: NotRequired[Choices | None]
    waiting: list[Text]
    asked: NotRequired[Number]
    times: NotRequired[list[dict[str, Number]]]
    task: NotRequired[TaskFile | None]
    end: NotRequired[EndFile | None]


class SceneRun(NamedTuple):
    """The run of a scene: of the whole clip, or of one of its shots.

    Attributes:
        name: of the shot, as its folder has it; empty for the whole clip.
        title: what the page calls the shot; empty likewise.
        number: of the shot, from 1; 0 likewise.
        run: where it is, or will be.
    """

    name: str
    title: str
    number: int
    run: RunPaths


class Project:
    """One clip. Only the server that has the lease of the studio's folder may write it, in one thread.

    Attributes:
        folder: where it lies.
        record: what ``studio.json`` holds.
    """

    def __init__(self, folder: Path):
        """Open one.

        Raises:
            InputError: it is none, or is damaged.
        """
        self.folder = Path(folder)
        path = self.folder / RECORD
        version = read_json(path, Versioned)["version"]
        if version != VERSION:
            raise InputError(f"{path} is of another version of flowsplat ({version}).")
        self.record: Any = read_json(path, ProjectFile)
        plain_name(self.record["name"], f"{path}: the clip's name")
        for choices in (self.record["choices"], self.record.get("ran")):
            if choices is not None:  # before there was a choice every clip became one scene
                choices.setdefault("shots", "off")

    @staticmethod
    def create(studio: Path, name: str, received: Path) -> Project:
        """Make one of a clip that was received: the file is moved into it.

        Args:
            studio: folder of the studio.
            name: of the clip's file, a plain name.
            received: the file.
        """
        folder = make_folder(studio / _new_id(studio, name))
        try:
            place = make_folder(folder / "clip") / name
            received.rename(place)
            return _write_new(folder, name, first_choices())
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise

    def copy(self) -> Project:
        """Return another one of the same clip with the same choices, of which nothing was done yet."""
        folder = make_folder(self.folder.parent / _new_id(self.folder.parent, self.name))
        try:
            place = make_folder(folder / "clip") / self.name
            try:
                place.hardlink_to(self.clip)
            except OSError:
                shutil.copyfile(self.clip, place)
            if self.poster.exists():
                shutil.copyfile(self.poster, folder / self.poster.name)
            return _write_new(folder, self.name, self.choices)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise

    def save(self) -> None:
        """Write the record.

        Raises:
            InputError: it cannot be written, or the folder was deleted: it is not made again.
        """
        if not self.folder.is_dir():
            raise InputError(f"The folder of {self.name} was deleted.")
        write_json(self.folder / RECORD, self.record)

    @property
    def id(self) -> str:
        """Its name in addresses."""
        return self.folder.name

    @property
    def name(self) -> str:
        """Name of the clip's file."""
        return str(self.record["name"])

    @property
    def clip(self) -> Path:
        """The clip's file."""
        return self.folder / "clip" / self.name

    @property
    def choices(self) -> Choices:
        """What is chosen."""
        found: Choices = self.record["choices"]
        return found

    @property
    def run(self) -> RunPaths:
        """Where its run is, or will be, or those of all shots."""
        return RunPaths(self.folder / "run")

    @property
    def shots(self) -> list[Shot] | None:
        """The shots whose runs there are, or will be; None where the clip is one scene, or nothing was begun."""
        with suppress(InputError):
            listed = read_shots(self.run.path)
            return None if listed is None else listed.shots
        return None

    @property
    def scenes(self) -> list[SceneRun]:
        """The run of each scene that it is, or will be."""
        shots = self.shots
        if shots is None:
            return [SceneRun("", "", 0, self.run)]
        return [
            SceneRun(shot.path.name, f"Shot {shot.number}, {shot.start:.2f} to {shot.end:.2f} s", shot.number, RunPaths(shot.path))
            for shot in shots
        ]

    def scene(self, name: str) -> SceneRun:
        """Return the scene of a shot, or that of the whole clip.

        Raises:
            InputError: there is none of this name.
        """
        for each in self.scenes:
            if each.name == name:
                return each
        raise InputError("There is no such shot." if name else "Say which shot is meant.")

    @property
    def log(self) -> Path:
        """What its processes said."""
        return self.folder / "run.log"

    @property
    def poster(self) -> Path:
        """An image of it."""
        return self.folder / "poster.jpg"

    @property
    def waiting(self) -> list[str]:
        """What is to be done with it, in order: ``run``, ``export FORMAT`` or ``render VIDEO``, perhaps with a shot."""
        found: list[str] = self.record["waiting"]
        return found

    @property
    def task(self) -> TaskFile | None:
        """The process that works on it."""
        return self.record.get("task")

    @property
    def end(self) -> EndFile | None:
        """How the last one ended."""
        return self.record.get("end")

    @property
    def is_cut_fixed(self) -> bool:
        """Whether a run was begun, whose folder belongs to one cut and one size of frames."""
        return self.run.holds_run


def list_projects(studio: Path) -> Iterator[Project]:
    """Yield all of a studio that can be read."""
    for folder in sorted(studio.iterdir()):
        if ID.fullmatch(folder.name) and not folder.is_symlink() and (folder / RECORD).is_file():
            try:
                yield Project(folder)
            except InputError:
                continue


def _write_new(folder: Path, name: str, choices: Choices) -> Project:
    write_json(
        folder / RECORD,
        {
            "version": VERSION, "name": name, "made": time.time(), "choices": choices, "ran": None,
            "waiting": [], "task": None, "end": None,
        },
    )  # fmt: skip
    return Project(folder)


def _new_id(studio: Path, name: str) -> str:
    word = re.sub(r"[^a-z0-9]+", "-", Path(name).stem.lower()).strip("-")[:MAX_ID_WORD_LENGTH].strip("-")
    while True:
        found = f"{word}-{secrets.token_hex(2)}" if word else f"clip-{secrets.token_hex(2)}"
        if not (studio / found).exists():
            return found
