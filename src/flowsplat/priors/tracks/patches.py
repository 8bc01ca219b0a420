"""Patches of texture and where they are in another image: an affine Lucas-Kanade alignment for many points at once.

The inverse compositional form (Baker and Matthews, "Lucas-Kanade 20 Years On", IJCV 2004) with a Gaussian window, a patch's own
mean and contrast removed, and damping, so that what texture does not tell stays as it was predicted. Positions count pixels
from 0 at the center of the first one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import float32

from flowsplat.common.kernels import helper, inline, kernel
from flowsplat.common.threads import parallel_for

PATCH_RADIUS = 6
"""Pixels from the center of a patch to its border. Chosen by eye."""
PATCH_SIDE = 2 * PATCH_RADIUS + 1
"""Pixels across a patch."""
ALIGNMENT_ITERATIONS = 8
"""Gauss-Newton steps of an alignment. Chosen by eye."""
MIN_STEP = np.float32(0.01)
"""Pixels; a smaller step ends the search. Chosen by eye."""
DAMPING = np.float32(2.0)
"""Added to the mean square gradient (gray levels a pixel): noise. Chosen by eye."""
AFFINE_STIFFNESS = np.float32(6.0)
"""The same for the affine part, whose unit is a shift of the patch's border by a pixel. Chosen by eye."""
MAX_SHIFT = np.float32(4.0)
"""Pixels that an alignment may move a point: farther away is something similar, not the same. Chosen by eye."""
CONTRAST, BRIGHTNESS = np.float32(58.5), np.float32(58.5)
"""(0.03 x 255)^2, the constants of structural similarity: differences below them count as noise."""

_ALONG = np.arange(-PATCH_RADIUS, PATCH_RADIUS + 1, dtype=np.float32)
_OFFSETS = np.stack(np.meshgrid(_ALONG, _ALONG), -1).reshape(-1, 2)
_WINDOW = np.exp(-0.5 * (_OFFSETS**2).sum(1) / (0.6 * PATCH_RADIUS) ** 2).astype(np.float32)


@dataclass
class Patches:
    """Textures [N, PATCH_SIDE^2] with their gradients along x and y, and the weights (sum 1) of their pixels; all float32."""

    gray: np.ndarray
    right: np.ndarray
    down: np.ndarray
    weights: np.ndarray

    @staticmethod
    def cut(image: np.ndarray, labels: np.ndarray, points: np.ndarray) -> Patches:
        """Patches of float32 gray [H, W] round ``points`` [N, 2]; pixels of another label [H, W] than the center do not count."""
        count = len(points)
        arrays = [np.empty((count, PATCH_SIDE * PATCH_SIDE), np.float32) for _ in range(4)]
        parallel_for(_cut, len(points), image, labels.astype(np.int32, copy=False), np.asarray(points, np.float32), *arrays)
        return Patches(*arrays)

    def replace(self, rows: np.ndarray, other: Patches) -> None:
        """Replace the patches ``rows``."""
        for mine, new in zip(vars(self).values(), vars(other).values(), strict=True):
            mine[rows] = new

    def join(self, other: Patches) -> Patches:
        """These, then the others."""
        return Patches(*(np.concatenate(pair) for pair in zip(vars(self).values(), vars(other).values(), strict=True)))

    def __getitem__(self, rows: np.ndarray) -> Patches:
        return Patches(*(array[rows] for array in vars(self).values()))


def align(patches: Patches, image: np.ndarray, points: np.ndarray, shapes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where patches are in float32 gray ``image`` [H, W].

    Args:
        points: [N, 2] where they are expected.
        shapes: [N, 2, 2] how they are expected to have turned and stretched: offsets there = shape @ offsets in the patch.

    Returns:
        points [N, 2], shapes [N, 2, 2], and likeness [N]: structural similarity, 1 = the same; below 0 outside the image.
    """
    points, shapes = np.array(points, np.float32), np.array(shapes, np.float32)
    likeness = np.empty(len(points), np.float32)
    parallel_for(_align, len(points), patches.gray, patches.right, patches.down, patches.weights, image, points, shapes, likeness)
    return points, shapes, likeness


@inline
def _sample_inside(image, x, y):
    """Bilinear, for places that have four pixels round them."""
    j, i = np.int32(x), np.int32(y)
    u, v = x - float32(j), y - float32(i)
    top = image[i, j] + u * (image[i, j + 1] - image[i, j])
    bottom = image[i + 1, j] + u * (image[i + 1, j + 1] - image[i + 1, j])
    return top + v * (bottom - top)


@inline
def _sample(image, x, y):
    """Bilinear; the border continues."""
    height, width = image.shape
    return _sample_inside(image, min(max(x, float32(0)), float32(width - 1.001)), min(max(y, float32(0)), float32(height - 1.001)))


@kernel
def _cut(begin, end, image, labels, points, gray, right, down, weights):
    height, width = image.shape
    half = float32(0.5)
    for n in range(begin, end):
        x, y = points[n, 0], points[n, 1]
        own = labels[min(max(int(y + half), 0), height - 1), min(max(int(x + half), 0), width - 1)]
        total = float32(0)
        for k in range(len(_OFFSETS)):
            a, b = x + _OFFSETS[k, 0], y + _OFFSETS[k, 1]
            gray[n, k] = _sample(image, a, b)
            right[n, k] = half * (_sample(image, a + float32(1), b) - _sample(image, a - float32(1), b))
            down[n, k] = half * (_sample(image, a, b + float32(1)) - _sample(image, a, b - float32(1)))
            i, j = int(b + half), int(a + half)
            inside = i >= 0 and j >= 0 and i < height and j < width
            weights[n, k] = _WINDOW[k] if inside and labels[i, j] == own else float32(0)
            total += weights[n, k]
        for k in range(len(_OFFSETS)):
            weights[n, k] /= max(total, float32(1e-6))


@helper
def _solve(H, b):
    """Solve the positive definite H x = b in place (Gauss); b becomes x."""
    n = len(b)
    for i in range(n):
        for j in range(i + 1, n):
            factor = H[j, i] / H[i, i]
            for k in range(i, n):
                H[j, k] -= factor * H[i, k]
            b[j] -= factor * b[i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= H[i, k] * b[k]
        b[i] /= H[i, i]


@kernel
def _align(begin, end, gray, right, down, weights, image, points, shapes, likeness):
    height, width = image.shape
    pixels = len(_OFFSETS)
    unit = float32(1.0 / PATCH_RADIUS)
    for n in range(begin, end):
        mean, variance = float32(0), float32(0)
        for k in range(pixels):
            mean += weights[n, k] * gray[n, k]
        for k in range(pixels):
            variance += weights[n, k] * (gray[n, k] - mean) ** 2
        H0 = np.zeros((6, 6), np.float32)
        row = np.empty(6, np.float32)
        for k in range(pixels):
            u, v = _OFFSETS[k, 0] * unit, _OFFSETS[k, 1] * unit
            row[0], row[1] = right[n, k], down[n, k]
            row[2], row[3], row[4], row[5] = u * row[0], v * row[0], u * row[1], v * row[1]
            for i in range(6):
                for j in range(i, 6):
                    H0[i, j] += weights[n, k] * row[i] * row[j]
        for i in range(6):
            for j in range(i):
                H0[i, j] = H0[j, i]
            H0[i, i] += DAMPING if i < 2 else AFFINE_STIFFNESS
        x0, y0 = points[n, 0], points[n, 1]
        values = np.empty(pixels, np.float32)
        best = float32(-1)
        x, y = x0, y0
        a, b, c, d = shapes[n, 0, 0], shapes[n, 0, 1], shapes[n, 1, 0], shapes[n, 1, 1]
        for iteration in range(ALIGNMENT_ITERATIONS + 1):
            now, spread, both = float32(0), float32(0), float32(0)
            across, along = PATCH_RADIUS * (abs(a) + abs(b)), PATCH_RADIUS * (abs(c) + abs(d))
            if x >= across and y >= along and x + across < width - 1 and y + along < height - 1:
                for k in range(pixels):
                    u, v = _OFFSETS[k, 0], _OFFSETS[k, 1]
                    values[k] = _sample_inside(image, x + a * u + b * v, y + c * u + d * v)
            else:
                for k in range(pixels):
                    u, v = _OFFSETS[k, 0], _OFFSETS[k, 1]
                    values[k] = _sample(image, x + a * u + b * v, y + c * u + d * v)
            for k in range(pixels):
                now += weights[n, k] * values[k]
            for k in range(pixels):
                e = values[k] - now
                spread += weights[n, k] * e * e
                both += weights[n, k] * e * (gray[n, k] - mean)
            alike = (float32(2) * both + CONTRAST) / (spread + variance + CONTRAST)
            alike *= (float32(2) * now * mean + BRIGHTNESS) / (now * now + mean * mean + BRIGHTNESS)
            if alike > best:
                best = alike
                points[n, 0], points[n, 1] = x, y
                shapes[n, 0, 0], shapes[n, 0, 1], shapes[n, 1, 0], shapes[n, 1, 1] = a, b, c, d
            if iteration == ALIGNMENT_ITERATIONS:
                break
            gain = math.sqrt((variance + CONTRAST) / (spread + CONTRAST))
            step = np.zeros(6, np.float32)
            for k in range(pixels):
                u, v = _OFFSETS[k, 0] * unit, _OFFSETS[k, 1] * unit
                e = weights[n, k] * (gain * (values[k] - now) - (gray[n, k] - mean))
                gx, gy = e * right[n, k], e * down[n, k]
                step[0] += gx
                step[1] += gy
                step[2] += u * gx
                step[3] += v * gx
                step[4] += u * gy
                step[5] += v * gy
            H = H0.copy()
            _solve(H, step)
            # W <- W o dW^-1 with dW = (I + D) x + s.
            p, q, r, s = float32(1) + step[2] * unit, step[3] * unit, step[4] * unit, float32(1) + step[5] * unit
            det = p * s - q * r
            if not det > float32(0.2):
                break
            a, b, c, d = (a * s - b * r) / det, (b * p - a * q) / det, (c * s - d * r) / det, (d * p - c * q) / det
            dx, dy = a * step[0] + b * step[1], c * step[0] + d * step[1]
            x, y = x - dx, y - dy
            if (x - x0) ** 2 + (y - y0) ** 2 > MAX_SHIFT * MAX_SHIFT:
                break
            if not (x > float32(-1) and y > float32(-1) and x < width and y < height):
                break
            if dx * dx + dy * dy < MIN_STEP * MIN_STEP:
                break
        likeness[n] = best
