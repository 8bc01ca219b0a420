"""Start, stop and find the processes that do the work: ``flowsplat run``, ``export`` and ``render`` as anybody would type them.

Each has a session of its own and writes into the project's log, so it goes on without the server. One that is started later finds
it by its number and the time at which the system says that it began.
"""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

from flowsplat.common.errors import InputError
from flowsplat.common.files import ordinary_file
from flowsplat.common.process_control import ask_to_stop, group_options, kill_group, read_start_time
from flowsplat.common.progress import LINES_VARIABLE
from flowsplat.output.export.formats import EXPORTERS
from flowsplat.studio.choices import list_arguments
from flowsplat.studio.project import EndFile, Project, TaskFile
from flowsplat.studio.standing import read_last_lines

LINE_SECONDS = 2
"""Seconds between two lines of a process on how far it is. Chosen by eye."""
KILL_SECONDS = 10.0
"""Seconds in which a process that is killed has to be gone: one that waits for a disk of the network may take long."""

PROGRAM = (sys.executable, "-m", "flowsplat.cli")
"""What ``flowsplat`` is on a command line."""


class Rendering(NamedTuple):
    """A video that the page offers besides those of every run.

    Attributes:
        title: what it is called.
        says: a sentence on it.
        options: of ``flowsplat render``.
    """

    title: str
    says: str
    options: tuple[str, ...]


RENDERINGS = {
    "background": Rendering(
        "The video without what moves", "What lies behind it is filled in where the video never shows it.",
        ("--render.paths", "input", "--render.parts", "background"),
    ),
    "objects": Rendering(
        "What moves alone", "On transparent, to lay over another video (WebM).",
        ("--render.paths", "input", "--render.parts", "objects"),
    ),
}  # fmt: skip

_INTERRUPTED = {
    130, 128 + signal.SIGTERM, -signal.SIGTERM, -signal.SIGINT,
    *((128 + getattr(signal, "SIGBREAK", 0), int(signal.SIGTERM)) if sys.platform == "win32" else ()),
}  # fmt: skip
"""Exit codes of a process that was asked to stop."""
_CUT_OFF = "It was cut off before it was done: was the computer switched off? Go on, and it continues where it was."


def list_words(project: Project, what: str, run_options: Sequence[str] = ()) -> list[str]:
    """Return the words of the command line, from ``flowsplat`` on.

    Args:
        what: ``run``, ``export FORMAT``, or ``render`` with one of ``RENDERINGS``; behind the last two the name of a shot, where
            they are of one.

    Raises:
        InputError: there is no such format, no such video, or no such shot.
    """
    if what == "run":
        shots = ["--shots", "off"] if project.choices.get("shots") == "off" else []
        places = [str(project.clip), "-o", str(project.run.path), *shots]
        return ["flowsplat", "run", *places, *list_arguments(project.choices, run_options)]
    kind, name, *shot = what.split(" ")
    run = project.scene(shot[0]).run if shot else project.run
    if kind == "render":
        if name not in RENDERINGS:
            raise InputError(f"There is no video {name}.")
        return ["flowsplat", "render", str(run.path), *RENDERINGS[name].options]
    return ["flowsplat", "export", str(run.path), "--to", EXPORTERS.entry(name).name]


def command_line(project: Project, what: str, run_options: Sequence[str] = ()) -> str:
    """Return the same as it is typed."""
    return shlex.join(list_words(project, what, run_options))


class Tasks:
    """The processes that this server has started, and those that it finds."""

    def __init__(self, run_options: Sequence[str] = ()):
        """``run_options``: what every run gets besides what is chosen on the page."""
        self._run_options = tuple(run_options)
        self._ours: dict[int, subprocess.Popen[bytes]] = {}

    def start(self, project: Project, what: str, times: Sequence[dict[str, float]] = ()) -> None:
        """Begin something with a project; its record says so from then on.

        Args:
            times: expected seconds of each stage, of each scene.

        Raises:
            InputError: the system starts no process, or the log cannot be written.
        """
        words = list_words(project, what, self._run_options)
        if os.path.lexists(project.log):
            ordinary_file(project.log)
        try:
            with project.log.open("ab") as log:
                log.write(f"$ {shlex.join(words)}\n".encode())
                log.flush()
                process = subprocess.Popen(
                    [*PROGRAM, *words[1:]], stdin=subprocess.DEVNULL, stdout=log, stderr=log,
                    **group_options(), env={**os.environ, LINES_VARIABLE: str(LINE_SECONDS), "COLUMNS": "200"},
                )  # fmt: skip
        except OSError as error:
            raise InputError(f"No process can be started: {error.strerror or error}.") from error
        self._ours[process.pid] = process
        project.record["task"] = {
            "what": what, "process": process.pid, "begun": read_start_time(process.pid) or "", "since": time.time(),
            "stopping": False, "times": list(times),
        }  # fmt: skip
        project.record["end"] = None
        if what == "run":
            project.record["ran"] = project.choices
        try:
            project.save()
        except InputError:  # a later server would not find it
            self.kill(project)
            project.record["task"] = None
            raise

    def is_alive(self, task: TaskFile) -> bool:
        """Return whether a process still works."""
        ours = self._ours.get(task["process"])
        if ours is not None and ours.poll() is not None:
            return False
        return read_start_time(task["process"]) == task["begun"]

    def stop(self, project: Project) -> None:
        """Ask the process of a project to stop: it finishes its step, and keeps what it has."""
        task = project.task
        if task is None or not self.is_alive(task):
            return
        task["stopping"] = True
        ask_to_stop(task["process"])
        project.save()

    def kill(self, project: Project) -> Callable[[], bool]:
        """End it at once, with all that it has started; returns what tells whether it has ended."""
        task = project.task
        if task is None or not self.is_alive(task):
            return lambda: True
        kill_group(task["process"])
        return lambda: not self.is_alive(task)

    def end(self, project: Project) -> EndFile | None:
        """Note how the process of a project ended, once it has; None while it works, or where there is none."""
        task = project.task
        if task is None or self.is_alive(task):
            return None
        ours = self._ours.pop(task["process"], None)
        code = None if ours is None else ours.returncode
        project.record["task"] = None
        project.record["end"] = found = _judge(project, task, code)
        project.save()
        return found


def _judge(project: Project, task: TaskFile, code: int | None) -> EndFile:
    """Return how a process ended, by its exit code, or by what it said last where another server has started it."""
    what, lines = task["what"], read_last_lines(project.log)
    if code == 0 or (code is None and _says_done(project, what, lines)):
        return {"what": what, "state": "done", "message": ""}
    last = lines[-1] if lines else ""
    if last.startswith("Error: "):
        return {"what": what, "state": "failed", "message": last.removeprefix("Error: ")}
    if task["stopping"] or code in _INTERRUPTED or last.startswith("Stopped."):
        return {"what": what, "state": "stopped", "message": ""}
    if code is None or code < 0:
        return {"what": what, "state": "failed", "message": _CUT_OFF}
    return {"what": what, "state": "failed", "message": f"It ended unexpectedly: {last or 'it said nothing'} (exit code {code})."}


def _says_done(project: Project, what: str, lines: Sequence[str]) -> bool:
    if what == "run":  # pipeline.summary.next_steps, the last that a whole run says
        return any(line.endswith(str(project.run.report_path)) for line in lines[-4:])
    return any(line.startswith(("Written: ", "Videos: ")) for line in lines[-2:])
