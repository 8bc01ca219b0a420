"""What the page is told of a project: how far it is, and what came of it."""

from __future__ import annotations

import re
import shutil
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from flowsplat.common.errors import InputError
from flowsplat.common.files import atomic_path, make_folder, read_json
from flowsplat.common.run_paths import RunPaths
from flowsplat.output.export.formats import EXPORTERS
from flowsplat.output.report import video_title
from flowsplat.output.videos import list_rendered
from flowsplat.output.videos.shown import order_videos
from flowsplat.pipeline.folder import MetricsFile
from flowsplat.scenes import Scene
from flowsplat.studio.choices import list_idle_marks, name_frame
from flowsplat.studio.project import Project, SceneRun
from flowsplat.studio.standing import SAYS, StandingReader, read_orbits
from flowsplat.studio.tasks import RENDERINGS, command_line

PAGE = "html"
"""The export that plays a scene."""
_PLACE = re.compile(r"(\d{1,5}),(\d{1,5})@(\d{1,5})")
_RUN = r"run/(?:shots/(?P<shot>[0-9]{2,5})/)?"
SERVED = re.compile(
    rf"poster\.jpg|downloads/[^/]+\.zip|clip/[^/]+|{_RUN}(?:(?:report|priors)\.html|preview\.png|"
    r"renders/[^/]+\.(?:mp4|gif|webm|mov|png)|coarse/renders/[^/]+\.mp4|export/[^/]+)"
)
"""Files of a project that the page may ask for."""


def state_of(project: Project) -> str:
    """Return ``draft``, ``waiting``, ``running``, ``stopping``, ``stopped``, ``failed`` or ``done``; exports do not count."""
    task, end = project.task, project.end
    if task is not None and task["what"] == "run":
        return "stopping" if task["stopping"] else "running"
    if "run" in project.waiting:
        return "waiting"
    if end is not None and end["what"] == "run":
        return end["state"]
    if _is_done(project):
        return "done"
    return "stopped" if project.run.holds_run else "draft"


def _is_done(project: Project) -> bool:
    return all(each.run.report_path.exists() for each in project.scenes)


def summarize(project: Project) -> dict[str, Any]:
    """Return what the list of all scenes shows of one."""
    return {
        "id": project.id, "name": project.name, "made": project.record["made"], "state": state_of(project),
        "preset": project.choices["preset"], "poster": _link(project, project.poster),
    }  # fmt: skip


def describe(project: Project, standings: StandingReader, run_options: Sequence[str]) -> dict[str, Any]:
    """Return all that the page shows of one."""
    task, end, state = project.task, project.end, state_of(project)
    found: dict[str, Any] = {
        **summarize(project), "choices": project.choices, "clip": _link(project, project.clip),
        "fixed": project.is_cut_fixed, "changed": project.is_cut_fixed and project.record.get("ran") != project.choices,
        "command": command_line(project, "run", run_options), "message": "", "standing": None, "preview": None,
        "making": None, "waiting": project.waiting, "idle": list_idle_marks(project.choices),
    }  # fmt: skip
    if end is not None and end["state"] == "failed":
        found["message"], found["failed"] = end["message"], end["what"]
    if task is not None and task["what"] == "run":
        scenes = project.scenes
        standing = standings.read([each.run for each in scenes], project.log, task["since"], task.get("times") or [])
        of_shot = f"Shot {standing.scene + 1} of {len(scenes)}: " if scenes[0].number else ""
        found["standing"] = {
            "says": of_shot + SAYS[standing.stage], "line": standing.line[:300], "share": standing.share,
            "left": standing.seconds_left, "late": standing.is_late,
        }  # fmt: skip
    elif task is not None:
        found["making"] = task["what"]
    if state in ("running", "stopping", "stopped", "failed"):
        previews = [each.run.preview_path for each in project.scenes if each.run.preview_path.is_file()]
        found["preview"] = _link(project, max(previews, key=_change_time)) if previews else None
    if _is_done(project):
        found["results"] = _describe_results(project)
    return found


def _change_time(path: Path) -> float:
    """Return when a file was changed, 0 where it is gone."""
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0


def _describe_results(project: Project) -> dict[str, Any]:
    page = project.run.path / "export" / EXPORTERS[PAGE].default_name
    orbits = read_orbits(project.log)
    return {
        "page": _link(project, page), "page_bytes": _size(page), "report": _link(project, project.run.report_path),
        "page_command": command_line(project, f"export {PAGE}"),
        "scenes": [
            {
                "shot": each.name, "title": each.title, "frame": _find_middle_frame(each),
                "report": _link(project, each.run.report_path), "priors": _link(project, each.run.priors_report_path),
                "renderings": list(_list_renderings(project, each)), "videos": list(_list_videos(project, each.run)),
                "exports": list(_list_exports(project, each)), "hints": list(_list_hints(each)),
                "orbit": _describe_orbits(found) if (found := orbits.get(each.number)) else None,
            }
            for each in project.scenes
        ],
    }  # fmt: skip


def name_task(scene: SceneRun, what: str) -> str:
    """Return what is asked of a scene (``export FORMAT``, ``render VIDEO``) with the shot that it is of."""
    return f"{what} {scene.name}".rstrip()


def _find_middle_frame(scene: SceneRun) -> int | str | None:
    """Return a frame to know a scene by; None where its scene cannot be read."""
    try:
        frames = Scene(scene.run.scene_path).train_frames
    except InputError:
        return None
    return name_frame(scene.number, frames[len(frames) // 2])


def _list_videos(project: Project, run: RunPaths) -> Iterator[dict[str, str | None]]:
    """Yield the videos as the report shows them, then those with flow and depth beside it."""
    try:
        files = list_rendered(run.renders_path)
    except InputError:
        return
    videos = order_videos(files)
    titles = {video.shown: video_title(video.name) for video in videos}
    titles |= {video.beside: f"{video_title(video.name)}, with flow and depth" for video in videos if video.beside is not None}
    for name, title in titles.items():
        link = _link(project, run.renders_path / files[name])
        if link is not None:
            yield {"title": title, "link": link, "file": files[name]}


def _list_renderings(project: Project, scene: SceneRun) -> Iterator[dict[str, str]]:
    """Yield the videos that can be made besides those that are there; they are of what moves, so none where nothing does."""
    try:
        moves = bool(read_json(scene.run.metrics_path, MetricsFile).get("objects"))
        files = list_rendered(scene.run.renders_path)
    except InputError:
        return
    for name, each in RENDERINGS.items():
        if moves and f"input_path_{name}" not in files:
            what = name_task(scene, f"render {name}")
            command = command_line(project, what)
            yield {"name": name, "what": what, "title": each.title, "says": each.says, "command": command}


def _list_exports(project: Project, scene: SceneRun) -> Iterator[dict[str, Any]]:
    for entry in EXPORTERS.entries():
        made = scene.run.path / "export" / entry.value.default_name
        pack = "/".join(["/pack", project.id, entry.name, *([scene.name] if scene.name else [])])
        link = pack if entry.value.is_folder and made.is_dir() else _link(project, made)
        what = name_task(scene, f"export {entry.name}")
        yield {
            "name": entry.name, "what": what, "title": entry.title, "says": entry.sentence,
            "link": link, "command": command_line(project, what),
        }  # fmt: skip


def _list_hints(scene: SceneRun) -> Iterator[dict[str, Any]]:
    """Yield the objects whose distance is a guess, with the place at which each most likely touches what is under it."""
    try:
        objects = read_json(scene.run.metrics_path, MetricsFile).get("objects", [])
        prepared = Scene(scene.run.scene_path)
    except InputError:
        return
    for each in objects:
        place = _PLACE.fullmatch(each.get("hint") or "")
        if place is None or each.get("small"):
            continue
        x, y, frame = map(int, place.groups())
        if frame in prepared.train_frames:
            yield {
                "number": each.get("number"), "frame": name_frame(scene.number, frame),
                "x": min((x + 0.5) / prepared.width, 1.0), "y": min((y + 0.5) / prepared.height, 1.0),
            }  # fmt: skip


def pack_folder(project: Project, to: str, shot: str = "") -> Path:
    """Return an export that is a folder as one file, packed anew where it has changed.

    Args:
        shot: its name, where the clip has some.

    Raises:
        InputError: it was not made yet, there is no such shot, or the file cannot be written.
    """
    exporter = EXPORTERS[to]
    folder = project.scene(shot).run.path / "export" / exporter.default_name
    if not exporter.is_folder or not folder.is_dir():
        raise InputError(f"{to} was not made yet.")
    files = sorted(path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    packed = make_folder(project.folder / "downloads") / f"{f'{shot}-' if shot else ''}{exporter.default_name}.zip"
    if packed.exists() and all(path.stat().st_mtime <= packed.stat().st_mtime for path in files):
        return packed
    with atomic_path(packed) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as opened:
        for path in files:
            opened.write(path, f"{exporter.default_name}/{path.relative_to(folder).as_posix()}")
    return packed


def forget_exports(project: Project) -> None:
    """Delete the exports of a scene that is about to become another one."""
    exports = [run.path / "export" for run in (project.run, *(each.run for each in project.scenes))]
    for folder in (*exports, project.folder / "downloads"):
        shutil.rmtree(folder, ignore_errors=True)


def _describe_orbits(orbits: Sequence[tuple[float, int | None]]) -> dict[str, float | None]:
    degrees, guess = orbits[-1]
    return {"now": degrees, "guess": guess, "before": orbits[-2][0] if len(orbits) > 1 else None}


def _size(path: Path) -> int:
    """Return bytes of a file, 0 where it is not there."""
    try:
        return path.stat().st_size
    except OSError:
        return 0


def _link(project: Project, path: Path) -> str | None:
    """Return the address of a file, another one when it has changed; None where it is not there."""
    try:
        changed = path.stat().st_mtime_ns
    except OSError:
        return None
    if not path.is_file():
        return None
    return f"/files/{project.id}/{quote(path.relative_to(project.folder).as_posix())}?v={changed:x}"
