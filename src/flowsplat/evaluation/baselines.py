"""Compute baselines without a model: a held-out image predicted from the clip's own frames.

A 4D model that does not beat ``flow_interpolation`` has not learned the scene's motion. All images are float32 RGB
[H, W, 3] between 0 and 1.
"""

from __future__ import annotations

import bisect

import cv2
import numpy as np

from flowsplat.geometry import Camera
from flowsplat.geometry.cameras import pixel_grid, unproject_depth
from flowsplat.geometry.interpolation import sample_map
from flowsplat.priors.flow import dis_flow, gray
from flowsplat.scenes import Scene

SURFACE_DEPTH_RATIO = 1.02
"""A splatted pixel this much deeper than the nearest one still belongs to its surface. Chosen by eye."""

MIN_COVER = 0.5
"""Target pixels that receive less weight than this are holes. Chosen by eye."""

INPAINT_RADIUS = 3
"""Pixels around a hole from which ``cv2.inpaint`` fills it. Chosen by eye."""


def to_float(image: np.ndarray) -> np.ndarray:
    """uint8 to float32 between 0 and 1."""
    return image.astype(np.float32) / 255


def predict_frame(scene: Scene, i: int) -> dict[str, np.ndarray]:
    """Held-out frame ``i`` predicted from its two neighboring training frames.

    Returns:
        ``copy`` (the previous one), ``blend`` (both, weighted by time) and ``flow_interpolation`` (both warped to the
        time between them by the flow from one to the other, then blended). Before the first training frame and after the
        last there is one neighbor only, and each of the three is that.
    """
    following = bisect.bisect(scene.train_frames, i)
    if following in (0, len(scene.train_frames)):
        only = to_float(scene.frame(scene.train_frames[0 if following == 0 else -1]))
        return {"copy": only, "blend": only, "flow_interpolation": only}
    before, after = scene.train_frames[following - 1], scene.train_frames[following]
    span = scene.timestamps[after] - scene.timestamps[before]
    fraction = float((scene.timestamps[i] - scene.timestamps[before]) / span)
    first, second = scene.frame(before), scene.frame(after)
    a, b = to_float(first), to_float(second)
    # Looked up at the target's pixels, not carried there: right to first order in the flow's gradient.
    moved_a = _look_up(a, -fraction * dis_flow(gray(first), gray(second)))
    moved_b = _look_up(b, -(1 - fraction) * dis_flow(gray(second), gray(first)))
    return {
        "copy": a,
        "blend": (1 - fraction) * a + fraction * b,
        "flow_interpolation": (1 - fraction) * moved_a + fraction * moved_b,
    }


def _look_up(image: np.ndarray, flow: np.ndarray) -> np.ndarray:
    """Return the image whose pixel p is the pixel p + flow(p) of ``image``."""
    height, width = image.shape[:2]
    return sample_map(image, (pixel_grid(width, height) + flow).reshape(-1, 2)).reshape(image.shape)


def copy_to_view(image: np.ndarray, view: Camera) -> np.ndarray:
    """Return the clip's frame (uint8) as it is, in the size of the other camera's image."""
    size = (view.width, view.height)
    return to_float(image if image.shape[1::-1] == size else cv2.resize(image, size, interpolation=cv2.INTER_AREA))


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
