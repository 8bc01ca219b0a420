"""Make the work load that is rendered: Gaussians on a surface with round objects, as dense as a trained scene's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from flowsplat.geometry import Camera

COUNT, WIDTH, HEIGHT = 100_000, 854, 480
FIELDS = ("means", "quats", "scales", "opacities")
OBJECTS = ((-0.2, 0.05, 0.12, 3.0), (0.15, -0.05, 0.17, 3.8), (0.3, 0.12, 0.08, 2.5), (0.0, 0.15, 0.1, 2.8))
"""Balls: center x, y and radius in widths of the image, and the depth of their rim."""


@dataclass(frozen=True)
class WorkLoad:
    """N Gaussians, all of them in the image of a camera at the origin.

    Attributes:
        means: [N, 3] float32.
        quats: [N, 4] float32, not normalized.
        scales: [N, 3] float32.
        opacities: [N] float32 between 0.1 and 0.99.
        colors: [N, 3] float32.
        camera: who sees them.
    """

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    colors: np.ndarray
    camera: Camera

    def leaves(self) -> dict[str, torch.Tensor]:
        """``FIELDS`` as tensors that want gradients."""
        return {name: torch.from_numpy(getattr(self, name)).requires_grad_() for name in FIELDS}


def work_load(count: int = COUNT, width: int = WIDTH, height: int = HEIGHT, footprint: float = 1.0, seed: int = 0) -> WorkLoad:
    """Return the work load of a size.

    85 % of the Gaussians are small and evenly spread, with a standard deviation of about 1.35 pixels; 15 % are large, about 4
    pixels, and anywhere. At 100,000, 854 x 480 and footprint 1 these are 43.6 pairs a pixel and 305,000 instances (``floor``).

    Args:
        count: N.
        width: pixels.
        height: pixels.
        footprint: factor on the standard deviations in pixels.
        seed: of the random choices.
    """
    rng = np.random.default_rng(seed)
    small = count - count * 15 // 100
    columns = int(np.ceil(np.sqrt(small * width / height)))
    rows = -(-small // columns)
    y, x = np.divmod(rng.permutation(columns * rows)[:small], columns)
    u = np.concatenate([(x + rng.random(small)) / columns, rng.uniform(-0.02, 1.02, count - small)]) * width
    v = np.concatenate([(y + rng.random(small)) / rows, rng.uniform(-0.02, 1.02, count - small)]) * height

    depth = _surface((u - width / 2) / width, (v - height / 2) / width) * (1 + 0.02 * rng.standard_normal(count))
    depth[small:] *= 1 + 0.15 * np.abs(rng.standard_normal(count - small))
    focal = 0.85 * width
    sigma = np.where(np.arange(count) < small, 1.35, 4.0) * footprint
    sigma *= np.exp(np.where(np.arange(count) < small, 0.25, 0.35) * rng.standard_normal(count))
    scales = (sigma * depth / focal)[:, None] * np.exp(0.35 * rng.standard_normal((count, 3)))
    means = np.stack([(u - width / 2) / focal * depth, (v - height / 2) / focal * depth, depth], 1)
    phases = np.arange(3)
    colors = 0.5 + 0.5 * np.sin(17 * u[:, None] / width + phases) * np.cos(25 * v[:, None] / width + 2 * phases)
    quats, opacities = rng.standard_normal((count, 4)), rng.uniform(0.1, 0.99, count)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    camera = Camera(np.eye(4), K, width, height)
    means, quats, scales, opacities, colors = map(_single, (means, quats, scales, opacities, colors))
    return WorkLoad(means, quats, scales, opacities, colors, camera)


def _single(values: np.ndarray) -> np.ndarray:
    return values.astype(np.float32)


def _surface(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return depth of a bumpy ground and of the balls in front of it."""
    depth = 6 - 4 * y + 0.6 * np.sin(9 * x) * np.cos(7 * y)
    for center_x, center_y, radius, rim in OBJECTS:
        inside = radius**2 - (x - center_x) ** 2 - (y - center_y) ** 2
        depth = np.where(inside > 0, rim - 3 * np.sqrt(np.maximum(inside, 0)), depth)
    return depth
