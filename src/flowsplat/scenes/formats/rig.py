"""Rendered scenes with exact truth and held-out cameras (the rig format).

| file | content |
| --- | --- |
| ``rgb/00000.png`` | the clip |
| ``cameras.json`` | ``K`` [3, 3], ``width``, ``height``, ``w2c`` [T, 4, 4] (OpenCV axes, pixel centres at +0.5), ``fps`` |
| ``depth.npz`` | ``depth`` [T, H, W], planar |
| ``flow.npz`` | ``fwd``, ``bwd`` [T, H, W, 2] pixels to the next and the previous frame, ``fwd_valid``, ``bwd_valid`` [T, H, W] |
| ``masks/00000.png`` | object numbers, 0 = static |
| ``tracks.npz`` | ``points`` [T, N, 3] world, ``visible`` [T, N], ``moving`` [N], ``birth`` [N] a time to ask a tracker at |
| ``heldout/cameras.json`` | ``K``, ``width``, ``height`` and for each camera ``times``, ``w2c`` |
| ``heldout/<camera>/00000.png`` | pictures by time; also ``<camera>_masks/`` and ``<camera>_covisible/`` |

The masks are truth, not given masks: a scene without them has to find its movers, and the truth tells how well.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.files import read_json, read_npz
from flowsplat.geometry import Camera
from flowsplat.scenes.clip import (
    Clip,
    InputOptions,
    ViewPicture,
    resize_labels,
    resize_picture,
    select_frames,
    working_size,
)
from flowsplat.scenes.formats.images import list_pictures, read_picture
from flowsplat.scenes.formats.masks import read_labels
from flowsplat.scenes.layers import Depth, Flow, Tracks
from flowsplat.scenes.scene import HeldoutView


def _cameras(path: Path, values: dict[str, Any], poses: Sequence[Any]) -> list[Camera]:
    try:
        cameras = [Camera(np.array(w2c), np.array(values["K"]), int(values["width"]), int(values["height"])) for w2c in poses]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} does not hold cameras: {error}.") from error
    for index, camera in enumerate(cameras):
        if not camera.is_finite:
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
            self._archives = {file: read_npz(path)}
        camera = self._stored[0]
        shape = (len(self._stored), *beyond) if file == "tracks.npz" else (len(self._stored), camera.height, camera.width, *beyond)
        return _member(self._archives[file], path, name, shape)

    @property
    def cameras(self) -> list[Camera]:
        """One camera a chosen frame."""
        return [self._stored[n].resized(*self._size) for n in self._numbers]

    @property
    def flow_pairs(self) -> list[tuple[int, int]]:
        """Both directions between chosen frames that follow each other in the rig's own clip."""
        neighbours = np.flatnonzero(np.diff(self._numbers) == 1).tolist()
        return [pair for i in neighbours for pair in ((i, i + 1), (i + 1, i))]

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
        """Depth of chosen frame ``i``, certain everywhere."""
        depth = resize_labels(self._array("depth.npz", "depth")[self._numbers[i]].astype(np.float32), self._size)
        return Depth(depth, np.ones_like(depth))

    def flow(self, i: int, j: int) -> Flow:
        """Flow between chosen neighbours; its confidence is 1 where the point is visible in both frames."""
        direction = "fwd" if j > i else "bwd"
        n = self._numbers[i]
        flow = resize_labels(self._array("flow.npz", direction, 2)[n].astype(np.float32), self._size)
        valid = resize_labels(self._array("flow.npz", f"{direction}_valid")[n].astype(np.float32), self._size)
        scale = np.array(self._size, np.float32) / [self._stored[0].width, self._stored[0].height]
        return Flow(i, j, (flow * scale).astype(np.float32), valid)

    def mask(self, i: int) -> np.ndarray:
        """[H, W] uint8 object numbers of chosen frame ``i``."""
        return _read_mask(self._folder / "masks" / f"{self._numbers[i]:05d}.png", self._stored[0], self._size)


def _read_mask(path: Path, camera: Camera, size: tuple[int, int]) -> np.ndarray:
    labels = read_labels(path)
    if labels.shape != (camera.height, camera.width):
        raise InputError(f"{path} is {labels.shape[1]}x{labels.shape[0]} pixels, its camera {camera.width}x{camera.height}.")
    return resize_labels(labels.astype(np.uint8), size)


@dataclass(kw_only=True)
class RigClip(Clip):
    """A rig scene.

    Attributes:
        paths: [T] the chosen pictures.
        stored: camera of the first picture, at its stored size.
        heldout: the folder of held-out cameras.
        heldout_views: what it holds at the times of chosen frames, with cameras at the stored size.
    """

    paths: list[Path]
    stored: Camera
    heldout: Path
    heldout_views: list[HeldoutView]

    @property
    def num_views(self) -> int:
        """Pictures by the held-out cameras."""
        return len(self.heldout_views)

    def frames(self, numbers: Sequence[int]) -> Iterator[np.ndarray]:
        for i in numbers:
            yield self._read(self.paths[i], self.stored, (self.width, self.height))

    def views(self) -> Iterator[ViewPicture]:
        for view in self.heldout_views:
            camera_name, time = view.name.rsplit("_", 1)
            stored = view.camera
            camera = stored.resized(
                round(stored.width * self.width / self.stored.width), round(stored.height * self.height / self.stored.height)
            )
            size = camera.width, camera.height
            masks = []
            for kind in ("masks", "covisible"):
                path = self.heldout / f"{camera_name}_{kind}" / f"{time}.png"
                masks.append(_read_mask(path, stored, size) > 0 if path.exists() else None)
            image = self._read(self.heldout / camera_name / f"{time}.png", stored, size)
            yield ViewPicture(HeldoutView(view.name, view.frame, camera), image, *masks)

    @staticmethod
    def _read(path: Path, camera: Camera, size: tuple[int, int]) -> np.ndarray:
        image = read_picture(path)
        if image.shape[:2] != (camera.height, camera.width):
            raise InputError(f"{path} is {image.shape[1]}x{image.shape[0]} pixels, its camera {camera.width}x{camera.height}.")
        return resize_picture(image, size)


def _heldout_views(folder: Path, numbers: np.ndarray) -> list[HeldoutView]:
    path = folder / "cameras.json"
    if not path.exists():
        return []
    values = read_json(path)
    views = []
    try:
        for name, camera in values["cameras"].items():
            poses = _cameras(path, values, camera["w2c"])
            for time, pose in zip(camera["times"], poses, strict=True):
                views += [HeldoutView(f"{name}_{time:05d}", int(i), pose) for i in np.flatnonzero(numbers == time)]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path} does not hold the held-out cameras: {error}.") from error
    return views


def open_rig(folder: Path, options: InputOptions) -> RigClip:
    """Open a rig scene with its truth and its held-out views.

    Raises:
        InputError: a file is missing, damaged or does not fit.
    """
    folder = Path(folder)
    values = read_json(folder / "cameras.json")
    if not isinstance(values, dict) or "w2c" not in values:
        raise InputError(f"{folder / 'cameras.json'} does not hold the cameras of a rig scene: it has no 'w2c'.")
    cameras = _cameras(folder / "cameras.json", values, values["w2c"])
    paths = list_pictures(folder / "rgb")
    if len(paths) != len(cameras):
        raise InputError(f"{folder} has {len(paths)} pictures in rgb/ but {len(cameras)} cameras in cameras.json.")
    fps = float(values.get("fps", options.fps))
    selection = select_frames(np.arange(len(paths)) / fps, options, str(folder))
    (width, height), notes = working_size(cameras[0].width, cameras[0].height, options, str(folder))
    return RigClip(
        name=folder.resolve().name,
        source=str(folder),
        width=width,
        height=height,
        timestamps=selection.timestamps,
        source_fps=fps,
        notes=selection.notes + notes,
        truth=RigTruth(folder, cameras, selection.numbers, (width, height)),
        paths=[paths[n] for n in selection.numbers],
        stored=cameras[0],
        heldout=folder / "heldout",
        heldout_views=_heldout_views(folder / "heldout", selection.numbers),
    )
