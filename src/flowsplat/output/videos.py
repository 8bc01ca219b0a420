"""Videos of a trained scene: along the clip's own cameras, round its middle, with time standing still, along a given path.

Every path gives two files: ``<name>.mp4`` with colour, flow and depth beside each other, and ``<name>_colour.mp4`` with
the colour alone. ``renders.json`` beside them tells what they were made of; a video that is there and would come out the
same is not rendered again.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from flowsplat import __version__
from flowsplat.common.errors import InputError
from flowsplat.common.files import read_json, write_json
from flowsplat.common.progress import track
from flowsplat.gaussians.rendering import Renderer
from flowsplat.geometry import Camera
from flowsplat.geometry.paths import CameraPath, orbit
from flowsplat.output.camera_files import LARGEST, read_camera_file
from flowsplat.pictures.colors import depth_range, depth_to_color, float_to_bytes, flow_scale, flow_to_color
from flowsplat.pictures.sheets import side_by_side
from flowsplat.pictures.video import mp4_writer
from flowsplat.scenes import Scene

Shot = tuple[Camera, float]

_PROBES = 5
"""Shots that are looked at before a video is made, to fix its colour scales."""
_PROBE_SHARE = 4
"""By how much those are smaller."""
_WIDEST_PANEL = 1280
"""Pixels. Three panels beside each other then stay below what hardware decoders take."""
_SMALLEST = 16
_COVERED = 0.5
"""Alpha from which flow and depth are shown."""


@dataclass(frozen=True)
class RenderOptions:
    """Which videos are made, and how."""

    paths: tuple[Literal["input", "orbit", "bullet"], ...] = ("input", "orbit", "bullet")
    """``input``: along the clip's cameras. ``orbit``: a loop round the middle camera while time plays. ``bullet``: the
    same loop while time stands still."""
    width: int | None = None
    """Pixels; the height follows. None = as the clip was trained."""
    fps: float | None = None
    """Frames a second. None = as the source, in-between frames rendered where the clip was thinned; then ``input`` has
    as many frames as the source, and that is what its rendering costs."""
    max_frames: int = 120
    """Frames of ``orbit`` and ``bullet`` at most."""
    orbit_angle: float = 6.0
    """Half-width in degrees of the loop of ``orbit`` and ``bullet``, seen from the middle of the scene."""
    bullet_time: float | None = None
    """Seconds of the clip at which time stands still in ``bullet``. None = the middle."""
    camera_file: Path | None = None
    """A camera path of your own: see ``flowsplat.output.camera_files`` for the formats."""


@dataclass(frozen=True)
class _Plan:
    """One video before it is rendered."""

    name: str
    shots: list[Shot]
    fps: float
    audio_from: Path | None = None
    audio_start: float = 0.0


def render_videos(model: Renderer, scene: Scene, folder: Path, options: RenderOptions) -> dict[str, str]:
    """Render the videos that ``options`` ask for into ``folder``.

    Returns:
        what was made, by name: ``input_path``, ``orbit``, ``bullet_time`` and ``custom_path``, and each with
        ``_colour``, to the file's name in ``folder``.

    Raises:
        InputError: an option or the camera file cannot be used, or the folder cannot be written.
    """
    plans = _plans(scene, options)
    book_path = Path(folder) / "renders.json"
    book: dict[str, Any] = read_json(book_path) if book_path.exists() else {}
    made: dict[str, str] = {}
    for plan in plans:
        files = {plan.name: f"{plan.name}.mp4", f"{plan.name}_colour": f"{plan.name}_colour.mp4"}
        scales = _Scales.of(model, plan.shots)
        entry = {"key": _key(plan, scales), "fps": plan.fps, "frames": len(plan.shots), "files": list(files.values())}
        if book.get(plan.name) != entry or not all((Path(folder) / file).exists() for file in files.values()):
            _render(model, plan, scales, *(Path(folder) / file for file in files.values()))
            book[plan.name] = entry
            write_json(book_path, book)
        made |= files
    return made


# -- what to show


def _plans(scene: Scene, options: RenderOptions) -> list[_Plan]:
    """Every video that was asked for; options are checked before anything is rendered."""
    first, last = float(scene.timestamps[0]), float(scene.timestamps[-1])
    fps = float(scene.info["source_fps"]) if options.fps is None else options.fps
    _check(options, fps, first, last)
    width = scene.width if options.width is None else options.width
    size = (width, max(round(scene.height * width / scene.width), 1))
    path = CameraPath(scene.timestamps.tolist(), [camera.resized(*size) for camera in scene.cameras])
    times = first + np.arange(int((last - first) * fps + 1e-6) + 1) / fps
    distance = 1 / scene.similarity.scale  # the median depth
    plans = []
    if "input" in options.paths:
        audio = scene.info.get("audio")
        start = float(scene.info.get("audio_start") or 0.0)
        shots = [(path.at(t), float(t)) for t in times]
        plans.append(_Plan("input_path", shots, fps, Path(audio) if audio else None, start))
    if "orbit" in options.paths:
        # The middle of the clip in real time: what the middle camera has seen.
        spare = max(len(times) - options.max_frames, 0)
        played = times[spare // 2 : len(times) - (spare - spare // 2)]
        loop = orbit(path.at((first + last) / 2), distance, len(played), options.orbit_angle)
        plans.append(_Plan("orbit", [(camera, float(t)) for camera, t in zip(loop, played, strict=True)], fps))
    if "bullet" in options.paths:
        frozen = (first + last) / 2 if options.bullet_time is None else options.bullet_time
        loop = orbit(path.at(frozen), distance, options.max_frames, options.orbit_angle)
        plans.append(_Plan("bullet_time", [(camera, frozen) for camera in loop], fps))
    if options.camera_file is not None:
        found = read_camera_file(options.camera_file, size, (first, last))
        plans.append(_Plan("custom_path", found.shots, options.fps or found.fps or fps))
    return plans


def _check(options: RenderOptions, fps: float, first: float, last: float) -> None:
    unknown = set(options.paths) - {"input", "orbit", "bullet"}
    if unknown:
        raise InputError(f"Unknown camera path {min(unknown)!r}: choose from input, orbit, bullet, or give a camera file.")
    if options.width is not None and not _SMALLEST <= options.width <= LARGEST:
        raise InputError(f"A video {options.width} pixels wide cannot be made: give a width from {_SMALLEST} to {LARGEST}.")
    if not 0.1 <= fps <= 1000:
        raise InputError(f"{fps:g} frames a second cannot be written: give a frame rate from 0.1 to 1000.")
    if options.max_frames < 2:
        raise InputError(f"A video of at most {options.max_frames} frame(s) shows no motion: give 2 or more.")
    if not 0 <= options.orbit_angle < 90:
        raise InputError(f"The orbit's angle is {options.orbit_angle:g} degrees: give one from 0 to 90.")
    if options.bullet_time is not None and not first <= options.bullet_time <= last:
        raise InputError(f"The bullet time {options.bullet_time:g} s is outside the clip ({first:g} to {last:g} s).")


def _key(plan: _Plan, scales: _Scales) -> str:
    """A hash of all that a video depends on; what the model is shows in the shots that were looked at."""
    views = [[camera.to_json(), t] for camera, t in plan.shots]
    text = json.dumps([__version__, views, plan.fps, str(plan.audio_from), plan.audio_start, scales.looks])
    return hashlib.sha256(text.encode()).hexdigest()[:16]


# -- showing it


def _look(model: Renderer, shots: Sequence[Shot], k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colour, flow to the next shot and depth of shot ``k``; flow NaN and depth 0 where there is hardly anything."""
    neighbour = k + 1 if k + 1 < len(shots) else max(k - 1, 0)
    rendering = model.render(*shots[k], shots[neighbour])
    assert rendering.flow is not None
    covered = rendering.alpha >= _COVERED
    # The last shot has no next one: it is taken to go on as it came.
    flow = rendering.flow if neighbour >= k else -rendering.flow
    return rendering.colour, np.where(covered[..., None], flow, np.nan), np.where(covered, rendering.depth, 0)


@dataclass(frozen=True)
class _Scales:
    """Colour scales that one video keeps: flow in pixels, depth, and a hash of the shots that they were taken from."""

    flow: float
    near: float
    far: float
    looks: str

    @staticmethod
    def of(model: Renderer, shots: Sequence[Shot]) -> _Scales:
        """Look at a few shots, smaller."""
        camera = shots[0][0]
        width, height = (max(size // _PROBE_SHARE, 1) for size in (camera.width, camera.height))
        small = [(c.resized(width, height), t) for c, t in shots]
        chosen = np.unique(np.linspace(0, len(shots) - 1, _PROBES).round().astype(int))
        seen = [_look(model, small, int(k)) for k in chosen]
        looks = hashlib.sha256()
        for look in seen:
            for array in look:
                looks.update(np.ascontiguousarray(array, np.float32).tobytes())
        near, far = depth_range(depth for _, _, depth in seen)
        scale = flow_scale(flow * (camera.width / width) for _, flow, _ in seen)
        return _Scales(scale, near, far, looks.hexdigest()[:16])


def _render(model: Renderer, plan: _Plan, scales: _Scales, panels_path: Path, colour_path: Path) -> None:
    camera = plan.shots[0][0]
    height = min(camera.height, max(round(camera.height * _WIDEST_PANEL / camera.width), 1))
    with (
        mp4_writer(panels_path, plan.fps, audio_from=plan.audio_from, audio_start=plan.audio_start) as write_panels,
        mp4_writer(colour_path, plan.fps, audio_from=plan.audio_from, audio_start=plan.audio_start) as write_colour,
    ):
        for k in track(range(len(plan.shots)), f"Rendering {plan.name}"):
            picture, flow, depth = _look(model, plan.shots, k)
            colour = float_to_bytes(picture)
            panels = [colour, flow_to_color(flow, scales.flow), depth_to_color(depth, scales.near, scales.far)]
            write_panels(side_by_side(panels, ["colour", "flow", "depth"], height))
            write_colour(colour)
