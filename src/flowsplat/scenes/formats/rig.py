"""Rendered scenes with exact truth and held-out cameras (the rig format).

| file | content |
| --- | --- |
| ``rgb/00000.png`` | the clip |
| ``cameras.json`` | ``K`` [3, 3], ``width``, ``height``, ``w2c`` [T, 4, 4] (OpenCV axes, pixel centers at +0.5), ``fps`` |
| ``depth.npz`` | ``depth`` [T, H, W], planar |
| ``flow.npz`` | ``fwd``, ``bwd`` [T, H, W, 2] pixels to the next and the previous frame, ``fwd_valid``, ``bwd_valid`` [T, H, W] |
| ``masks/00000.png`` | object numbers, 0 = static |
| ``tracks.npz`` | ``points`` [T, N, 3] world, ``visible`` [T, N], ``moving`` [N], ``birth`` [N] a time to ask a tracker at |
| ``heldout/cameras.json`` | ``K``, ``width``, ``height`` and for each camera ``times``, ``w2c`` |
| ``heldout/<camera>/00000.png`` | images by time; also ``<camera>_masks/`` and ``<camera>_covisible/`` |

The masks are truth, not given masks: a scene without them has to find its objects, and the truth tells how well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.files import plain_name, read_json, read_npz
from flowsplat.common.files.arrays import MAX_ARRAY_BYTES
from flowsplat.geometry import Camera
from flowsplat.scenes.clip import MAX_FPS, MIN_FPS, InputOptions, resize_labels
from flowsplat.scenes.formats.images import list_images
from flowsplat.scenes.formats.masks import read_labels
from flowsplat.scenes.formats.posed import PosedClip, PosedImage, PosedView, open_posed
from flowsplat.scenes.layers import Depth, Flow, Tracks

_ARRAYS = ("depth", "fwd", "bwd", "fwd_valid", "bwd_valid", "points", "visible", "moving", "birth")
_MAX_BYTES_PER_PIXEL = 48
"""Bytes: flow both ways in float64 with where it is valid."""


def _cameras(path: Path, values: dict[str, Any], poses: Sequence[Any]) -> list[Camera]:
    try:
        cameras = [Camera(np.array(w2c), np.array(values["K"]), int(values["width"]), int(values["height"])) for w2c in poses]
    except (KeyError, TypeError, ValueError, ArithmeticError) as error:
        raise InputError(f"{path} does not hold cameras: {error}.") from error
    for index, camera in enumerate(cameras):
        if not camera.is_valid:
            raise InputError(f"{path}: camera {index} is not finite or not a rotation.")
    return cameras


def _member(arrays: dict[str, np.ndarray], path: Path, name: str, shape: tuple[int, ...]) -> np.ndarray:
    if name not in arrays:
        raise InputError(f"{path} has no array {name!r}.")
    array = arrays[name]
    if array.shape[: len(shape)] != shape:
        raise InputError(f"{path}: {name} has shape {array.shape}, expected {shape} first.")
    return array


class RigTruth:
    """The truth of the chosen frames ``numbers``, at the working size; arrays are read when first asked for."""

    def __init__(self, folder: Path, cameras: list[Camera], numbers: np.ndarray, size: tuple[int, int]):
        self._folder, self._stored, self._numbers, self._size = folder, cameras, numbers, size
        self._archives: dict[str, dict[str, np.ndarray]] = {}

    def _array(self, file: str, name: str, *beyond: int) -> np.ndarray:
        path = self._folder / file
        if file not in self._archives:
            # One archive at a time: depth and flow of a long clip are large.
            pixels = sum(camera.width * camera.height for camera in self._stored)
            self._archives = {file: read_npz(path, _ARRAYS, most=max(MAX_ARRAY_BYTES, _MAX_BYTES_PER_PIXEL * pixels))}
        camera = self._stored[0]
        shape = (len(self._stored), *beyond) if file == "tracks.npz" else (len(self._stored), camera.height, camera.width, *beyond)
        return _member(self._archives[file], path, name, shape)

    @property
    def cameras(self) -> list[Camera]:
        """One camera a chosen frame."""
        return [self._stored[n].resize(*self._size) for n in self._numbers]

    @property
    def flow_pairs(self) -> list[tuple[int, int]]:
        """Both directions between chosen frames that follow each other in the rig's own clip."""
        neighbors = np.flatnonzero(np.diff(self._numbers) == 1).tolist()
        return [pair for i in neighbors for pair in ((i, i + 1), (i + 1, i))]

    @property
    def tracks(self) -> Tracks:
        """All points, [P, T, 3] in the world."""
        points = self._array("tracks.npz", "points")[self._numbers]
        visible = self._array("tracks.npz", "visible", points.shape[1])[self._numbers]
        moving = _member(self._archives["tracks.npz"], self._folder / "tracks.npz", "moving", points.shape[1:2])
        return Tracks(points.swapaxes(0, 1), visible.T, np.ones(visible.T.shape, np.float32), moving)

    @property
    def births(self) -> np.ndarray:
        """[P] int: for every point of ``tracks`` the chosen frame in which a tracker is asked for it; -1 where not chosen."""
        count = self._array("tracks.npz", "points").shape[1]
        births = _member(self._archives["tracks.npz"], self._folder / "tracks.npz", "birth", (count,)).astype(int)
        number = np.full(len(self._stored), -1)
        number[self._numbers] = np.arange(len(self._numbers))
        return number[births]

    def depth(self, i: int) -> Depth:
        """Return depth of chosen frame ``i``, certain everywhere."""
        depth = resize_labels(self._array("depth.npz", "depth")[self._numbers[i]].astype(np.float32), self._size)
        return Depth(depth, np.ones_like(depth))

    def flow(self, i: int, j: int) -> Flow:
        """Return flow between chosen neighbors; its confidence is 1 where the point is visible in both frames."""
        direction = "fwd" if j > i else "bwd"
        n = self._numbers[i]
        flow = resize_labels(self._array("flow.npz", direction, 2)[n].astype(np.float32), self._size)
        valid = resize_labels(self._array("flow.npz", f"{direction}_valid")[n].astype(np.float32), self._size)
        scale = np.array(self._size, np.float32) / [self._stored[0].width, self._stored[0].height]
        return Flow(i, j, (flow * scale).astype(np.float32), valid)

    def mask(self, i: int) -> np.ndarray:
        """Return [H, W] uint8 object numbers of chosen frame ``i``."""
        path = self._folder / "masks" / f"{self._numbers[i]:05d}.png"
        labels, camera = read_labels(path), self._stored[0]
        if labels.shape != (camera.height, camera.width):
            raise InputError(f"{path} is {labels.shape[1]}x{labels.shape[0]} pixels, its camera {camera.width}x{camera.height}.")
        return resize_labels((labels & 255).astype(np.uint8), self._size)  # of packed gray, the gray value


def _heldout_views(folder: Path) -> list[PosedView]:
    path = folder / "cameras.json"
    if not path.exists():
        return []
    values = read_json(path)
    views = []
    try:
        for name, camera in values["cameras"].items():
            plain_name(name, f"{path}: the camera")
            for time, pose in zip(camera["times"], _cameras(path, values, camera["w2c"]), strict=True):
                file = f"{int(time):05d}.png"
                masks = (folder / f"{name}_{kind}" / file for kind in ("masks", "covisible"))
                image = PosedImage(folder / name / file, pose, *(mask if mask.exists() else None for mask in masks))
                views.append(PosedView(f"{name}_{int(time):05d}", int(time), image))
    except (KeyError, TypeError, ValueError, ArithmeticError, AttributeError) as error:
        raise InputError(f"{path} does not hold the held-out cameras: {error}.") from error
    return views


def _rate(path: Path, value: Any) -> float:
    """Return frames a second.

    Raises:
        InputError: it is none.
    """
    if isinstance(value, int | float) and MIN_FPS <= value <= MAX_FPS:
        return float(value)
    raise InputError(f"{path}: fps is {value!r:.60}, it must be a number from {MIN_FPS:g} to {MAX_FPS:g}.")


def open_rig(folder: Path, options: InputOptions) -> PosedClip:
    """Open a rig scene with its truth and its held-out views. Its cameras are truth too, and not given.

    Raises:
        InputError: a file is missing, damaged or does not fit.
    """
    folder = Path(folder)
    values = read_json(folder / "cameras.json")
    if not isinstance(values, dict) or "w2c" not in values:
        raise InputError(f"{folder / 'cameras.json'} does not hold the cameras of a rig scene: it has no 'w2c'.")
    cameras = _cameras(folder / "cameras.json", values, values["w2c"])
    paths = list_images(folder / "rgb")
    if len(paths) != len(cameras):
        raise InputError(f"{folder} has {len(paths)} images in rgb/ but {len(cameras)} cameras in cameras.json.")
    images = [PosedImage(path, camera) for path, camera in zip(paths, cameras, strict=True)]
    options = replace(options, fps=_rate(folder / "cameras.json", values.get("fps", options.fps)))
    clip = open_posed(folder, options, images, _heldout_views(folder / "heldout"))
    return replace(clip, cameras=None, truth=RigTruth(folder, cameras, clip.numbers, (clip.width, clip.height)))
