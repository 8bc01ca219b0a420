"""The depth of every pixel of an object: an upright billboard, and what its points stand out of it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from flowsplat.common.kernels import kernel
from flowsplat.images.edge_smoothing import EdgeSmoother
from flowsplat.priors.objects.rigid import INLIER_PIXELS, MIN_POINT_DEPTH, RESIDUAL_SCALE, RigidSolution, TrackObservations
from flowsplat.priors.objects.rigid_equations import derivatives

EXPECTED_ROUNDNESS = 0.75
"""How deep the front of an object is expected to be, in units of a ball's of its width (docs/method/objects.md)."""
DISC_RADII = 0.8 ** np.arange(9)
"""Radii of the discs that are tried, in units of the largest one inside an object. Chosen by eye."""
EXPECTED_OFFSET_SIGMA = 0.6
"""Standard deviation of the shape offset that is expected, in units of the object's half width. Chosen by eye."""
OFFSET_SMOOTHNESS = 60.0
"""Of the shape offset, as in the fast global smoother."""
COLOR_SIGMA = 12.0
"""Gray levels across which it is less smooth. Chosen by eye."""
NOISE_FACTOR = 2.0
"""Errors of tracks last for frames: standard deviation of a point's depth over that of white noise. Chosen by eye."""
MAX_OBSERVATION_ERROR = 2.0
"""Pixels up to which an observation tells of the shape offset. Chosen by eye."""
_FIT_ITERATIONS = 6
"""Iterations in which the points of an object are placed. Chosen by eye."""


@dataclass(frozen=True)
class ShapePoints:
    """Logarithm of depth at points of an object, by observation.

    Attributes:
        frame_of: [M] position of the frame.
        pixels: [M, 2] float.
        log_depth: [M] in the object's unit.
        sigma: [M] standard deviation.
    """

    frame_of: np.ndarray
    pixels: np.ndarray
    log_depth: np.ndarray
    sigma: np.ndarray

    @staticmethod
    def none() -> ShapePoints:
        """No point."""
        return ShapePoints(np.zeros(0, int), np.zeros((0, 2)), np.zeros(0), np.zeros(0))


def place_points(motion: RigidSolution, observations: TrackObservations, K: np.ndarray) -> tuple[ShapePoints, float]:
    """Return all points of an object, also those that its motion was not found from, with its poses held.

    Returns:
        The points, and the share of all observations that lie where the motion puts them: limbs that move on their own do not.
    """
    o = observations
    points, covariances = _solve_offset(motion, o)
    n, t = o.point_of, o.frame_of
    y = np.einsum("mij,mj->mi", motion.turns[t], points[n]) + motion.shifts[t]
    depth = np.maximum(y[:, 2], MIN_POINT_DEPTH)
    off = o.focal * np.linalg.norm(y[:, :2] / depth[:, None] - o.x, axis=1)
    axis = motion.turns[t][:, 2]
    noise = NOISE_FACTOR * motion.noise
    sigma = noise * np.sqrt(np.maximum(np.einsum("mi,mij,mj->m", axis, covariances[n], axis), 0)) / depth
    good = motion.used[t] & (off < MAX_OBSERVATION_ERROR) & (y[:, 2] > MIN_POINT_DEPTH) & np.isfinite(sigma)
    pixels = o.x * [K[0, 0], K[1, 1]] + K[:2, 2]
    share = float((off[motion.used[t]] < INLIER_PIXELS).mean()) if motion.used[t].any() else 0.0
    return ShapePoints(t[good], pixels[good], np.log(depth[good]), np.maximum(sigma[good], 1e-4)), share


def rough_points(motion: RigidSolution, observations: TrackObservations) -> np.ndarray:
    """Return [N, 3] of all points in the object's frame, with its poses held; NaN of those that no frame with a pose saw."""
    points, covariances = _solve_offset(motion, observations)
    points[~np.isfinite(covariances).all((1, 2))] = np.nan
    return points


def _solve_offset(motion: RigidSolution, o: TrackObservations) -> tuple[np.ndarray, np.ndarray]:
    """Solve one object of ``_place``."""
    placed: tuple[np.ndarray, np.ndarray] = _place(
        motion.turns, motion.shifts, motion.used, o.first, o.frame_of, o.x, o.focal, RESIDUAL_SCALE,
        (NOISE_FACTOR * motion.noise / (EXPECTED_OFFSET_SIGMA * motion.size)) ** 2, _FIT_ITERATIONS,
    )  # fmt: skip
    return placed


def roundness(mask: np.ndarray, focal: float) -> np.ndarray:
    """Offsets of ln depth [H, W] float32 of a body that is as deep as it is wide, ``EXPECTED_ROUNDNESS`` of a sphere's; median 0
    over the mask.

    Each pixel lies on the largest disc inside the outline that holds it: limbs are thin, bodies thick.

    Args:
        mask: bool [H, W] of the object.
        focal: pixels.
    """
    result = np.zeros(mask.shape, np.float32)
    y, x = np.nonzero(mask)
    if len(y) == 0:
        return result
    y0, y1, x0, x1 = y.min(), y.max() + 1, x.min(), x.max() + 1
    # Where the border of the image cuts an object, it goes on.
    inside = mask[y0:y1, x0:x1].astype(np.uint8)
    above, left = int(y0 > 0), int(x0 > 0)
    padded = np.pad(inside, ((above, int(y1 < mask.shape[0])), (left, int(x1 < mask.shape[1]))))
    rim = cv2.distanceTransform(padded, cv2.DIST_L2, 5)
    radius = rim.copy()
    for level in float(rim.max()) * DISC_RADII:
        near = cv2.distanceTransform((rim < level).astype(np.uint8), cv2.DIST_L2, 5) < level
        radius = np.where(near & (rim > 0), np.maximum(radius, level), radius)
    height = np.sqrt(np.maximum(rim * (2 * radius - rim), 0))[above : above + y1 - y0, left : left + x1 - x0]
    offsets = -EXPECTED_ROUNDNESS / focal * height
    result[y0:y1, x0:x1] = np.where(inside > 0, offsets - np.median(offsets[inside > 0]), 0)
    return result


def interpolate_shape_offset(
    mask: np.ndarray, image: np.ndarray, pixels: np.ndarray, offsets: np.ndarray, sigma: np.ndarray, expected: float
) -> np.ndarray:
    """Offsets of ln depth [H, W] float32 from the billboard's, smoothed along the image's edges and held by their expectation, 0.

    Args:
        mask: bool [H, W] of the object.
        image: uint8, RGB [H, W, 3] or gray [H, W].
        pixels: [N, 2] where offsets [N] with standard deviation sigma [N] are known.
        expected: standard deviation of the shape offset.
    """
    height, width = mask.shape
    result = np.zeros((height, width), np.float32)
    y, x = np.nonzero(mask)
    if len(y) == 0 or len(pixels) == 0:
        return result
    y0, y1, x0, x1 = y.min(), y.max() + 1, x.min(), x.max() + 1
    weights, sums = np.zeros((2, y1 - y0, x1 - x0), np.float32)
    column, row = np.clip(pixels.astype(int) - [x0, y0], 0, [x1 - x0 - 1, y1 - y0 - 1]).T
    weight = 1 / (sigma**2 + (0.1 * expected) ** 2)
    np.add.at(weights, (row, column), weight)
    np.add.at(sums, (row, column), weight * offsets)
    smoother = EdgeSmoother(image[y0:y1, x0:x1], OFFSET_SMOOTHNESS, COLOR_SIGMA)
    # One expectation for each patch as wide as a quarter of the object.
    patch = max(1.0, len(y) / 16)
    held = 1 / (expected**2 * patch)
    local = smoother.filter(sums) / (smoother.filter(weights) + held)
    result[y0:y1, x0:x1] = np.clip(local, -3 * expected, 3 * expected)
    return result


@kernel
def _place(
    turns: np.ndarray, shifts: np.ndarray, used: np.ndarray, first: np.ndarray, frame_of: np.ndarray, x: np.ndarray, focal: float,
    width: float, ridge: float, iterations: int,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return positions [N, 3] of points with known poses, and their covariance [N, 3, 3] for a noise of one pixel."""
    N = len(first) - 1
    points, covariances = np.zeros((N, 3)), np.zeros((N, 3, 3))
    r, J, B = np.zeros(2), np.zeros((2, 6)), np.zeros((2, 3))
    for n in range(N):
        start = -1
        for m in range(first[n], first[n + 1]):
            if used[frame_of[m]]:
                start = m
                break
        if start < 0:
            covariances[n] = np.inf
            continue
        t = frame_of[start]
        z = shifts[t, 2]
        ray = np.array([x[start, 0] * z, x[start, 1] * z, z])
        S = turns[t].T @ (ray - shifts[t])
        V = np.zeros((3, 3))
        for _ in range(iterations):
            V[:] = 0.0
            g = np.zeros(3)
            for d in range(3):
                V[d, d] = ridge
                g[d] = -ridge * S[d]
            for m in range(first[n], first[n + 1]):
                t = frame_of[m]
                if not used[t]:
                    continue
                derivatives(turns[t], shifts[t], S, x[m], focal, r, J, B)
                u = 1.0 / (1.0 + (r[0] * r[0] + r[1] * r[1]) / width**2)
                for i in range(3):
                    g[i] -= u * (B[0, i] * r[0] + B[1, i] * r[1])
                    for j in range(3):
                        V[i, j] += u * (B[0, i] * B[0, j] + B[1, i] * B[1, j])
            S = S + np.linalg.solve(V, g)
        points[n] = S
        covariances[n] = np.linalg.inv(V)
    return points, covariances
