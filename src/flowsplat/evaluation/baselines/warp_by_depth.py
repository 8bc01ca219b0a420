"""Of a view: the clip's frame of its time, carried there by its true depth and cameras."""

from __future__ import annotations

import cv2
import numpy as np

from flowsplat.common.registry import Entry
from flowsplat.evaluation.baselines import BASELINES, Baseline, HeldoutImage, to_float
from flowsplat.geometry import Camera
from flowsplat.geometry.cameras import unproject_depth

SURFACE_DEPTH_RATIO = 1.02
"""A splatted pixel this much deeper than the nearest one still belongs to its surface. Chosen by eye."""

MIN_COVER = 0.5
"""Target pixels that receive less weight than this are holes. Chosen by eye."""

INPAINT_RADIUS = 3
"""Pixels around a hole from which ``cv2.inpaint`` fills it. Chosen by eye."""


def predict_by_depth(image: HeldoutImage) -> np.ndarray | None:
    """Return the frame as the view sees it, where the truth is known."""
    truth, view = image.scene.truth, image.view
    if view is None or truth is None or not (truth.has_cameras and truth.has_depth(view.frame)):
        return None
    return warp_by_depth(image.frame_of_view, truth.depth(view.frame).depth, truth.cameras[view.frame], view.camera)


def warp_by_depth(image: np.ndarray, depth: np.ndarray, camera: Camera, view: Camera) -> np.ndarray:
    """Frame [H, W, 3] uint8 carried by its depth [H, W] from ``camera`` into ``view``.

    Every pixel lands on the four nearest target pixels with bilinear weights, the nearest surface wins, and holes are
    inpainted (Telea, https://doi.org/10.1080/10867651.2004.10487596).
    """
    uv, z = view.project(unproject_depth(depth, camera))
    corner = np.floor(uv - 0.5).astype(np.int64)
    offset = uv - 0.5 - corner
    count = view.width * view.height
    nearest = np.full(count, np.inf)
    splats = []
    for step in np.array([[0, 0], [1, 0], [0, 1], [1, 1]]):
        x, y = np.moveaxis(corner + step, -1, 0)
        weight = np.where(step == 1, offset, 1 - offset).prod(-1)
        lands = (z > 0) & (weight > 0) & (x >= 0) & (y >= 0) & (x < view.width) & (y < view.height)
        target, weight, distance = (y * view.width + x)[lands], weight[lands], z[lands]
        # A pixel that only grazes the target must not hide what lies behind it.
        substantial = weight > 0.1
        np.minimum.at(nearest, target[substantial], distance[substantial])
        splats.append((target, weight, distance, image[lands]))
    color, cover = np.zeros((count, 3)), np.zeros(count)
    for target, weight, distance, pixels in splats:
        front = distance <= nearest[target] * SURFACE_DEPTH_RATIO
        target, weight = target[front], weight[front]
        cover += np.bincount(target, weight, count)
        for channel in range(3):
            color[:, channel] += np.bincount(target, weight * pixels[front, channel], count)
    shape = (view.height, view.width)
    warped = np.round(color / np.maximum(cover, 1e-9)[:, None]).clip(0, 255).astype(np.uint8).reshape(*shape, 3)
    holes = (cover < MIN_COVER).astype(np.uint8).reshape(shape)
    return to_float(cv2.inpaint(warped, holes, INPAINT_RADIUS, cv2.INPAINT_TELEA))


WARP = Baseline(predict_by_depth, of_frames=False)
BASELINES.add(Entry("warp_by_depth", "warped by true depth", "The frame, carried by its true depth.", WARP, place=40))
