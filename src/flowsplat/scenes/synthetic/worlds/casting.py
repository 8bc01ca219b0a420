"""Kernels that cast rays at rigid parts and shade what they meet.

A part is an ellipsoid, a box, a capsule, a cylinder or a room (a box seen from inside) under a rigid motion. What a ray
hits is told by the part and the point in the part's own axes, in meters, so that flow and tracks are exact.
"""

from __future__ import annotations

import math

import numpy as np

from flowsplat.common.kernels import helper, inline, kernel
from flowsplat.scenes.synthetic.worlds.materials import albedo

ELLIPSOID, BOX, CAPSULE, CYLINDER, ROOM = range(5)
"""Shapes. ``size`` [3] is: half axes; half extents; (radius, radius, half length between the centers of the round ends); (radius,
radius, half length); half extents. Capsules and cylinders lie along their z."""

_MIN_RAY = 1e-3
"""Smallest multiple of a ray's direction that counts: a point does not shade itself. Chosen by eye."""


@inline
def _ball(x, y, z, r, dx, dy, dz):
    """Where a ray from (x, y, z) enters the ball of radius r round the origin; infinite where it does not."""
    a = dx * dx + dy * dy + dz * dz
    b = x * dx + y * dy + z * dz
    root = b * b - a * (x * x + y * y + z * z - r * r)
    if root <= 0:
        return math.inf
    t = (-b - math.sqrt(root)) / a
    return t if t > _MIN_RAY else math.inf


@helper
def _slabs(s, x, y, z, dx, dy, dz):
    """Where a ray enters and leaves a box of half extents s."""
    near, far = -math.inf, math.inf
    for k in range(3):
        o = x if k == 0 else (y if k == 1 else z)
        d = dx if k == 0 else (dy if k == 1 else dz)
        if abs(d) < 1e-12:
            d = 1e-12
        middle, half = -o / d, abs(s[k] / d)
        near, far = max(near, middle - half), min(far, middle + half)
    return near, far


@helper
def _tube(s, x, y, z, dx, dy, dz, is_round):
    """Where a ray enters a cylinder or, ``is_round``, a capsule."""
    r, h = s[0], s[2]
    best = math.inf
    a = dx * dx + dy * dy
    b = x * dx + y * dy
    root = b * b - a * (x * x + y * y - r * r)
    if root > 0 and a > 1e-18:
        t = (-b - math.sqrt(root)) / a
        if t > _MIN_RAY and abs(z + t * dz) <= h:
            best = t
    for side in (-1.0, 1.0):
        if is_round:
            best = min(best, _ball(x, y, z - side * h, r, dx, dy, dz))
        elif abs(dz) > 1e-12:
            t = (side * h - z) / dz
            if t > _MIN_RAY and (x + t * dx) ** 2 + (y + t * dy) ** 2 <= r * r:
                best = min(best, t)
    return best


@helper
def _meet(shape, s, x, y, z, dx, dy, dz):
    """Smallest multiple of the direction at which a ray, in the part's axes, meets the part; infinite where it does not."""
    if shape == ELLIPSOID:
        return _ball(x / s[0], y / s[1], z / s[2], 1.0, dx / s[0], dy / s[1], dz / s[2])
    if shape in (BOX, ROOM):
        near, far = _slabs(s, x, y, z, dx, dy, dz)
        if shape == ROOM:
            return far
        return near if near < far and near > _MIN_RAY else math.inf
    return _tube(s, x, y, z, dx, dy, dz, shape == CAPSULE)


@helper
def _first(shapes, sizes, turns, origins, bounds, chosen, count, u, v, dx, dy, dz):
    """(multiple, part) of the first surface on a ray through pixel (u, v), of the first ``count`` parts in ``chosen``.

    ``origins`` are the camera's in the parts' axes.
    """
    best, part = math.inf, -1
    for n in range(count):
        k = chosen[n]
        if u < bounds[k, 0] or u > bounds[k, 2] or v < bounds[k, 1] or v > bounds[k, 3]:
            continue
        R, o = turns[k], origins[k]
        t = _meet(
            shapes[k], sizes[k], o[0], o[1], o[2],
            R[0, 0] * dx + R[1, 0] * dy + R[2, 0] * dz,
            R[0, 1] * dx + R[1, 1] * dy + R[2, 1] * dz,
            R[0, 2] * dx + R[1, 2] * dy + R[2, 2] * dz,
        )  # fmt: skip
        if t < best:
            best, part = t, k
    return best, part


@helper
def _normal(shape, s, x, y, z):
    """Unit normal, in the part's axes, that points to where the part is seen from."""
    if shape in (BOX, ROOM):
        a, b, c = abs(x) / s[0], abs(y) / s[1], abs(z) / s[2]
        sign = -1.0 if shape == ROOM else 1.0
        if a >= b and a >= c:
            return (sign if x > 0 else -sign), 0.0, 0.0
        if b >= c:
            return 0.0, (sign if y > 0 else -sign), 0.0
        return 0.0, 0.0, (sign if z > 0 else -sign)
    if shape == ELLIPSOID:
        nx, ny, nz = x / s[0] ** 2, y / s[1] ** 2, z / s[2] ** 2
    elif shape == CAPSULE:
        nx, ny, nz = x, y, z - min(max(z, -s[2]), s[2])
    elif abs(z) > s[2] * (1 - 1e-9) - 1e-9 and x * x + y * y < s[0] ** 2 * (1 - 1e-6):
        nx, ny, nz = 0.0, 0.0, z
    else:
        nx, ny, nz = x, y, 0.0
    length = max(math.sqrt(nx * nx + ny * ny + nz * nz), 1e-12)
    return nx / length, ny / length, nz / length


@helper
def _is_shaded(shapes, sizes, turns, centers, radii, throwing, x, y, z, lx, ly, lz):
    """Whether one of the parts ``throwing`` stands between a point and the distant light in direction (lx, ly, lz)."""
    for k in throwing:
        px, py, pz = x - centers[k, 0], y - centers[k, 1], z - centers[k, 2]
        along = px * lx + py * ly + pz * lz
        squared = px * px + py * py + pz * pz
        if squared - along * along > radii[k] ** 2 or (along > 0 and squared > radii[k] ** 2):
            continue
        R = turns[k]
        t = _meet(
            shapes[k], sizes[k],
            R[0, 0] * px + R[1, 0] * py + R[2, 0] * pz,
            R[0, 1] * px + R[1, 1] * py + R[2, 1] * pz,
            R[0, 2] * px + R[1, 2] * py + R[2, 2] * pz,
            R[0, 0] * lx + R[1, 0] * ly + R[2, 0] * lz,
            R[0, 1] * lx + R[1, 1] * ly + R[2, 1] * lz,
            R[0, 2] * lx + R[1, 2] * ly + R[2, 2] * lz,
        )  # fmt: skip
        if t < math.inf:
            return True
    return False


@helper
def _hide_sky(occluders, x, y, z, nx, ny, nz):
    """Share of the sky's light, weighed by the cosine to the normal, that balls hide from a point: exact for one ball that is
    whole above the horizon, and the sum, 1 at most, for several."""
    hidden = 0.0
    for q in range(len(occluders)):
        dx, dy, dz = occluders[q, 0] - x, occluders[q, 1] - y, occluders[q, 2] - z
        facing = nx * dx + ny * dy + nz * dz
        if facing > 0:
            squared = max(dx * dx + dy * dy + dz * dz, occluders[q, 3] ** 2)
            hidden += occluders[q, 3] ** 2 / squared * facing / math.sqrt(squared)
    return min(hidden, 1.0)


@kernel
def cast(
    shapes: np.ndarray, sizes: np.ndarray, turns: np.ndarray, origins: np.ndarray, bounds: np.ndarray,
    R: np.ndarray, K: np.ndarray, uv: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Return (planar depth [N], part [N], points in the parts' axes [N, 3]) of what a camera sees at pixels ``uv`` [N, 2].

    Args:
        shapes: [P] of the parts.
        sizes: [P, 3].
        turns: [P, 3, 3] from the parts' axes to the world's.
        origins: [P, 3] the camera's center in the parts' axes.
        bounds: [P, 4] left, top, right and bottom pixel beyond which a part is never seen.
        R: [3, 3] world to camera.
        K: [4] fx, fy, cx, cy.
    """
    count = len(uv)
    depth, index, local = np.empty(count), np.empty(count, np.int64), np.empty((count, 3))
    every = np.arange(len(shapes))
    for n in range(count):
        a, b = (uv[n, 0] - K[2]) / K[0], (uv[n, 1] - K[3]) / K[1]
        dx, dy, dz = R[0, 0] * a + R[1, 0] * b + R[2, 0], R[0, 1] * a + R[1, 1] * b + R[2, 1], R[0, 2] * a + R[1, 2] * b + R[2, 2]
        t, k = _first(shapes, sizes, turns, origins, bounds, every, len(every), uv[n, 0], uv[n, 1], dx, dy, dz)
        depth[n], index[n] = t, k
        for q in range(3):
            local[n, q] = origins[k, q] + t * (turns[k, 0, q] * dx + turns[k, 1, q] * dy + turns[k, 2, q] * dz)
    return depth, index, local


@kernel
def render(
    shapes: np.ndarray, sizes: np.ndarray, turns: np.ndarray, centers: np.ndarray, origins: np.ndarray, bounds: np.ndarray,
    radii: np.ndarray, casts: np.ndarray, materials: np.ndarray, R: np.ndarray, K: np.ndarray, center: np.ndarray,
    offsets: np.ndarray, lights: np.ndarray, ambient: float, sun: float, occluders: np.ndarray, occlusion: float, still: int,
    image: np.ndarray,
) -> None:  # fmt: skip
    """Add the colors that a camera sees, the mean over some samples in every pixel, to ``image`` [H, W, 3].

    Args (those that ``cast`` does not have):
        centers: [P, 3] of the parts in the world.
        radii: [P] of balls round the parts.
        casts: [P] whether a part throws a shadow.
        materials: [P, M] (see ``materials``).
        center: [3] of the camera.
        offsets: [S, 2] of the samples from the middle of a pixel, in pixels.
        lights: [S, 3] unit directions to the sun; they differ a little, so that shadows have soft edges.
        ambient: light of the sky.
        sun: light of the sun.
        occluders: [Q, 4] centers and radii of balls that take the light of the sky from what is near them.
        occlusion: 0 to 1, how much of it they take; 0 = none.
        still: how many of the parts, the first ones, they take it from.
    """
    H, W = image.shape[:2]
    S = len(offsets)
    chosen, throwing = np.empty(len(shapes), np.int64), np.flatnonzero(casts)
    for row in range(H):
        count = 0
        for k in range(len(shapes)):
            if bounds[k, 1] <= row + 1 and bounds[k, 3] >= row:
                chosen[count] = k
                count += 1
        for column in range(W):
            for s in range(S):
                u, v = column + 0.5 + offsets[s, 0], row + 0.5 + offsets[s, 1]
                a, b = (u - K[2]) / K[0], (v - K[3]) / K[1]
                dx = R[0, 0] * a + R[1, 0] * b + R[2, 0]
                dy = R[0, 1] * a + R[1, 1] * b + R[2, 1]
                dz = R[0, 2] * a + R[1, 2] * b + R[2, 2]
                t, k = _first(shapes, sizes, turns, origins, bounds, chosen, count, u, v, dx, dy, dz)
                T, o = turns[k], origins[k]
                x = o[0] + t * (T[0, 0] * dx + T[1, 0] * dy + T[2, 0] * dz)
                y = o[1] + t * (T[0, 1] * dx + T[1, 1] * dy + T[2, 1] * dz)
                z = o[2] + t * (T[0, 2] * dx + T[1, 2] * dy + T[2, 2] * dz)
                mx, my, mz = _normal(shapes[k], sizes[k], x, y, z)
                nx = T[0, 0] * mx + T[0, 1] * my + T[0, 2] * mz
                ny = T[1, 0] * mx + T[1, 1] * my + T[1, 2] * mz
                nz = T[2, 0] * mx + T[2, 1] * my + T[2, 2] * mz
                cosine = abs(nx * dx + ny * dy + nz * dz) / math.sqrt(dx * dx + dy * dy + dz * dz)
                footprint = t / K[0] / math.sqrt(max(cosine, 0.05))
                red, green, blue = albedo(materials[k], x, y, z, mx, my, mz, footprint)
                light = 1.0
                if shapes[k] != ROOM:
                    L = lights[s]
                    facing = nx * L[0] + ny * L[1] + nz * L[2]
                    light = ambient * (0.7 + 0.3 * nz)
                    if occlusion > 0 and k < still:
                        light *= 1 - occlusion * _hide_sky(
                            occluders, center[0] + t * dx, center[1] + t * dy, center[2] + t * dz, nx, ny, nz
                        )
                    if facing > 0 and sun > 0:
                        px = center[0] + t * dx + 2e-3 * nx
                        py = center[1] + t * dy + 2e-3 * ny
                        pz = center[2] + t * dz + 2e-3 * nz
                        if not _is_shaded(shapes, sizes, turns, centers, radii, throwing, px, py, pz, L[0], L[1], L[2]):
                            light += sun * facing
                image[row, column, 0] += min(red * light, 1.0) / S
                image[row, column, 1] += min(green * light, 1.0) / S
                image[row, column, 2] += min(blue * light, 1.0) / S
