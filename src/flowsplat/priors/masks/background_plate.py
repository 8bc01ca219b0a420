"""The clean plate: what the image of a frame would be without its objects, from frames that see past them.

Depth and cameras of the static scene tell where each pixel lies in other frames. What looks like that in enough of them
is static, however the flow swells there; what does not has something in front of it. Of the frames that see past the objects two
plates are made: the color most like the pixel, which says what the pixel may still be, and the middle one, which says what is
there. Shadows are static: they only darken the plate.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from flowsplat.common.kernels import helper, kernel
from flowsplat.common.simd import (
    LANES,
    broadcast,
    byte_of,
    gather,
    lane_numbers,
    largest_lane,
    load,
    magnitude,
    maximum,
    minimum,
    store,
    where_above,
    where_at_least,
    whole,
)
from flowsplat.common.threads import parallel_for
from flowsplat.geometry import Camera
from flowsplat.priors.background.bits import pack
from flowsplat.priors.background.fill import upsample
from flowsplat.priors.background.matched_clip import MatchedClip
from flowsplat.priors.background.static_depth import StaticDepth

PLATE_OFFSETS = (4, 8, 12, 16, 24, 32, 48)
"""Training frames before and after, whose images are compared (docs/method/masks.md)."""

FEW_FRAMES = 16
"""Training frames of a clip up to which its images are few and lie far apart: all others are compared, and the flow hardly joins
them (docs/method/masks.md)."""

MIN_VIEWS = 2
"""Frames that must see a pixel's static point for its image to count. Chosen by eye."""

SIMILAR_SHARE = 0.33
"""Share of the frames that look most like the pixel, whose last one is compared with it (docs/method/masks.md)."""

SHADE_SIDE, SHADE_RANGE = 9, (0.55, 1.25)
"""Side in pixels of the square in which a shadow is even, and the range of its brightness (docs/method/masks.md)."""

SHADE_COST = 0.25
"""How much a brightness other than 1 counts, as a share of the brightness. Chosen by eye."""

NOISE_LEVELS, SHIFT_PIXELS = 6.0, 0.5
"""Gray levels and pixels by which a plate is off where nothing moves (docs/method/masks.md)."""


UNSEEN_DIFFERENCE = 1e30
"""Squared difference of what is not seen."""

LIGHT_SIDE, DETAIL_SIDE, DETAIL_NOISE = 5, 9, 1.5
"""Sides in pixels of the squares whose mean color, and whose detail, are compared with the plate's, and the gray levels that detail
has everywhere. Chosen by eye."""


@dataclass(frozen=True)
class PlateComparison:
    """How a frame differs from its plates, each [H, W] float32.

    Attributes:
        similar: multiples of its noise by which it differs from the plate that is most like it; -1 where there is no plate.
        median: the same for the middle plate.
        brightness: natural logarithm of its brightness over that of the middle plate, the mean of red, green and blue.
        tint: by how much the largest of the three is above the smallest: a shadow leaves them about equal.
        detail: correlation of its detail with that of the middle plate, -1 to 1: however dark a shadow is, it leaves the detail.
    """

    similar: np.ndarray
    median: np.ndarray
    brightness: np.ndarray
    tint: np.ndarray
    detail: np.ndarray


class CleanPlate:
    """Compares the training frames of a clip with their static scene.

    Args:
        blocked: bool [T, H, W], the objects as far as they are known, with a margin.
    """

    def __init__(self, clip: MatchedClip, background: StaticDepth, blocked: np.ndarray):
        self._clip, self._background, self._blocked = clip, background, blocked
        self._cameras = [clip.scene.cameras[i] for i in clip.scene.train_frames]
        self._frame = lru_cache(maxsize=2 * PLATE_OFFSETS[-1] + 1)(lambda k: clip.scene.frame(clip.scene.train_frames[k]))

    def compare(self, k: int) -> PlateComparison:
        """Return how a frame differs from what others see there."""
        clip, frame = self._clip, self._frame(k)
        offsets = PLATE_OFFSETS if len(clip) > FEW_FRAMES else range(1, FEW_FRAMES)
        around = [k + sign * offset for offset in offsets for sign in (-1, 1)]
        others = [j for j in around if 0 <= j < len(clip) and clip.continuity.are_joined(k, j)]
        if len(others) < MIN_VIEWS:
            unknown = np.full(frame.shape[:2], -1, np.float32)
            return PlateComparison(unknown, unknown, 0 * unknown, 0 * unknown, 0 * unknown)
        inverse = self._background.behind(k)
        depth = 1 / np.maximum(upsample(inverse, frame, clip.scene.width, clip.scene.height), 1e-3 * float(np.median(inverse)))
        similar, median = np.empty((2, *frame.shape), np.float32)
        spread, count = np.empty(depth.shape, np.float32), np.empty(depth.shape, np.uint8)
        words = pack(np.stack([self._frame(j) for j in others]), self._blocked[others])
        parallel_for(
            _plates, len(frame), frame, depth.astype(np.float32), *_poses(self._cameras[k], [self._cameras[j] for j in others]),
            words.reshape(-1), similar, median, spread, count,
        )  # fmt: skip
        # Of many frames those that look most like the pixel decide, and others may be of an object; few images must all agree.
        spread *= len(clip) <= FEW_FRAMES
        known = count >= MIN_VIEWS
        off = [np.where(known, difference(frame, plate, spread), -1).astype(np.float32) for plate in (similar, median)]
        light = *compare_light(frame, median), compare_detail(frame, median)
        return PlateComparison(*off, *(np.where(known, told, 0) for told in light))


def _poses(camera: Camera, others: list[Camera]) -> tuple[np.ndarray, np.ndarray]:
    """Return (fx, fy, cx, cy [1 + J, 4]; relative poses [J, 3, 4]) of a camera and others, float32."""
    intrinsics = np.array([c.intrinsics for c in (camera, *others)], np.float32)
    return intrinsics, np.array([other.pose_from(camera) for other in others], np.float32)


@kernel
def _plates(
    begin: int, end: int, frame: np.ndarray, depth: np.ndarray, intrinsics: np.ndarray, poses: np.ndarray, words: np.ndarray,
    similar: np.ndarray, median: np.ndarray, spread: np.ndarray, count: np.ndarray,
) -> None:  # fmt: skip
    """The static scene at the pixels of ``frame``.

    Fills the colors most like it and the middle ones, [H, W, 3] float32, how far half of the frames are from the former (mean
    squared difference [H, W]), and how many frames see the pixel [H, W] uint8.
    """
    H, W = depth.shape
    J = len(poses)
    half, one, nothing, far = np.float32(0.5), np.float32(1), np.float32(0), np.float32(UNSEEN_DIFFERENCE)
    width, height, agreeing = np.float32(W), np.float32(H), np.float32(SIMILAR_SHARE)
    K = intrinsics[0]
    room = max(W, LANES)
    for y in range(begin, end):
        row = np.empty(4 * room, np.float32)  # depth and colors
        for x in range(room):
            row[x] = depth[y, min(x, W - 1)]
            for q in range(3):
                row[(1 + q) * room + x] = np.float32(frame[y, min(x, W - 1), q])
        seen, apart = np.empty(3 * J * LANES, np.float32), np.empty(J * LANES, np.float32)
        bright = np.empty(J * LANES, np.float32)
        found = np.empty(8 * room, np.float32)  # colors, spread, count and middle colors
        dy = (np.float32(y) + half - K[3]) / K[1]
        for block in range(0, room, LANES):
            first = min(block, room - LANES)  # The last block overlaps the one before.
            z = load(row, first)
            px, py = (lane_numbers() + (np.float32(first) + half - K[2])) / K[0] * z, dy * z
            n = broadcast(nothing)
            for j in range(J):
                P, L = poses[j], intrinsics[j + 1]
                qz = P[2, 0] * px + P[2, 1] * py + P[2, 2] * z + P[2, 3]
                u = L[0] * (P[0, 0] * px + P[0, 1] * py + P[0, 2] * z + P[0, 3]) / qz + (L[2] - half)
                v = L[1] * (P[1, 0] * px + P[1, 1] * py + P[1, 2] * z + P[1, 3]) / qz + (L[3] - half)
                holds = where_above(qz, np.float32(1e-6) * z, broadcast(one), broadcast(nothing))
                inside = where_at_least(u, width - half, broadcast(nothing), holds)
                holds = where_at_least(u, -half, inside, broadcast(nothing))
                inside = where_at_least(v, height - half, broadcast(nothing), holds)
                holds = where_at_least(v, -half, inside, broadcast(nothing))
                store(apart, j * LANES, broadcast(far))
                store(bright, j * LANES, broadcast(far))
                if largest_lane(holds) == nothing:
                    continue
                u = minimum(maximum(u, broadcast(-half)), broadcast(width - one))
                v = minimum(maximum(v, broadcast(-half)), broadcast(height - one))
                start = j * H * W
                nearest = gather(words, start, W, whole(u + half), whole(v + half))
                holds = where_above(byte_of(nearest, 24), nothing, broadcast(nothing), holds)
                u, v = maximum(u, broadcast(nothing)), maximum(v, broadcast(nothing))
                value0, value1, value2 = bilinear(words, start, W, H, u, v)
                off0, off1 = value0 - load(row, room + first), value1 - load(row, 2 * room + first)
                off2 = value2 - load(row, 3 * room + first)
                distance = off0 * off0 + off1 * off1 + off2 * off2
                store(seen, 3 * j * LANES, value0)
                store(seen, (3 * j + 1) * LANES, value1)
                store(seen, (3 * j + 2) * LANES, value2)
                n = n + holds
                store(apart, j * LANES, where_above(holds, nothing, distance, broadcast(far)))
                store(bright, j * LANES, where_above(holds, nothing, value0 + value1 + value2, broadcast(far)))
            none, middle = broadcast(nothing), whole(n * half)
            for q in range(3):
                store(found, (5 + q) * room + first, none)
            for j in range(J):
                here = where_above(n, nothing, _has_rank(bright, J, j, middle), none)
                for q in range(3):
                    at = (5 + q) * room + first
                    store(found, at, where_above(here, nothing, load(seen, (3 * j + q) * LANES), load(found, at)))
            red, green, blue, scatter = average_similar(seen, apart, J, n, agreeing)
            store(found, first, where_above(n, nothing, red, none))
            store(found, room + first, where_above(n, nothing, green, none))
            store(found, 2 * room + first, where_above(n, nothing, blue, none))
            store(found, 3 * room + first, where_above(n, nothing, scatter, none))
            store(found, 4 * room + first, n)
        for x in range(W):
            for q in range(3):
                similar[y, x, q], median[y, x, q] = found[q * room + x], found[(5 + q) * room + x]
            spread[y, x], count[y, x] = found[3 * room + x], np.uint8(found[4 * room + x])


@helper
def bilinear(words, start, W, H, u, v):
    """Red, green and blue (lanes) at u, v of the image that begins at words[start], with pixel centers at whole numbers."""
    one = np.float32(1)
    c, r = minimum(whole(u), broadcast(np.float32(W - 2))), minimum(whole(v), broadcast(np.float32(H - 2)))
    a, b = u - c, v - r
    a00, a01, a10, a11 = (one - a) * (one - b), a * (one - b), (one - a) * b, a * b
    p, q = gather(words, start, W, c, r), gather(words, start + 1, W, c, r)
    s, t = gather(words, start + W, W, c, r), gather(words, start + W + 1, W, c, r)
    red = a00 * byte_of(p, 0) + a01 * byte_of(q, 0) + a10 * byte_of(s, 0) + a11 * byte_of(t, 0)
    green = a00 * byte_of(p, 8) + a01 * byte_of(q, 8) + a10 * byte_of(s, 8) + a11 * byte_of(t, 8)
    blue = a00 * byte_of(p, 16) + a01 * byte_of(q, 16) + a10 * byte_of(s, 16) + a11 * byte_of(t, 16)
    return red, green, blue


@helper
def average_similar(seen, apart, count, n, share):
    """Of the colors that frames see, lane by lane that of the last of the ``share`` which look most like the pixel.

    Args:
        seen: [3 count lanes] of every frame, red, green and blue.
        apart: [count lanes] how far each is from the pixel, squared; ``UNSEEN_DIFFERENCE`` where it sees nothing. Spoiled.
        n: how many see something.

    Returns:
        red, green, blue, and how far half of them are from these, a mean squared difference.
    """
    half, one, nothing, far = np.float32(0.5), np.float32(1), np.float32(0), np.float32(UNSEEN_DIFFERENCE)
    wanted = whole(maximum(share * (n - one) + half, broadcast(nothing)))
    red, green, blue = broadcast(nothing), broadcast(nothing), broadcast(nothing)
    for j in range(count):
        here = _has_rank(apart, count, j, wanted)
        red = where_above(here, nothing, load(seen, 3 * j * LANES), red)
        green = where_above(here, nothing, load(seen, (3 * j + 1) * LANES), green)
        blue = where_above(here, nothing, load(seen, (3 * j + 2) * LANES), blue)
    for j in range(count):
        off0, off1 = load(seen, 3 * j * LANES) - red, load(seen, (3 * j + 1) * LANES) - green
        off2 = load(seen, (3 * j + 2) * LANES) - blue
        distance = off0 * off0 + off1 * off1 + off2 * off2
        store(apart, j * LANES, where_at_least(load(apart, j * LANES), far, broadcast(far), distance))
    # Half of the frames agree so well.
    wanted, scatter = whole(n * half), broadcast(nothing)
    for j in range(count):
        scatter = where_above(_has_rank(apart, count, j, wanted), nothing, load(apart, j * LANES), scatter)
    return red, green, blue, scatter / np.float32(3)


@helper
def _has_rank(values, count, j, wanted):
    """Lanes: 1 where just so many of ``count`` vectors are below vector j, of equal ones the earlier; 0 elsewhere."""
    one, nothing = np.float32(1), np.float32(0)
    mine, below = load(values, j * LANES), broadcast(nothing)
    for k in range(j):
        below = below + where_at_least(mine, load(values, k * LANES), broadcast(one), broadcast(nothing))
    for k in range(j + 1, count):
        below = below + where_above(mine, load(values, k * LANES), broadcast(one), broadcast(nothing))
    return where_at_least(magnitude(below - wanted), np.float32(0.5), broadcast(nothing), broadcast(one))


def difference(frame: np.ndarray, plate: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Return [H, W] float32: how far a frame is off its plate, whose brightness may change, over its noise there.

    Args:
        spread: mean squared difference [H, W] of what it is made from.
    """
    image = frame.astype(np.float32)
    size = (SHADE_SIDE, SHADE_SIDE)
    shade = cv2.boxFilter((image * plate).sum(-1), -1, size) / np.maximum(cv2.boxFilter((plate * plate).sum(-1), -1, size), 1)
    shade = np.clip(shade, *SHADE_RANGE)
    squared = ((image - shade[..., None] * plate) ** 2).mean(-1) + (SHADE_COST * (1 - shade)) ** 2 * (plate**2).mean(-1)
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0)
    slope = sum((cv2.Sobel(smooth, cv2.CV_32F, *axes, scale=1 / 8) ** 2).mean(-1) for axes in ((1, 0), (0, 1)))
    steepest = cv2.dilate(slope, np.ones((3, 3), np.uint8))
    return np.sqrt(squared / (NOISE_LEVELS**2 + SHIFT_PIXELS**2 * steepest + spread)).astype(np.float32)


def compare_light(frame: np.ndarray, plate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ``brightness`` and ``tint`` of ``PlateComparison`` of a frame, each [H, W]."""
    side = (LIGHT_SIDE, LIGHT_SIDE)
    ours, theirs = (cv2.blur(image.astype(np.float32), side) + np.float32(NOISE_LEVELS) for image in (frame, plate))
    ratio = np.log(ours / theirs)
    return ratio.mean(-1), ratio.max(-1) - ratio.min(-1)


def compare_detail(frame: np.ndarray, plate: np.ndarray) -> np.ndarray:
    """Return ``detail`` of ``PlateComparison`` of a frame, [H, W] float32."""
    ours, theirs = (cv2.GaussianBlur(image.astype(np.float32).mean(-1), (0, 0), 0.7) for image in (frame, plate))

    def covariance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        side = (DETAIL_SIDE, DETAIL_SIDE)
        return np.asarray(cv2.blur(a * b, side) - cv2.blur(a, side) * cv2.blur(b, side))

    energy = [np.maximum(covariance(image, image), 0) + np.float32(DETAIL_NOISE**2) for image in (ours, theirs)]
    return covariance(ours, theirs) / np.sqrt(energy[0] * energy[1])
