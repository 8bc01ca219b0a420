"""Points of a rigid object matched anew, over as many frames as show them.

Tracks go from frame to frame, so on an object they are short and drift: on the rendered scenes they live for 11 to 17 of 48 frames
and are .15 px off after four frames and .5 to 1 px after eight. Once its motion is roughly known, it tells where each point lies
in every frame and how its surroundings look there. What is matched then is the point's own image, so nothing adds up: a
warp by the surface as far as it is known, and a shift by Gauss-Newton on differences of brightness (Lucas and Kanade, IJCAI 1981;
Shi and Tomasi, CVPR 1994, on matching with the first frame instead of the last).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from flowsplat.common.kernels import helper, kernel
from flowsplat.common.threads import parallel_for
from flowsplat.geometry import Camera
from flowsplat.priors.objects.contact import upright_ratio
from flowsplat.priors.objects.rigid import MIN_POINT_DEPTH, RigidSolution, TrackObservations, refine_rigid
from flowsplat.priors.objects.shape_offset import (
    EXPECTED_OFFSET_SIGMA,
    ShapePoints,
    interpolate_shape_offset,
    place_points,
    rough_points,
    roundness,
)

PATCH_RADIUS = 4
"""Pixels of a point's surroundings to either side (docs/method/objects.md)."""
MAX_POINTS = 700
"""Points of an object that are matched (docs/method/objects.md)."""
MATCH_ROUNDS = 2
"""The second time the motion and the surface are better known (docs/method/objects.md)."""
MIN_CORRELATION = 0.85
"""Correlation of brightness from which a match counts (docs/method/objects.md)."""
MAX_MATCH_SHIFT = 4.0
"""Pixels that a match may lie away from where the motion puts it (docs/method/objects.md)."""
MAX_MATCH_SIGMA = 0.25
"""Pixels: standard deviation of a match, in the direction that it tells least, up to which it counts (docs/method/objects.md)."""
MIN_VIEW_COSINE = 0.25
"""Cosine between the surface's normal and the line of sight from which a frame shows a point. Chosen by eye."""
MIN_COVERED_SHARE = 0.6
"""Share of the surroundings that has to lie on the object in both frames. Chosen by eye."""
MIN_POINT_FRAMES = 6
"""Frames of a point from which it counts. Chosen by eye."""
MIN_POINTS = 16
"""Matched points of an object below which its motion is left as it is. Chosen by eye."""
MIN_MATCHES = 12
"""Matched points of a frame below which tracks help out: where an object leaves the image, hardly any point is seen often.
Chosen by eye."""
BLUR_SIGMA = 0.6
"""Pixels: standard deviation of the blur before images are read between pixels. Chosen by eye."""
GATES = np.array([MIN_CORRELATION, MAX_MATCH_SHIFT, MAX_MATCH_SIGMA, MIN_VIEW_COSINE, MIN_COVERED_SHARE])

_ALIGNMENT_ITERATIONS = 12
"""Gauss-Newton steps of a match, at most. Chosen by eye."""
_FRAME_NOISE = 2.0
"""Gray levels: noise of a pixel below which no match is surer. Chosen by eye."""


@dataclass(frozen=True)
class ObjectImages:
    """What the training frames show of one object.

    Attributes:
        gray: [T, H, W] uint8 of ``gray``.
        masks: [T, H, W] bool.
        middles: [T, 2] its middle pixels, NaN where it is not seen.
        cameras: [T], all with one K.
        normal: [3] up.
    """

    gray: np.ndarray
    masks: np.ndarray
    middles: np.ndarray
    cameras: Sequence[Camera]
    normal: np.ndarray

    def surface(self, k: int, points: ShapePoints, expected: float) -> np.ndarray:
        """ln depth [H, W] float32 of the object in training frame k, up to a constant, as far as its points tell."""
        mask, camera = self.masks[k], self.cameras[k]
        result = np.zeros(mask.shape, np.float32)
        y, x = np.nonzero(mask)
        if len(y) == 0 or not np.isfinite(self.middles[k]).all():
            return result
        result += roundness(mask, float(camera.K[0, 0]))
        rows, columns = slice(y.min(), y.max() + 1), slice(x.min(), x.max() + 1)
        grid = np.moveaxis(np.mgrid[rows, columns][::-1], 0, -1) + 0.5
        billboard = np.log(upright_ratio(camera, self.normal, self.middles[k], grid.reshape(-1, 2))).reshape(grid.shape[:2])
        result[rows, columns] += billboard
        here = points.frame_of == k
        if here.any():
            pixels = points.pixels[here]
            column, row = np.clip(pixels.astype(int), 0, [mask.shape[1] - 1, mask.shape[0] - 1]).T
            offsets = points.log_depth[here] - result[row, column]
            result += interpolate_shape_offset(
                mask, self.gray[k], pixels, offsets - np.median(offsets), points.sigma[here], expected
            )
        # What is read between the last pixels of the object and those beside it belongs to the object.
        result[~mask] = result[mask].max()
        return result


def rematch_object(
    motion: RigidSolution, positions: np.ndarray, inside: np.ndarray, images: ObjectImages
) -> tuple[RigidSolution, np.ndarray, np.ndarray] | None:
    """Return a motion from points that are matched anew, and those.

    Args:
        motion: as tracks tell it.
        positions: [N, T, 2] pixels of the tracks, where ``inside`` [N, T].

    Returns:
        The motion, pixels [M, T, 2] float64 and where they count [M, T]; None where too few points could be matched.
    """
    K = images.cameras[0].K
    tracks = TrackObservations.of_tracks(positions, inside, K)
    result = None
    for _ in range(MATCH_ROUNDS):
        points, expected = place_points(motion, tracks, K)[0], EXPECTED_OFFSET_SIGMA * motion.size
        found, counts = rematch(
            motion, rough_points(motion, tracks), positions, inside, images.gray, images.masks,
            lambda k, points=points, expected=expected: images.surface(k, points, expected), K,  # type: ignore[misc]
        )  # fmt: skip
        if len(found) < MIN_POINTS:
            break
        # Frames in which few are found keep their tracks, and those link them to the others.
        helping = (inside & (counts.sum(0) < MIN_MATCHES)).any(1)
        found, counts = np.concatenate([found, positions[helping]]), np.concatenate([counts, inside[helping]])
        observations = TrackObservations.of_tracks(found, counts, K).in_pieces()
        motion = refine_rigid(motion, observations, rough_points(motion, observations))
        result = motion, found, counts
    return result


def rematch(
    motion: RigidSolution, points: np.ndarray, positions: np.ndarray, inside: np.ndarray, images: np.ndarray,
    masks: np.ndarray, surface: Callable[[int], np.ndarray], K: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Matches of the points of an object in all frames that show them.

    Args:
        motion: of the object, as far as it is known.
        points: [N, 3] of the tracks in the object's frame, NaN where there is none.
        positions: [N, T, 2] pixels of the tracks, where ``inside`` [N, T].
        images: [T, H, W] of ``gray``.
        masks: [T, H, W] bool, of the object.
        surface: gives ln depth [H, W] float32 of the object in training frame k, up to a constant.
        K: [3, 3] of all frames.

    Returns:
        Pixels [M, T, 2] float64, and where they count [M, T].
    """
    chosen, anchors = _anchors(motion, points, positions, inside)
    T = inside.shape[1]
    if len(chosen) == 0:
        return np.zeros((0, T, 2)), np.zeros((0, T), bool)
    start = positions[chosen, anchors].astype(np.float64)
    shapes, normals = _shapes(anchors, start, surface, K)
    found, counts = np.zeros((len(start), T, 2)), np.zeros((len(start), T), np.bool_)
    parallel_for(
        _match, len(start), motion.turns, motion.shifts, motion.used, points[chosen], normals, anchors, start, shapes, images,
        masks,
        K.astype(np.float64), GATES, found, counts,
    )  # fmt: skip
    kept = counts.sum(1) >= MIN_POINT_FRAMES
    return found[kept], counts[kept]


def _anchors(motion: RigidSolution, points: np.ndarray, positions: np.ndarray, inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return indices [M] of the points to match, spread over frames and surface, and the frame [M] that each is taken from."""
    seen = inside & motion.used
    usable = np.flatnonzero(np.isfinite(points).all(1) & seen.any(1))
    # The middle of a track is where it drifted least from, in both directions.
    middle = np.array([np.flatnonzero(seen[n])[seen[n].sum() // 2] for n in usable], int)
    order = np.argsort(-seen[usable].sum(1), kind="stable")
    taken: set[tuple[int, int, int]] = set()
    cell = max(PATCH_RADIUS * 0.75, 2.0)
    chosen = []
    for k in order:
        n, t = usable[k], middle[k]
        where = (int(t) // 3, int(positions[n, t, 0] // cell), int(positions[n, t, 1] // cell))
        if where not in taken:
            taken.add(where)
            chosen.append(k)
    if len(chosen) > MAX_POINTS:
        chosen = [chosen[k] for k in np.linspace(0, len(chosen) - 1, MAX_POINTS).astype(int)]
    picked = np.array(chosen, int)
    return usable[picked], middle[picked]


def _shapes(
    anchors: np.ndarray, start: np.ndarray, surface: Callable[[int], np.ndarray], K: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return depth [M, side, side] around pixels ``start`` [M, 2], side 2 ``PATCH_RADIUS`` + 1, in units of that there, and
    normals [M, 3] in the camera's axes that face it."""
    side = 2 * PATCH_RADIUS + 1
    shapes, normals = np.ones((len(anchors), side, side)), np.zeros((len(anchors), 3))
    for t in np.unique(anchors):
        depth = surface(int(t))
        for m in np.flatnonzero(anchors == t):
            around = cv2.getRectSubPix(depth, (side, side), (float(start[m, 0] - 0.5), float(start[m, 1] - 0.5)))
            around = around - around[PATCH_RADIUS, PATCH_RADIUS]
            shapes[m] = np.exp(around)
            gx = (
                float(
                    around[PATCH_RADIUS - 1 : PATCH_RADIUS + 2, PATCH_RADIUS + 2].mean()
                    - around[PATCH_RADIUS - 1 : PATCH_RADIUS + 2, PATCH_RADIUS - 2].mean()
                )
                / 4
            )
            gy = (
                float(
                    around[PATCH_RADIUS + 2, PATCH_RADIUS - 1 : PATCH_RADIUS + 2].mean()
                    - around[PATCH_RADIUS - 2, PATCH_RADIUS - 1 : PATCH_RADIUS + 2].mean()
                )
                / 4
            )
            x, y = start[m] - K[:2, 2]
            normal = np.array([K[0, 0] * gx, K[1, 1] * gy, -1 - x * gx - y * gy])
            normals[m] = normal / np.linalg.norm(normal)
    return shapes, normals


def gray(image: np.ndarray) -> np.ndarray:
    """Return [H, W] uint8 of an image [H, W, 3] uint8, a little smoothed, so that it can be read between pixels."""
    return cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), (0, 0), BLUR_SIGMA)


@helper
def _read(image: np.ndarray, x: float, y: float) -> float:
    """Bilinear, pixel centers at .5."""
    x, y = x - 0.5, y - 0.5
    i, j = int(np.floor(x)), int(np.floor(y))
    a, b = x - i, y - j
    upper = (1 - a) * image[j, i] + a * image[j, i + 1]
    return (1 - b) * upper + b * ((1 - a) * image[j + 1, i] + a * image[j + 1, i + 1])


@kernel
def _match(
    begin: int, end: int, turns: np.ndarray, shifts: np.ndarray, used: np.ndarray, points: np.ndarray, normals: np.ndarray,
    anchors: np.ndarray,
    start: np.ndarray, shapes: np.ndarray, images: np.ndarray, masks: np.ndarray, K: np.ndarray, gates: np.ndarray,
    found: np.ndarray, counts: np.ndarray,
) -> None:  # fmt: skip
    """Kernel of ``rematch``; shapes [M, D, D] with D odd; found [M, T, 2] and counts [M, T], zeros where nothing is found."""
    likest, farthest, surest, steepest, covered = gates
    T = len(turns)
    H, W = images.shape[1:]
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    side = shapes.shape[1]
    radius = side // 2
    for m in range(begin, end):
        a = anchors[m]
        p = np.ascontiguousarray(turns[a]) @ points[m] + shifts[a]
        n = normals[m]
        if p[2] < MIN_POINT_DEPTH:
            continue
        away = p[0] * n[0] + p[1] * n[1] + p[2] * n[2]
        if -away < steepest * np.sqrt(p[0] ** 2 + p[1] ** 2 + p[2] ** 2):
            continue
        u, v = start[m, 0], start[m, 1]
        # The surroundings in the frame where it is known: brightness, and points of the surface.
        template = np.zeros(side * side)
        weight = np.zeros(side * side)
        plane = np.zeros((side * side, 3))
        inside, total, k = 0.0, 0.0, 0
        for j in range(-radius, radius + 1):
            for i in range(-radius, radius + 1):
                x, y = u + i, v + j
                w = np.exp(-(i * i + j * j) / (0.5 * radius * radius))
                total += w
                if x >= 1 and y >= 1 and x < W - 1 and y < H - 1 and masks[a, int(y), int(x)]:
                    # Ray of the pixel, moved so that its middle is the point as it is placed.
                    r0, r1 = p[0] / p[2] + i / fx, p[1] / p[2] + j / fy
                    z = p[2] * shapes[m, j + radius, i + radius]
                    if z > 0.5 * p[2] and z < 2 * p[2]:
                        weight[k] = w
                        template[k] = _read(images[a], x, y)
                        plane[k, 0], plane[k, 1], plane[k, 2] = r0 * z, r1 * z, z
                        inside += w
                k += 1
        if inside < covered * total:
            continue
        R0 = np.ascontiguousarray(turns[a].T)
        values, gx, gy, w2 = np.zeros(side * side), np.zeros(side * side), np.zeros(side * side), np.zeros(side * side)
        for t in range(T):
            if not used[t]:
                continue
            if t == a:
                found[m, t, 0], found[m, t, 1] = u, v
                counts[m, t] = True
                continue
            R = np.ascontiguousarray(turns[t]) @ R0
            tau = shifts[t] - R @ shifts[a]
            q = R @ p + tau
            face = R @ n
            if q[2] < MIN_POINT_DEPTH:
                continue
            if -(q[0] * face[0] + q[1] * face[1] + q[2] * face[2]) < steepest * np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2):
                continue
            x0, y0 = fx * q[0] / q[2] + cx, fy * q[1] / q[2] + cy
            dx, dy, likeness, spread_ = 0.0, 0.0, -1.0, np.inf
            good = True
            for _ in range(_ALIGNMENT_ITERATIONS):
                sw, sv, st = 0.0, 0.0, 0.0
                for k in range(side * side):
                    w2[k] = 0.0
                    if weight[k] == 0.0:
                        continue
                    X = R[0, 0] * plane[k, 0] + R[0, 1] * plane[k, 1] + R[0, 2] * plane[k, 2] + tau[0]
                    Y = R[1, 0] * plane[k, 0] + R[1, 1] * plane[k, 1] + R[1, 2] * plane[k, 2] + tau[1]
                    Z = R[2, 0] * plane[k, 0] + R[2, 1] * plane[k, 1] + R[2, 2] * plane[k, 2] + tau[2]
                    if Z < MIN_POINT_DEPTH:
                        continue
                    x, y = fx * X / Z + cx + dx, fy * Y / Z + cy + dy
                    if x < 2 or y < 2 or x >= W - 2 or y >= H - 2 or not masks[t, int(y), int(x)]:
                        continue
                    w = weight[k]
                    w2[k] = w
                    values[k] = _read(images[t], x, y)
                    gx[k] = 0.5 * (_read(images[t], x + 1, y) - _read(images[t], x - 1, y))
                    gy[k] = 0.5 * (_read(images[t], x, y + 1) - _read(images[t], x, y - 1))
                    sw += w
                    sv += w * values[k]
                    st += w * template[k]
                if sw < covered * inside:
                    good = False
                    break
                mv, mt = sv / sw, st / sw
                vv, tt, vt = 0.0, 0.0, 0.0
                for k in range(side * side):
                    if w2[k] > 0:
                        b, c = values[k] - mv, template[k] - mt
                        vv += w2[k] * b * b
                        tt += w2[k] * c * c
                        vt += w2[k] * b * c
                if vv < 1e-6 * sw or tt < 1e-6 * sw or vt <= 0:
                    good = False
                    break
                likeness = vt / np.sqrt(vv * tt)
                gain = vt / tt
                a00, a01, a11, b0, b1, rest, mx, my = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                for k in range(side * side):
                    if w2[k] > 0:
                        mx += w2[k] * gx[k]
                        my += w2[k] * gy[k]
                mx /= sw
                my /= sw
                for k in range(side * side):
                    if w2[k] > 0:
                        e = gain * (template[k] - mt) - (values[k] - mv)
                        hx, hy = gx[k] - mx, gy[k] - my
                        a00 += w2[k] * hx * hx
                        a01 += w2[k] * hx * hy
                        a11 += w2[k] * hy * hy
                        b0 += w2[k] * hx * e
                        b1 += w2[k] * hy * e
                        rest += w2[k] * e * e
                determinant = a00 * a11 - a01 * a01
                if determinant <= 1e-9:
                    good = False
                    break
                least = 0.5 * (a00 + a11) - np.sqrt(0.25 * (a00 - a11) ** 2 + a01 * a01)
                # Pixels are weighed from 0 to 1, and neighbors share their noise.
                spread_ = np.sqrt((rest / sw + _FRAME_NOISE**2) / max(least, 1e-9))
                mx = (a11 * b0 - a01 * b1) / determinant
                my = (a00 * b1 - a01 * b0) / determinant
                length = np.sqrt(mx * mx + my * my)
                if length > 1.5:
                    mx, my = mx * 1.5 / length, my * 1.5 / length
                dx += mx
                dy += my
                if dx * dx + dy * dy > (farthest + 1) ** 2:
                    good = False
                    break
                if length < 0.02:
                    break
            if good and likeness >= likest and spread_ <= surest and dx * dx + dy * dy <= farthest**2:
                found[m, t, 0], found[m, t, 1] = x0 + dx, y0 + dy
                counts[m, t] = int(y0 + dy) >= 0 and int(x0 + dx) >= 0 and masks[t, int(y0 + dy), int(x0 + dx)]
