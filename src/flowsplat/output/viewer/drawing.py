"""Draw the image that a client wants to see."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
import torch

from flowsplat.gaussians.crop import CropBox
from flowsplat.gaussians.distances import slice_view
from flowsplat.gaussians.model import SceneModel
from flowsplat.gaussians.renderer import Part
from flowsplat.geometry import Camera
from flowsplat.geometry.paths import shift_camera
from flowsplat.images.colors import depth_to_color, float_to_bytes, flow_to_color
from flowsplat.output.videos.options import RenderOptions
from flowsplat.output.videos.shots import MIN_ALPHA
from flowsplat.output.viewer.browser_frame import BrowserFrame, Pose
from flowsplat.output.viewer.layout import Box, empty, fit_box, halves, place, wipe
from flowsplat.output.viewer.mask import compute_kept, fade_into_window
from flowsplat.output.viewer.source import Source
from flowsplat.splatting.rules import ALPHA_MIN

ImageKind = Literal["color", "flow", "depth", "alpha", "Gaussians"]
Compare = Literal["off", "beside", "wipe"]

_TRACK_TAIL = 8
"""Frames that a track on the input image reaches back. Chosen by eye."""
_MAX_TRACKS = 250
"""Of objects, and of the background; more hide the image. Chosen by eye."""
_BACKGROUND_GRAY = 24
"""Gray value behind Gaussians that are shown as points. Chosen by eye."""
_MAX_DEPTH = 150.0
"""What viser can say of a depth ends at 167."""
_BOTH_EYES = (-1, 1)
_ONE_EYE = (0,)


@dataclass(frozen=True)
class Look:
    """What is drawn.

    Attributes:
        show: which image; ``Gaussians`` draws the active ones as points.
        part: of the scene.
        compare: the input frame beside the rendering, or over its left part.
        wipe: how much of the rendering it covers, 0 to 1.
        tracks: the tracks of the clip, drawn where the image is seen from the input camera.
        stereo: a pair for two eyes, left beside right, in place of what ``compare`` says.
        distances: of objects, by number, how many times as far away they are as they were trained.
        confidence_fade: without what the clip tells too little of, from where it is seen.
        crop: what lies in this box alone; None = all.
    """

    show: ImageKind = "color"
    part: Part = "all"
    compare: Compare = "off"
    wipe: float = 0.5
    tracks: bool = False
    stereo: bool = False
    distances: tuple[tuple[int, float], ...] = ()
    confidence_fade: bool = False
    crop: CropBox | None = None


@dataclass(frozen=True)
class Wish:
    """One image that a client is to get.

    Attributes:
        size: (width, height) of its canvas, in the pixels of the image.
        t: seconds of the clip.
        look: what is drawn.
        pose: where from; None = from where the input camera is at that time.
        turn: degrees by which that is turned to the left and up, round the middle of the scene.
    """

    size: tuple[int, int]
    t: float
    look: Look
    pose: Pose | None
    turn: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Drawing:
    """An image for a canvas.

    Attributes:
        image: [H, W, 3] uint8.
        depth: [H, W] float32 in the browser's coordinates, far away where there is nothing: what is drawn there by the
            browser is hidden behind it. 0 behind a stereo pair, which hides all of that: it is for one eye.
        pose: the browser's camera that fits to the image.
    """

    image: np.ndarray
    depth: np.ndarray
    pose: Pose


def draw(source: Source, browser: BrowserFrame, wish: Wish) -> Drawing:
    """Render and compose what a client wants to see."""
    image, depth = empty(wish.size), np.full(wish.size[::-1], _MAX_DEPTH, np.float32)
    whole = Box(0, 0, *wish.size)
    is_halved = wish.look.stereo or wish.look.compare == "beside"
    left, right = halves(wish.size) if is_halved else (whole, whole)
    if wish.pose is not None:
        # The clip's own camera is fitted into its room, a free one fills it.
        room, camera = left, browser.camera(wish.pose, left.width, left.height)
    else:
        room = fit_box(source.size, left)
        camera = source.input_camera(wish.t, wish.turn).resize(room.width, room.height)
    pose = wish.pose or _fit_whole_view(browser, camera, wish.size[1])
    if wish.look.stereo:
        for half, side in zip((left, right), _BOTH_EYES, strict=True):
            place(image, render_look(source, camera, wish, side)[0], replace(room, x=room.x + half.x))
        return Drawing(image, np.zeros_like(depth), pose)
    drawn, distance = render_look(source, camera, wish)
    if wish.look.compare == "wipe":
        over = cv2.resize(source.frame(wish.t), (room.width, room.height), interpolation=cv2.INTER_AREA)
        drawn = wipe(drawn, over, wish.look.wipe)
    place(image, drawn, room)
    depth[room.rows_and_columns] = distance * browser.from_scene.scale
    if wish.look.compare == "beside":
        place(image, source.frame(wish.t), fit_box(source.size, right))
    return Drawing(image, np.clip(depth, 0, _MAX_DEPTH), pose)


def _fit_whole_view(browser: BrowserFrame, camera: Camera, height: int) -> Pose:
    """Return the pose of a fitted camera, its field of view that of the whole canvas."""
    pose = browser.pose(camera)
    return Pose(pose.wxyz, pose.position, 2 * float(np.arctan(height / 2 / camera.K[1, 1])))


def draw_shot(source: Source, browser: BrowserFrame, camera: Camera, t: float, look: Look) -> np.ndarray:
    """Return [H, W, 3] uint8 a shot of a path as a client looks at it, without the input frame; twice as wide for two eyes."""
    wish = Wish((camera.width, camera.height), t, look, browser.pose(camera))
    sides = _BOTH_EYES if look.stereo else _ONE_EYE
    return np.concatenate([render_look(source, camera, wish, side)[0] for side in sides], axis=1)


def render_look(source: Source, camera: Camera, wish: Wish, side: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return what ``wish.look`` shows, from a camera of the scene or from one of two eyes there (``side`` -1 left, 1 right).

    Beside the input camera what the clip has not seen fades into the window; a free camera is shown it, too.

    Returns:
        [H, W, 3] uint8 and the planar depth [H, W] in the units of the scene, far away where there is nothing.
    """
    look, t = wish.look, wish.t
    flow_to = _next_shot(source, camera, wish, side) if look.show == "flow" else None
    camera = _eye(source, camera, side)
    model = source.model(look.part, look.distances, look.confidence_fade, look.crop)
    is_beside = wish.pose is None and any(wish.turn)
    if is_beside:
        model = source.without_unseen(model)
    if look.show == "Gaussians":
        return draw_points(model, camera, t), np.full((camera.height, camera.width), np.inf, np.float32)
    seen = model.render(camera, t, flow_to)
    covered = seen.alpha >= MIN_ALPHA
    kept = compute_kept(seen.alpha) if model.fill and model.confidence_fade is not None else None
    if look.show == "color":
        image = float_to_bytes(seen.color)
    elif look.show == "alpha":
        image = np.repeat(float_to_bytes(seen.alpha)[..., None], 3, axis=-1)
    elif look.show == "depth":
        image = depth_to_color(np.where(covered, seen.depth, 0), source.scales.near, source.scales.far)
    else:
        assert seen.flow is not None
        scale = source.scales.flow * camera.width / source.size[0]
        flow = seen.flow if t + source.step <= source.clip[1] else -seen.flow
        image = flow_to_color(np.where(covered[..., None], flow, np.nan), scale)
    if kept is not None:
        image, covered = fade_into_window(image, kept), covered & (kept >= MIN_ALPHA)
    if look.tracks and wish.pose is None and not is_beside and source.tracks is not None:
        draw_tracks(image, source, t)
    return image, np.where(covered, seen.depth, np.inf).astype(np.float32)


def _eye(source: Source, camera: Camera, side: int) -> Camera:
    depth = 1 / source.scene.similarity.scale  # the median
    return shift_camera(camera, side * RenderOptions.eye_distance / 2 * depth, depth)


def _next_shot(source: Source, camera: Camera, wish: Wish, side: int) -> tuple[Camera, float]:
    """Return where flow leads to: a frame further; a free camera stands still, so that its flow is the motion of the scene
    alone."""
    t = wish.t + source.step if wish.t + source.step <= source.clip[1] else wish.t - source.step
    if wish.pose is None:
        camera = source.input_camera(t, wish.turn).resize(camera.width, camera.height)
    return _eye(source, camera, side), t


@torch.no_grad()
def draw_points(model: SceneModel, camera: Camera, t: float) -> np.ndarray:
    """Return [H, W, 3] uint8: every active Gaussian as a dot in its color at its center, near ones over far ones."""
    image = np.full((camera.height, camera.width, 3), _BACKGROUND_GRAY, np.uint8)
    there = model.similarity.camera(camera)
    gaussians = model.gaussians_for(there, model.clip_time(t))
    sliced = slice_view(gaussians, there, model.clip_time(t), distances=model.distances)
    if not len(sliced.means):
        return image
    uv, depth = there.project(sliced.means.cpu().numpy().astype(np.float64))
    shown = np.ones(len(uv), bool) if model.confidence_fade is None else sliced.opacities.cpu().numpy() > ALPHA_MIN
    inside = shown & (depth > 1e-3) & np.isfinite(uv).all(-1) & (uv >= 0).all(-1) & (uv < [camera.width, camera.height]).all(-1)
    order = np.nonzero(inside)[0][np.argsort(-depth[inside], kind="stable")]
    dot = np.arange(2 if camera.width >= 480 else 1)
    x = np.minimum(uv[order, 0].astype(np.int64)[:, None, None] + dot, camera.width - 1)
    y = np.minimum(uv[order, 1].astype(np.int64)[:, None, None] + dot[:, None], camera.height - 1)
    colors = float_to_bytes(sliced.colors.cpu().numpy()[order])
    # Where an index comes twice, NumPy keeps what is written last: the nearest.
    image[y, x] = colors[:, None, None]
    return image


def draw_tracks(image: np.ndarray, source: Source, t: float) -> None:
    """Draw the last frames of some of the clip's tracks onto an image from the input camera: objects warm, background cold.

    There are no tracks on held-out frames: there, those of the nearest training frame are shown.
    """
    assert source.tracks is not None
    tracks, frames = source.tracks, source.scene.train_frames
    now = min(frames, key=lambda i: abs(source.scene.timestamps[i] - t))
    tail = [i for i in frames if now - _TRACK_TAIL <= i <= now]
    scale = np.array([image.shape[1] / source.size[0], image.shape[0] / source.size[1]])
    width = max(round(image.shape[1] / 640), 1)
    for moving, color in ((False, (80, 170, 255)), (True, (255, 140, 0))):
        chosen = np.nonzero(tracks.visible[:, now] & (tracks.moving == moving))[0]
        chosen = chosen[:: max(len(chosen) // _MAX_TRACKS, 1)]
        lines = [np.round(tracks.points[p, tail][tracks.visible[p, tail]] * scale).astype(np.int32) for p in chosen]
        cv2.polylines(image, lines, False, color, width, cv2.LINE_AA)
        for line in lines:
            cv2.circle(image, tuple(map(int, line[-1])), width, color, -1, cv2.LINE_AA)
