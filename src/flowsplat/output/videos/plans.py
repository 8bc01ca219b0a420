"""Plan every video before it is rendered: what it shows, from where, when, and what it is written as."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.spread import spread
from flowsplat.gaussians.renderer import Part, PartedRenderer
from flowsplat.geometry.paths import CameraPath
from flowsplat.images.video import MAX_FPS, MIN_FPS
from flowsplat.output.camera_files import CameraShots, read_camera_file
from flowsplat.output.videos.amplitudes import Amplitudes, Swing
from flowsplat.output.videos.options import RenderOptions, check_options, factors_of
from flowsplat.output.videos.paths import PATHS, PathRequest
from flowsplat.output.videos.shots import GIF_FPS, Shot, small
from flowsplat.scenes import Scene

_MAX_CAMERA_NAME_BYTES = 64
"""Of the name of a camera file that the names of its videos have. Chosen by eye: names of files end at 150."""
_SUFFIXES = {"stereo": "mp4", "alpha": "webm", "gif": "gif"}


@dataclass(frozen=True)
class VideoPlan:
    """One video before it is rendered.

    Attributes:
        name: of its files.
        shots: (camera, seconds of the clip), one a frame.
        fps: frames a second.
        kind: color, flow and depth beside each other and color alone; two eyes; color with alpha; an animated GIF.
        part: what of the scene is shown.
        eye_distance: between the eyes of a stereo pair, in the units of the scene's cameras.
        convergence: planar depth that both eyes see in the same place.
        audio_from: where the sound comes from.
        audio_start: its second that belongs to the first frame.
        swing: how far it goes round the clip's cameras, where that was measured.
        burnt_in: the scene whose logos and clocks are laid over it again, where it shows the clip as it came.
    """

    name: str
    shots: list[Shot]
    fps: float
    kind: Literal["panels", "stereo", "alpha", "gif"] = "panels"
    part: Part = "all"
    eye_distance: float = 0.0
    convergence: float = 1.0
    audio_from: Path | None = None
    audio_start: float = 0.0
    swing: Swing | None = None
    burnt_in: Scene | None = None

    def lay_over(self, color: np.ndarray, t: float) -> np.ndarray:
        """Return a rendered RGB image [H, W, 3] uint8 with what was burnt into the frame nearest to second ``t``."""
        scene = self.burnt_in
        overlay = None if scene is None else scene.overlay
        burnt_in = None if scene is None else scene.overlay_frame(int(np.argmin(np.abs(scene.timestamps - t))))
        if overlay is None or burnt_in is None:
            return color
        size = color.shape[1], color.shape[0]
        covers = cv2.resize(overlay.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        return np.where(covers[..., None], cv2.resize(burnt_in, size, interpolation=cv2.INTER_AREA), color)

    @property
    def files(self) -> list[str]:
        """Names of what it is written to."""
        if self.kind == "panels":
            return [f"{self.name}.mp4", f"{self.name}_color.mp4"]
        return [f"{self.name}.{_SUFFIXES[self.kind]}"]

    def to_json(self) -> list[Any]:
        """Return all that the video depends on, the model excepted."""
        views = [[camera.to_json(), t] for camera, t in self.shots]
        look = [self.kind, self.part, self.eye_distance, self.convergence]
        burnt_in = [] if self.burnt_in is None else ["burnt in"]
        return [views, self.fps, look, self.audio_from and self.audio_from.name, self.audio_start, *burnt_in]


def plan_videos(model: PartedRenderer, scene: Scene, options: RenderOptions) -> list[VideoPlan]:
    """Return every video that was asked for.

    Raises:
        InputError: an option or the camera file cannot be used, or objects are asked for that are not there.
    """
    found: list[VideoPlan] = []
    for plan in _whole(model, scene, options):
        for part in options.parts:
            if part.startswith("objects"):
                _require_objects(model.part(part), plan, part)
            found += _versions(plan, part, scene, options)
    return found


def settle(scene: Scene, options: RenderOptions) -> tuple[float, tuple[int, int], CameraShots | None]:
    """Return what follows from the options and the clip alone: frames a second, (width, height), and the camera file's shots.

    Raises:
        InputError: an option or the camera file cannot be used.
    """
    clip = float(scene.timestamps[0]), float(scene.timestamps[-1])
    return settle_clip(clip, float(scene.info.source_fps), (scene.width, scene.height), options)


def settle_clip(
    clip: tuple[float, float], source_fps: float, size: tuple[int, int], options: RenderOptions
) -> tuple[float, tuple[int, int], CameraShots | None]:
    """Do what ``settle`` does for a clip that is not there yet.

    Args:
        clip: seconds of its first and its last frame.
        source_fps: its frames a second.
        size: (width, height) in pixels.
        options: of the videos.

    Raises:
        InputError: an option or the camera file cannot be used.
    """
    fps = min(max(source_fps, MIN_FPS), MAX_FPS) if options.fps is None else options.fps
    check_options(options, fps, *clip)
    width = size[0] if options.width is None else options.width
    size = (width, max(round(size[1] * width / size[0]), 1))
    return fps, size, None if options.camera_file is None else read_camera_file(options.camera_file, size, clip)


def _versions(plan: VideoPlan, part: Part, scene: Scene, options: RenderOptions) -> Iterator[VideoPlan]:
    """Yield the video of one part of the scene, and its stereo pair (objects alone on black, as players know no alpha beside
    stereo)."""
    suffix = "" if part == "all" else "_" + part.replace(":", "_").replace(",", "_")
    if options.object_depth:
        factors = factors_of(options.object_depth)
        suffix = "_distance" + "".join(f"_{number}x{factor:g}" for number, factor in factors.items()) + suffix
    if options.confidence_fade:
        suffix = "_confidence_fade" + suffix
    shown = replace(plan, part=part, name=plan.name + suffix, burnt_in=plan.burnt_in if part == "all" else None)
    transparent = part.startswith("objects") and plan.kind == "panels"
    yield replace(shown, kind="alpha", audio_from=None) if transparent else shown
    if options.stereo and plan.kind == "panels":
        depth = 1 / scene.similarity.scale
        eyes = options.eye_distance * depth
        yield replace(shown, kind="stereo", name=f"{shown.name}_stereo", eye_distance=eyes, convergence=depth)


def _whole(model: PartedRenderer, scene: Scene, options: RenderOptions) -> Iterator[VideoPlan]:
    """Yield every path, showing the whole scene."""
    first, last = float(scene.timestamps[0]), float(scene.timestamps[-1])
    fps, size, given = settle(scene, options)
    step = 1 / (fps * options.slow_motion)
    times = first + np.arange(int((last - first) / step + 1e-6) + 1) * step
    spare = max(len(times) - options.max_frames, 0)
    middle = times[spare // 2 : len(times) - (spare - spare // 2)]
    frozen = (first + last) / 2 if options.bullet_time is None else options.bullet_time
    sound, start = (scene.sound if options.slow_motion == 1 else None) or (None, 0.0)
    tempo = "" if options.slow_motion == 1 else f"_slow{options.slow_motion:g}"
    clip = CameraPath(scene.timestamps.tolist(), [camera.resize(*size) for camera in scene.cameras])
    amplitudes = Amplitudes(model, scene, options.orbit_angle)

    for path in (entry.value for entry in PATHS.entries() if entry.name in options.paths):
        is_loop = path.loop_seconds is not None
        if path.stands_still:
            shown = np.full(path.frames or options.max_frames, frozen)
        else:
            shown = middle if is_loop else times  # a loop of the middle of the clip, in real time
        request = PathRequest(
            model, clip, shown, np.linspace(0, 2 * np.pi, len(shown), endpoint=False), step, 1 / scene.similarity.scale,
            options.stabilize, options.eye_distance, options.orbit_angle, options.dolly, amplitudes,
        )  # fmt: skip
        shots = list(zip(path.cameras(request), shown.tolist(), strict=True))
        swing = request.swings[-1] if request.swings else None
        heard = sound if not (is_loop or path.stands_still) else None
        yield VideoPlan(
            path.file + tempo * (not path.stands_still), shots, GIF_FPS if path.kind == "gif" else fps, kind=path.kind,
            audio_from=heard, audio_start=start if heard else 0.0, swing=swing,
            burnt_in=scene if path.is_input and scene.overlay is not None else None,
        )  # fmt: skip
    if given is not None:
        assert options.camera_file is not None
        yield VideoPlan(f"custom_path_{name_of(options.camera_file)}", given.shots, options.fps or given.fps or fps)


def name_of(camera_file: Path) -> str:
    """Return what a camera file is called, as a part of the names of its videos: ``--`` for ``_``, after which such a name says
    what else a video is, and not longer than a file's name can be with that behind it."""
    name = re.sub(r"[^\w.-]", "-", camera_file.stem).replace("_", "--")
    if len(name.encode()) <= _MAX_CAMERA_NAME_BYTES:
        return name
    digest = hashlib.sha256(name.encode()).hexdigest()[:6]
    return f"{name.encode()[: _MAX_CAMERA_NAME_BYTES - 7].decode(errors='ignore')}-{digest}"


def _require_objects(objects: PartedRenderer, plan: VideoPlan, part: Part) -> None:
    for k in spread(len(plan.shots), 5):
        camera, t = plan.shots[k]
        if objects.render(small(camera), t).alpha.max() > 0:
            return
    nothing = "Nothing moves" if part == "objects" else f"Nothing of {part} is seen"
    raise InputError(f"{nothing} in {plan.name}: leave {part} out of --render.parts.")
