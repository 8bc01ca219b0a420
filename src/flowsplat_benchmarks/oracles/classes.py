"""Kinds of pixels of a rendered scene, by its truth, and how much of the error of images and of static depth each holds."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from flowsplat.common.spread import spread
from flowsplat.geometry import Camera
from flowsplat.geometry.cameras import unproject_depth
from flowsplat.images.colors import error_to_color, float_to_bytes
from flowsplat.images.sheets import side_by_side, stack
from flowsplat.scenes import HeldoutView, Scene
from flowsplat.scenes.layers import read_image
from flowsplat_benchmarks.oracles.objects import depth_scale, masks_of, truth_of

CLASSES = (
    "moves", "never seen", "few frames", "border", "near objects", "thin", "behind edges", "before edges", "dull", "rest",
)  # fmt: skip
"""A pixel belongs to the first of these that it is."""

ASKED_FRAMES = 24
"""Training frames that are asked whether they saw a point, evenly over the clip. Chosen by eye."""
MIN_WITNESSES = 4
"""Witnesses that saw it are few below this. Chosen by eye."""
SURFACE_TOLERANCE = 0.02
"""Share of its distance by which a point may lie behind the surface that a frame sees. Chosen by eye."""
EDGE_DEPTH_JUMP = 0.05
"""Share of its distance by which depth differs at an edge. Chosen by eye."""
EDGE_REACH = 4
"""Pixels from an edge. Chosen by eye."""
MAX_THIN_PIXELS = 9
"""Pixels; what is narrower is thin. Chosen by eye."""
OBJECT_REACH = 8
"""Pixels from an object. Chosen by eye."""
BORDER_SHARE = 0.04
"""Share of the image's size from its border. Chosen by eye."""
MAX_DULL_SIGMA = 4.0
"""Gray levels of 255: standard deviation in a window of seven pixels. Chosen by eye."""

_COLORS = np.array(
    [(90, 90, 90), (255, 60, 60), (255, 150, 0), (255, 230, 0), (180, 110, 255), (0, 190, 255), (60, 90, 255), (120, 220, 160),
     (200, 200, 200), (20, 20, 20)], np.uint8,
)  # fmt: skip


class PixelClasses:
    """Which of ``CLASSES`` each pixel of a training frame or of a held-out view is."""

    def __init__(self, scene: Scene):
        """
        Args:
            scene: with truth; its own priors do not matter.

        Raises:
            InputError: it has none.
        """
        self._scene, self._truth = scene, truth_of(scene)
        self._witnesses = []
        for k in spread(len(scene.train_frames), ASKED_FRAMES):
            i = scene.train_frames[k]
            rests = self._truth.mask(i) == 0
            self._witnesses.append((self._truth.cameras[i], np.where(rests, self._truth.depth(i).depth, 0).astype(np.float32)))

    def of_frame(self, i: int) -> np.ndarray:
        """Return [H, W] uint8 indices of ``CLASSES`` of training frame ``i``."""
        depth, moves = self._truth.depth(i).depth, self._truth.mask(i) > 0
        near_border = _near_border(depth.shape)
        return _classes(self._scene.frame(i), depth, moves, self._count_witnesses(depth, self._truth.cameras[i]), near_border)

    def of_view(self, view: HeldoutView) -> np.ndarray:
        """Return [H, W] uint8 of a held-out view. Its depth is that of the clip's frames; what they did not see was never seen."""
        own, moves = self._truth.cameras[view.frame], self._scene.view_mask(view)
        width, height = view.camera.width, view.camera.height
        nearest = np.full(width * height, np.inf)
        for camera, surface in [*self._witnesses, (own, self._truth.depth(view.frame).depth)]:
            _splat(nearest, view.camera, unproject_depth(surface, camera)[surface > 0])
        depth = np.where(np.isfinite(nearest), nearest, 0).astype(np.float32).reshape(height, width)
        seen = self._count_witnesses(depth, view.camera)
        # Where the clip's image of the same time ends.
        pixels, ahead = own.project(unproject_depth(depth, view.camera))
        margin = BORDER_SHARE * np.array([own.width, own.height])
        inside = (ahead > 0) & (pixels >= margin).all(-1) & (pixels <= [own.width, own.height] - margin).all(-1)
        moves = np.zeros_like(seen, bool) if moves is None else moves > 0
        return _classes(self._scene.view_image(view), depth, moves, seen, ~inside)

    def _count_witnesses(self, depth: np.ndarray, camera: Camera) -> np.ndarray:
        """Return [H, W] int: how many witnesses saw the point of each pixel at rest."""
        points, seen = unproject_depth(depth, camera).reshape(-1, 3), np.zeros(depth.size, int)
        for witness, surface in self._witnesses:
            # At edges a point may be seen on either side: the farther surface around a pixel counts.
            surface = cv2.dilate(surface, np.ones((3, 3), np.uint8))
            pixels, ahead = witness.project(points)
            column, row = np.floor(pixels.clip(-1e6, 1e6)).astype(int).T
            inside = (ahead > 0) & (column >= 0) & (row >= 0) & (column < witness.width) & (row < witness.height)
            seen[inside] += ahead[inside] <= (1 + SURFACE_TOLERANCE) * surface[row[inside], column[inside]]
        found: np.ndarray = np.where(depth.reshape(-1) > 0, seen, 0).reshape(depth.shape)
        return found


def _splat(nearest: np.ndarray, view: Camera, points: np.ndarray) -> None:
    """Put points [N, 3] into the depth of an image, [height * width], each on the two by two pixels around it."""
    pixels, depth = view.project(points)
    corner = np.floor(pixels.clip(-1e6, 1e6) - 0.5).astype(int)
    for step in ((0, 0), (1, 0), (0, 1), (1, 1)):
        x, y = (corner + step).T
        lands = (depth > 0) & (x >= 0) & (y >= 0) & (x < view.width) & (y < view.height)
        np.minimum.at(nearest, y[lands] * view.width + x[lands], depth[lands])


def _near_border(shape: tuple[int, ...]) -> np.ndarray:
    near = np.ones(shape, bool)
    rows, columns = (max(round(BORDER_SHARE * size), 1) for size in shape)
    near[rows:-rows, columns:-columns] = False
    return near


def _classes(image: np.ndarray, depth: np.ndarray, moves: np.ndarray, seen: np.ndarray, near_border: np.ndarray) -> np.ndarray:
    nearness = np.where(depth > 0, 1 / np.maximum(depth, 1e-9), 0).astype(np.float32)
    around = np.ones((2 * EDGE_REACH + 1, 2 * EDGE_REACH + 1), np.uint8)
    gray = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY).astype(np.float32)
    variance = cv2.blur(gray**2, (7, 7)) - cv2.blur(gray, (7, 7)) ** 2
    beyond = np.pad(nearness, MAX_THIN_PIXELS, mode="reflect", reflect_type="odd")  # slopes go on beyond the border
    opened = cv2.morphologyEx(
        beyond, cv2.MORPH_OPEN, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (MAX_THIN_PIXELS, MAX_THIN_PIXELS))
    )
    wide = opened[MAX_THIN_PIXELS:-MAX_THIN_PIXELS, MAX_THIN_PIXELS:-MAX_THIN_PIXELS]
    jumps = _jumps(nearness)
    found = np.full(depth.shape, CLASSES.index("rest"), np.uint8)
    is_of: dict[str, np.ndarray] = {
        "moves": moves,
        "never seen": seen == 0,
        "few frames": seen < MIN_WITNESSES,
        "border": near_border,
        "near objects": cv2.dilate(moves.astype(np.uint8), np.ones((2 * OBJECT_REACH + 1, 2 * OBJECT_REACH + 1), np.uint8)) > 0,
        "thin": nearness > (1 + EDGE_DEPTH_JUMP) * wide,
        "behind edges": cv2.dilate(np.where(jumps, nearness, 0), around) > (1 + EDGE_DEPTH_JUMP / 2) * nearness,
        "before edges": cv2.dilate(jumps.astype(np.uint8), around) > 0,
        "dull": variance < MAX_DULL_SIGMA**2,
    }
    for name in reversed(CLASSES[:-1]):
        found[is_of[name]] = CLASSES.index(name)
    return found


def _jumps(nearness: np.ndarray) -> np.ndarray:
    """Return [H, W] bool: the nearer of two neighboring pixels between which depth jumps; second differences, so that slopes do
    not."""
    jumps = np.zeros(nearness.shape, bool)
    for axis in (0, 1):
        moved = np.moveaxis(nearness, axis, 0)
        step = np.diff(moved, axis=0)
        before, after = np.concatenate([step[1:2], step[:-1]]), np.concatenate([step[1:], step[-2:-1]])
        slope = np.where(np.abs(before) < np.abs(after), before, after)
        far = np.abs(step - slope) > EDGE_DEPTH_JUMP * np.minimum(moved[1:], moved[:-1])
        view = np.moveaxis(jumps, axis, 0)
        view[1:] |= far & (step > 0)
        view[:-1] |= far & (step < 0)
    return jumps


def view_errors(scene: Scene, renders: Path) -> dict[str, Any] | None:
    """Return the squared error of a run's held-out views by class, and how many pixels each class has.

    Args:
        renders: folder with ``<view>.png``.

    Returns:
        ``views`` their names, ``pixels`` and ``squared`` a list for each view with a number for each of ``CLASSES``; squared
        is the sum over pixels of the mean square over the colors, these between 0 and 1. None without views.
    """
    classes = PixelClasses(scene)
    names, pixels, squared = [], [], []
    for view in scene.views:
        path = renders / f"{view.name}.png"
        if path.exists():
            kinds = classes.of_view(view).reshape(-1)
            names.append(view.name)
            pixels.append(np.bincount(kinds, minlength=len(CLASSES)).tolist())
            squared.append([round(x, 4) for x in np.bincount(kinds, _square_errors(scene, view, path).reshape(-1), len(CLASSES))])
    return {"views": names, "pixels": pixels, "squared": squared} if names else None


def _square_errors(scene: Scene, view: HeldoutView, path: Path) -> np.ndarray:
    difference = read_image(path).astype(np.float32) - scene.view_image(view)
    mean: np.ndarray = (difference**2).mean(-1) / 255**2
    return mean


def psnr_by_class(errors: dict[str, Any]) -> list[float | None]:
    """PSNR of all pixels of a class, of every class; None where there are none."""
    pixels, squared = np.sum(errors["pixels"], 0), np.sum(errors["squared"], 0)
    return [float(-10 * np.log10(max(s / p, 1e-10))) if p else None for p, s in zip(pixels, squared, strict=True)]


def gains(errors: dict[str, Any], better: dict[str, Any]) -> list[float]:
    """dB of all of the image, the mean of the views, that each class alone gains with the error that it has in another run."""
    pixels = np.sum(errors["pixels"], 1)
    before, after = np.array(errors["squared"]), np.array(better["squared"])
    total = before.sum(1)
    each = -10 * np.log10((total[:, None] - before + after) / total[:, None])
    assert pixels.shape == total.shape
    return [float(x) for x in each.mean(0)]


def static_depth_errors(scene: Scene) -> list[dict[str, float | None]]:
    """Return how wrong the depth of what rests is in training frames, for each of ``CLASSES`` and then for all but what moves.

    Filled pixels included; those that lie in the scene's masks are left out, which are not static there.

    Returns:
        for each ``pixels``, and of |estimated / true - 1| the ``median`` and ``p90``, the 90th percentile.
    """
    classes, scale, truth = PixelClasses(scene), depth_scale(scene), truth_of(scene)
    kinds, off = [], []
    for i, mask, true_mask in masks_of(scene):
        static = (mask == 0) & (true_mask == 0)
        kinds.append(classes.of_frame(i)[static])
        off.append(np.abs(scene.depth(i).depth[static] / (scale * truth.depth(i).depth[static]) - 1).astype(np.float32))
    kind, error = np.concatenate(kinds), np.concatenate(off)
    return [_percentiles(error[kind == k]) for k in range(len(CLASSES))] + [_percentiles(error)]


def _percentiles(values: np.ndarray) -> dict[str, float | None]:
    if not len(values):
        return {"pixels": 0, "median": None, "p90": None}
    median, upper = np.percentile(values, [50, 90])
    return {"pixels": len(values), "median": float(median), "p90": float(upper)}


def error_sheet(scene: Scene, renders: Path, views: Sequence[str]) -> np.ndarray | None:
    """Truth, rendering, error and classes of some views under each other; None where none of them was rendered."""
    classes, rows = PixelClasses(scene), []
    for view in scene.views:
        path = renders / f"{view.name}.png"
        if view.name in views and path.exists():
            target, image = scene.view_image(view), read_image(path)
            kinds = (0.3 * target + 0.7 * _COLORS[classes.of_view(view)]) / 255
            panels = (target, image, error_to_color(target, image), float_to_bytes(kinds))
            rows.append(side_by_side(panels, ("truth", "rendered", "error", "classes")))
    return stack(rows) if rows else None


def legend() -> np.ndarray:
    """Return the colors of the classes in ``error_sheet`` with their names, [24, W, 3] uint8."""
    swatches = [np.full((24, 110, 3), color, np.uint8) for color in _COLORS]
    return side_by_side(swatches, CLASSES)
