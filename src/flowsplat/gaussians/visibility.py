"""Measure how much of a view the clip has seen: by how many of its frames, and from how wide a range of places.

A point of the still scene that few frames saw is filled in by guess. How far away a point is that many saw is known as well as
their directions differ: with noise n in pixels of each, and directions that differ by s (root mean square) from their mean, it is
wrong by n / s pixels for each unit by which a new direction differs. So what counts is how many times s a new direction is off.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch

from flowsplat.common.spread import spread
from flowsplat.common.threads import in_threads
from flowsplat.gaussians.confidence_fade import MAX_DIRECTION_DIFFERENCE, MAX_SPREADS, MIN_FRAMES
from flowsplat.gaussians.model import SceneModel, at_once
from flowsplat.gaussians.renderer import PartedRenderer
from flowsplat.geometry import Camera
from flowsplat.geometry.cameras import unproject_depth

ASKED_FRAMES = 32
"""Frames of the clip that are asked, evenly over it (docs/method/evaluation.md)."""
SMALL_WIDTH = 160
"""Pixels of width of the images that are looked at. Chosen by eye."""
_MIN_ALPHA = 0.5
"""Alpha from which something is there. Chosen by eye."""
_SURFACE_TOLERANCE = 0.05
"""Share of its distance by which a point may lie behind the surface that a frame sees (docs/method/evaluation.md)."""
_MIN_SPREAD = 1e-6
"""Spread of directions, at least, so that a division stays finite."""
_MIN_DISTANCE_SHARE = 0.5
"""Share of the distance of the nearest object from the clip's camera, below which a camera is too close to one
(docs/method/evaluation.md)."""


@dataclass(frozen=True)
class Seen:
    """What the clip has seen of a view, each [h, w] of a small image of it.

    Attributes:
        there: whether anything is rendered there.
        moves: whether an object is: it is there in its own frame, and not asked about.
        frames: how many of the frames that were asked saw the point of the still scene.
        off: by how many times the spread of their directions the view's differs from their mean; huge where
            no two differ, but for a view from there.
    """

    there: np.ndarray
    moves: np.ndarray
    frames: np.ndarray
    off: np.ndarray

    @property
    def is_known(self) -> np.ndarray:
        """[h, w] bool: the clip tells what is seen there."""
        still = (self.frames >= MIN_FRAMES) & (self.off <= MAX_SPREADS)
        return self.there & (self.moves | still)

    @property
    def is_seen(self) -> np.ndarray:
        """[h, w] bool: a frame of the clip has seen it, be it once."""
        return self.there & (self.moves | (self.frames > 0))


class ClipVisibility:
    """The frames of a clip as witnesses of a trained scene."""

    def __init__(self, model: PartedRenderer, cameras: Sequence[Camera], times: Sequence[float]):
        """
        Args:
            model: the scene.
            cameras: [T] of the clip.
            times: [T] seconds of its frames.
        """
        self._background, self._objects = model.part("background"), model.part("objects")
        self.threads = at_once(model)

        def witness(k: int) -> tuple[Camera, np.ndarray]:
            camera = _small(cameras[k])
            still, hidden = self._background.render(camera, times[k]), self._objects.render(camera, times[k]).alpha >= _MIN_ALPHA
            # At edges a point may be seen on either side: the farther surface around a pixel counts.
            surface = cv2.dilate(np.where(still.alpha >= _MIN_ALPHA, still.depth, 0).astype(np.float32), np.ones((3, 3), np.uint8))
            return camera, np.where(hidden, 0, surface)

        self._witnesses = list(in_threads(witness, spread(len(cameras), ASKED_FRAMES), self.threads))

    def compute_seen(self, camera: Camera, t: float) -> Seen:
        """Return what the clip has seen of the view of a camera, in the scene's coordinates, at ``t`` seconds."""
        camera = _small(camera)
        still, objects = self._background.render(camera, t), self._objects.render(camera, t)
        there, moves = still.alpha >= _MIN_ALPHA, objects.alpha >= _MIN_ALPHA
        points = unproject_depth(still.depth, camera).reshape(-1, 3)
        count, mean, spread_of = self.directions(points)
        away = np.linalg.norm(_unit(camera.center - points) - mean, axis=1)
        off = away / spread_of
        return Seen(there | moves, moves, count.reshape(there.shape), off.reshape(there.shape))

    def directions(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """From where the clip has seen points [N, 3] of the still scene, in its coordinates.

        Returns:
            how many of the frames that were asked saw each [N], the mean direction [N, 3] from the point to them, of length 1, and
            the root mean square of the differences from it [N], next to nothing where none saw it.
        """
        total, count = np.zeros((len(points), 3)), np.zeros(len(points), int)
        for witness, surface in self._witnesses:
            pixels, depth = witness.project(points)
            column, row = np.floor(np.nan_to_num(pixels, nan=-1)).astype(int).T
            inside = (depth > 0) & (column >= 0) & (row >= 0) & (column < witness.width) & (row < witness.height)
            saw = np.zeros(len(points), bool)
            saw[inside] = depth[inside] <= (1 + _SURFACE_TOLERANCE) * surface[row[inside], column[inside]]
            ray = _unit(witness.center - points)
            total[saw] += ray[saw]
            count[saw] += 1
        mean = total / np.maximum(count, 1)[:, None]
        # Of unit vectors the mean square distance from their mean is one less the square of its length.
        squared = np.where(count > 0, 1 - (mean**2).sum(1), 0)
        return count, _unit(mean), np.sqrt(np.maximum(squared, _MIN_SPREAD**2))

    def share(self, camera: Camera, t: float) -> float:
        """Return share of a view that the clip does not tell, 0 to 1."""
        return float(1 - self.compute_seen(camera, t).is_known.mean())

    def unseen_share(self, camera: Camera, t: float) -> float:
        """Return share of a view that no frame has seen, 0 to 1."""
        return float(1 - self.compute_seen(camera, t).is_seen.mean())

    def keeps_clear(self, camera: Camera, own: Camera, t: float) -> bool:
        """Return whether a camera is not much nearer to any object than the clip's ``own`` at that time."""
        there, here = (self._nearest_object(each, t) for each in (camera, own))
        return there >= _MIN_DISTANCE_SHARE * here

    def _nearest_object(self, camera: Camera, t: float) -> float:
        shown = self._objects.render(_small(camera), t)
        depth = shown.depth[shown.alpha >= _MIN_ALPHA]
        return float(np.percentile(depth, 5)) if depth.size else np.inf


def with_seen(model: SceneModel, cameras: Sequence[Camera], times: Sequence[float]) -> SceneModel:
    """Return the scene with what the clip has seen of each of its Gaussians (``Gaussians4D.seen``).

    What moves is seen from wherever it turns to: it has the frames in which it is there, and directions from all around.

    Args:
        model: the trained scene.
        cameras: [T] of the clip.
        times: [T] seconds of its frames.
    """
    gaussians = model.gaussians
    background = torch.nonzero(~gaussians.dynamic).squeeze(1)
    points = model.similarity.inverse().points(gaussians.params["means"][background].double().cpu().numpy())
    count, _, spread_of = ClipVisibility(model, cameras, times).directions(points)
    seen = torch.zeros(len(gaussians), 2, device=gaussians.device)
    for k in spread(len(cameras), ASKED_FRAMES):
        seen[gaussians.active(model.clip_time(times[k])).rows, 0] += 1
    seen[:, 1] = MAX_DIRECTION_DIFFERENCE
    seen[background] = torch.from_numpy(np.stack([count, spread_of], 1)).to(seen)
    return replace(model, gaussians=replace(gaussians, seen=seen))


def _small(camera: Camera) -> Camera:
    width = max(min(SMALL_WIDTH, camera.width // 2), 1)
    return camera.resize(width, max(round(camera.height * width / camera.width), 1))


def _unit(vectors: np.ndarray) -> np.ndarray:
    unit: np.ndarray = vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
    return unit
