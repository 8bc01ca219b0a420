"""All projects of a studio, and what is done with them: one run at a time, others wait for their turn."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from flowsplat.common.errors import InputError
from flowsplat.common.progress import report
from flowsplat.studio import results
from flowsplat.studio.choices import Choices, keep_marks
from flowsplat.studio.clips import Clips
from flowsplat.studio.project import RECORD, Project, list_projects
from flowsplat.studio.standing import StandingReader
from flowsplat.studio.tasks import RENDERINGS, Tasks
from flowsplat.studio.uploads import Uploads

SAME_MOMENT_SECONDS = 0.002
"""Two frames of two cuts that are as near are the same. Chosen by eye."""


class Studio:
    """The folder of a studio. One thread may use it; only ``clips`` may be asked by others."""

    def __init__(self, folder: Path, run_options: Sequence[str], max_bytes: int):
        """
        Args:
            folder: of which this process has the lease.
            run_options: what every run gets besides what is chosen.
            max_bytes: of a clip.
        """
        self.folder, self.run_options = folder, tuple(run_options)
        self.clips, self.tasks, self.uploads = Clips(), Tasks(run_options), Uploads(folder, max_bytes)
        self.projects = {project.id: project for project in list_projects(folder)}
        self._standings: dict[str, StandingReader] = {}

    def advance(self) -> None:
        """Note what has ended, begin what is due, and give up clips that no longer come. To be called again and again."""
        for project in list(self.projects.values()):
            if not project.folder.is_dir():  # somebody has deleted it
                self.remove(project)
                continue
            try:
                self._note_end(project)
            except InputError as error:
                report(f"{project.folder}: {error}")
        waiting = [project for project in self.projects.values() if project.waiting and project.task is None]
        for project in sorted(waiting, key=lambda each: float(each.record.get("asked") or 0)):
            what = project.waiting[0]
            if what == "run" and self.is_running:
                continue
            try:
                self._begin(project, what)
            except InputError as error:
                project.record["end"] = {"what": what, "state": "failed", "message": str(error)}
                with suppress(InputError):  # a full disk must not end the server
                    project.save()
        for upload in [upload for upload in self.uploads.under_way if upload.is_silent]:
            upload.close()

    @property
    def is_running(self) -> bool:
        """Whether a run works."""
        return any(project.task is not None and project.task["what"] == "run" for project in self.projects.values())

    def _note_end(self, project: Project) -> None:
        end = self.tasks.end(project)
        if end is not None and end["what"] == "run" and end["state"] == "done":
            self._ask(project, f"export {results.PAGE}")

    def _begin(self, project: Project, what: str) -> None:
        project.waiting.remove(what)
        if what == "run":
            results.forget_exports(project)
        self.tasks.start(project, what, project.record.get("times", []) if what == "run" else [])

    def _ask(self, project: Project, what: str) -> None:
        if what not in project.waiting:
            project.waiting.append(what)
        project.record["asked"] = time.time()
        project.save()

    # -- what the page asks for

    def project(self, name: str) -> Project:
        """Return a project.

        Raises:
            InputError: there is none of that name.
        """
        if name not in self.projects:
            raise InputError("There is no such scene (any more).")
        return self.projects[name]

    def summarize(self) -> list[dict[str, Any]]:
        """Return what the list shows, the newest first."""
        newest = sorted(self.projects.values(), key=lambda each: -float(each.record["made"]))
        return [results.summarize(project) for project in newest]

    def describe(self, project: Project) -> dict[str, Any]:
        """Return all that the page shows of a project."""
        reader = self._standings.setdefault(project.id, StandingReader())
        return results.describe(project, reader, self.run_options)

    def add(self, project: Project) -> None:
        """A new one is there."""
        self.projects[project.id] = project

    def choose(self, project: Project, choices: Choices) -> None:
        """Set what is chosen.

        Raises:
            InputError: a run was begun with another cut or another quality.
        """
        fixed = ("start", "end", "preset", "shots")
        if project.is_cut_fixed and any(choices.get(name) != project.choices.get(name) for name in fixed):
            raise InputError("The cut and the quality of a scene that was begun stay as they are: make another version of it.")
        before, project.record["choices"] = project.choices, choices
        try:
            project.save()
        except InputError:
            project.record["choices"] = before
            raise

    def fit_marks(self, project: Project, seconds: dict[int | str, float]) -> int:
        """Put the places that were clicked on the frames that the cut has now; how many are on none and had to go."""
        kept, lost = keep_marks(project.choices, seconds, SAME_MOMENT_SECONDS)
        if kept != project.choices:
            project.record["choices"] = kept
            project.save()
        return lost

    def ask_run(self, project: Project, times: list[dict[str, float]]) -> None:
        """Begin a run, or go on with it, as soon as no other works.

        Args:
            times: expected seconds of each stage, of each scene.
        """
        if project.task is not None and project.task["what"] == "run":
            return
        project.record["times"], project.record["end"] = times, None
        self._ask(project, "run")

    def ask_export(self, project: Project, to: str, shot: str = "") -> None:
        """Write a scene in a format.

        Args:
            shot: its name, where the clip has shots; the page that plays is of all of them.

        Raises:
            InputError: there is no such format, no such shot, or no scene yet.
        """
        entry = results.EXPORTERS.entry(to)
        if results.state_of(project) != "done":
            raise InputError("There is no finished scene yet.")
        of_all = entry.name == results.PAGE and not shot
        self._ask(project, f"export {entry.name}" if of_all else results.name_task(project.scene(shot), f"export {entry.name}"))

    def ask_render(self, project: Project, name: str, shot: str = "") -> None:
        """Render one of the videos of ``tasks.RENDERINGS``.

        Args:
            shot: the name of the shot, where the clip has some.

        Raises:
            InputError: there is no such video, or no scene yet.
        """
        if name not in RENDERINGS:
            raise InputError("There is no such video.")
        if results.state_of(project) != "done":
            raise InputError("There is no finished scene yet.")
        self._ask(project, results.name_task(project.scene(shot), f"render {name}"))

    def stop(self, project: Project) -> None:
        """Let a run stop, or wait no longer for its turn."""
        if "run" in project.waiting:
            project.waiting.remove("run")
            project.save()
        self.tasks.stop(project)

    def copy(self, project: Project) -> Project:
        """Return a new project of the same clip."""
        found = project.copy()
        self.add(found)
        return found

    def remove(self, project: Project) -> Callable[[], bool]:
        """Kill what works on a project and show it no longer.

        Returns:
            what tells whether it has ended: then its folder can be deleted (``delete``).
        """
        project.record["waiting"] = []
        ended = self.tasks.kill(project)
        self.clips.forget(project.clip)
        self.projects.pop(project.id)
        self._standings.pop(project.id, None)
        return ended


def delete(folder: Path) -> None:
    """Delete the folder of a project that was removed: its record goes first, so that half of one is none.

    Raises:
        InputError: it cannot be deleted.
    """
    try:
        (folder / RECORD).unlink(missing_ok=True)
        shutil.rmtree(folder)
    except OSError as error:
        raise InputError(f"{folder} cannot be deleted: {error.strerror or error}.") from error
