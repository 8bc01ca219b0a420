"""Plans to files: panels with color, flow and depth, pairs for two eyes, color with alpha, GIFs."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flowsplat.common.progress import track
from flowsplat.common.spread import spread
from flowsplat.common.threads import in_threads
from flowsplat.gaussians.model import at_once
from flowsplat.gaussians.renderer import Renderer, Rendering
from flowsplat.geometry.paths import shift_camera
from flowsplat.images.colors import depth_range, depth_to_color, float_to_bytes, flow_scale, flow_to_color
from flowsplat.images.gif import write_gif
from flowsplat.images.sheets import side_by_side
from flowsplat.images.transparent import webm_writer
from flowsplat.images.video import mp4_writer
from flowsplat.output.videos.plans import VideoPlan
from flowsplat.output.videos.shots import MIN_ALPHA, Shot, small

_PROBE_SHOTS = 5
"""Shots that are looked at before a video is made, to fix its color scales. Chosen by eye."""
_MAX_PANEL_WIDTH = 1280
"""Pixels. Three panels beside each other then stay below what hardware decoders take."""


def look(model: Renderer, shots: Sequence[Shot], k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Color, flow to the next shot and depth of shot ``k``; flow NaN and depth 0 where there is hardly anything."""
    neighbor = k + 1 if k + 1 < len(shots) else max(k - 1, 0)
    rendering = model.render(*shots[k], shots[neighbor])
    assert rendering.flow is not None
    covered = rendering.alpha >= MIN_ALPHA
    # The last shot has no next one: it is taken to go on as it came.
    flow = rendering.flow if neighbor >= k else -rendering.flow
    return rendering.color, np.where(covered[..., None], flow, np.nan), np.where(covered, rendering.depth, 0)


@dataclass(frozen=True)
class Scales:
    """Color scales that one video keeps: flow in pixels, depth, and a hash of the shots that they were taken from."""

    flow: float
    near: float
    far: float
    looks: str

    @staticmethod
    def of(model: Renderer, shots: Sequence[Shot]) -> Scales:
        """Look at a few shots, smaller."""
        smaller = [(small(camera), t) for camera, t in shots]
        ratio = shots[0][0].width / smaller[0][0].width
        seen = list(in_threads(lambda k: look(model, smaller, k), spread(len(shots), _PROBE_SHOTS), at_once(model)))
        looks = hashlib.sha256()
        for arrays in seen:
            for array in arrays:
                looks.update(np.ascontiguousarray(array, np.float32).tobytes())
        near, far = depth_range(depth for _, _, depth in seen)
        scale = flow_scale(flow * ratio for _, flow, _ in seen)
        return Scales(scale, near, far, looks.hexdigest()[:16])


def write_plan(model: Renderer, plan: VideoPlan, scales: Scales, folder: Path) -> None:
    """Render the video of a plan. ``model`` is the part of the scene that it shows.

    Raises:
        InputError: the folder cannot be written.
    """
    paths = [folder / file for file in plan.files]
    if plan.kind == "panels":
        _write_panels(model, plan, scales, *paths)
    elif plan.kind == "stereo":
        _write_stereo(model, plan, *paths)
    elif plan.kind == "alpha":
        _write_alpha(model, plan, *paths)
    else:
        shots = track(plan.shots, f"Rendering {plan.name}")
        images = in_threads(lambda shot: float_to_bytes(model.render(*shot).color), shots, at_once(model))
        write_gif(paths[0], list(images), plan.fps)


def _write_panels(model: Renderer, plan: VideoPlan, scales: Scales, panels_path: Path, color_path: Path) -> None:
    camera = plan.shots[0][0]
    height = min(camera.height, max(round(camera.height * _MAX_PANEL_WIDTH / camera.width), 1))

    def sheet(k: int) -> tuple[np.ndarray, np.ndarray]:
        image, flow, depth = look(model, plan.shots, k)
        color = plan.lay_over(float_to_bytes(image), plan.shots[k][1])
        panels = [color, flow_to_color(flow, scales.flow), depth_to_color(depth, scales.near, scales.far)]
        return side_by_side(panels, ["color", "flow", "depth"], height), color

    with (
        mp4_writer(panels_path, plan.fps, audio_from=plan.audio_from, audio_start=plan.audio_start) as write_panels,
        mp4_writer(color_path, plan.fps, audio_from=plan.audio_from, audio_start=plan.audio_start) as write_color,
    ):
        shots = track(range(len(plan.shots)), f"Rendering {plan.name}")
        for panels, color in in_threads(sheet, shots, at_once(model)):
            write_panels(panels)
            write_color(color)


def _write_stereo(model: Renderer, plan: VideoPlan, path: Path) -> None:
    def pair(shot: Shot) -> np.ndarray:
        eyes = [shift_camera(shot[0], side * plan.eye_distance / 2, plan.convergence) for side in (-1, 1)]
        return np.concatenate([float_to_bytes(model.render(eye, shot[1]).color) for eye in eyes], axis=1)

    with mp4_writer(path, plan.fps, audio_from=plan.audio_from, audio_start=plan.audio_start) as write:
        for both in in_threads(pair, track(plan.shots, f"Rendering {plan.name}"), at_once(model)):
            write(both)


def _write_alpha(model: Renderer, plan: VideoPlan, path: Path) -> None:
    with webm_writer(path, plan.fps) as write:
        shots = track(plan.shots, f"Rendering {plan.name}")
        for image in in_threads(lambda shot: on_transparent(model.render(*shot)), shots, at_once(model)):
            write(image)


def on_transparent(seen: Rendering) -> np.ndarray:
    """Return [H, W, 4] uint8 RGBA of what was rendered without filling; color is not multiplied by alpha, as WebM wants it."""
    color = seen.color / np.maximum(seen.alpha, 1e-6)[..., None]
    return float_to_bytes(np.concatenate([color, seen.alpha[..., None]], axis=-1))
