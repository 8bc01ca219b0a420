"""Measure what the still scene does not explain, in color, over all frames: evidence that needs no flow in the frame itself.

Other frames that are sure of the static depth are carried to a frame, and vote on what it should see at each of its pixels: a
surface on which enough of them agree is there, and not hidden by anything still. Where the frame looks like none of these
surfaces, something stands before them that does not rest.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from flowsplat.common.kernels import kernel
from flowsplat.common.simd import (
    LANES,
    broadcast,
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
from flowsplat.common.spread import spread
from flowsplat.common.threads import parallel_for
from flowsplat.priors.background.bits import pack
from flowsplat.priors.background.matched_clip import MatchedClip
from flowsplat.priors.background.reprojection import reproject
from flowsplat.priors.background.static_depth import StaticDepth
from flowsplat.priors.masks.background_plate import SIMILAR_SHARE, UNSEEN_DIFFERENCE, average_similar, bilinear, difference
from flowsplat.priors.masks.plane_sweep import largest_share

ASKED_FRAMES = 16
"""Other frames that are asked, evenly over a piece of the clip (docs/method/masks.md)."""

SURFACE_TOLERANCE = 0.04
"""Share of the inverse depth by which two values of one surface differ at most (docs/method/masks.md)."""

MIN_VOTE_SHARE, MIN_VOTES = 0.25, 2
"""Share of the frames that see anything at a pixel, and number of them, that must agree on a surface (docs/method/masks.md)."""

MAX_SURFACES = 3
"""That are compared with a pixel at most, those of the most votes (docs/method/masks.md)."""

MIN_SWEEP_RESIDUAL = 0.5
"""Multiples of its noise by which a pixel must differ from every surface to be looked for at other depths
(docs/method/masks.md)."""

MAX_SWEEP_INVERSE_DEPTH = 20.0
"""Largest inverse depth at which it is looked for, in those of the clip's median (docs/method/masks.md)."""

SWEEP_STRIDE = 2
"""Only every so many pixels is it looked for, which takes most of the time (docs/method/masks.md)."""

UNKNOWN_SHARE = 0.6
"""Share that a pixel has which too few other frames could see at any depth. Chosen by eye."""

RESIDUAL_BINS = (0.7, 1.1, 1.6, 2.5, 3.5)
"""Rows of ``LOG_ODDS``: multiples of its noise by which a pixel differs from the nearest surface."""
SHARE_BINS = (0.05, 0.22, 0.37, 0.52, 0.67, 0.82, 0.97)
"""Columns of ``LOG_ODDS``: largest share of other frames that the pixel looks like at one depth."""
LOG_ODDS = np.array([
    [0.5, 3.0, 2.4, 2.5, 2.0, 0.0, -2.0],
    [2.2, 3.8, 3.2, 3.0, 2.0, 0.0, -2.0],
    [3.7, 4.5, 3.6, 3.2, 2.0, 0.0, -2.0],
    [6.0, 5.9, 4.2, 3.5, 2.0, 0.0, -2.0],
    [6.8, 5.8, 4.3, 4.0, 2.0, 0.0, -2.0],
])  # fmt: skip
"""Logarithms to base 2 of how much more often objects than still things differ so many times their noise from every surface that
others see (rows), and look like so large a share of other frames at one depth (columns). Counted in ten random worlds of 12 wide
images and seven of 40 frames, which said nearly the same; but what looks like four frames of five at one depth counts as still,
which is right where there are many frames: thin things before the scene (poles) are often missing in its depth."""

LOG_ODDS_WITHOUT_SURFACE = (1.5, 3.0, 2.1, 1.0, -0.2, -2.1, -4.0)
"""The same where no surface is known."""

LOG_ODDS_EXPLAINED = -1.75
"""The same for what looks like a surface that others see."""

MIN_DEPTH_WEIGHT = 1.0
"""Weight from which static depth of another frame counts: less than alone, because frames must agree. Chosen by eye."""


class Unexplained:
    """Compares the frames of a clip whose depth is seen well with what others know of the still scene, at working resolution."""

    def __init__(self, clip: MatchedClip, background: StaticDepth):
        self._clip, self._background = clip, background
        self._image = lru_cache(maxsize=None)(clip.image)
        self._sure = lru_cache(maxsize=None)(self._read_known)

    def evidence(self, k: int) -> np.ndarray:
        """Return logarithm to base 2 [h, w] float32 of how much more often objects than still things look like this."""
        off, share = self.residual(k)
        if (off < 0).all():
            return np.zeros_like(off)
        told = np.where(share < 0, np.float32(UNKNOWN_SHARE), share)
        column = np.interp(told, SHARE_BINS, np.arange(len(SHARE_BINS)))
        row = np.interp(off, RESIDUAL_BINS, np.arange(len(RESIDUAL_BINS)))
        known = map_coordinates(LOG_ODDS, [row, column], order=1)
        found = np.where(
            off < 0,
            np.interp(told, SHARE_BINS, LOG_ODDS_WITHOUT_SURFACE),
            np.where(off <= MIN_SWEEP_RESIDUAL, LOG_ODDS_EXPLAINED, known),
        )
        return np.where((off < 0) & (share < 0), 0, found).astype(np.float32)

    def residual(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Return how far a frame is from what others see there.

        Returns:
            multiples of its noise by which it differs from all surfaces that others agree on, -1 where there are none; and the
            largest share of other frames that look like the pixel at one depth, -1 where too few could see it, 1 where it
            differs from no surface. Both [h, w] float32.
        """
        clip, image = self._clip, self._image(k)
        piece = [j for j in range(len(clip)) if clip.continuity.are_joined(k, j) and j != k]
        others = [piece[n] for n in spread(len(piece), min(ASKED_FRAMES, len(piece)))] if piece else []
        if len(others) < MIN_VOTES:
            return np.full(image.shape[:2], -1, np.float32), np.zeros(image.shape[:2], np.float32)
        cameras = [clip.cameras[j] for j in others]
        values = np.stack([self._reproject(j, k) for j in others])
        intrinsics = np.array([c.intrinsics for c in (clip.cameras[k], *cameras)], np.float32)
        poses = np.array([camera.pose_from(clip.cameras[k]) for camera in cameras], np.float32)
        frames = np.stack([self._image(j) for j in others])
        words = pack(frames, np.zeros(frames.shape[:3], np.bool_))
        plates, scatter = np.empty((MAX_SURFACES, *image.shape), np.float32), np.empty((MAX_SURFACES, *image.shape[:2]), np.float32)
        counts = np.empty(scatter.shape, np.uint8)
        parallel_for(_plates, len(image), image, values, intrinsics, poses, words.reshape(-1), plates, scatter, counts)
        off = np.stack(
            [np.where(counts[s] > 0, difference(image, plates[s], scatter[s]), np.inf) for s in range(MAX_SURFACES)]
        ).min(0)
        off = np.where(np.isfinite(off), off, -1).astype(np.float32)
        asked = (off < 0) | (off > MIN_SWEEP_RESIDUAL)
        return off, np.where(asked, self._share(image, asked, intrinsics, poses, words), 1)

    def _share(
        self, image: np.ndarray, asked: np.ndarray, intrinsics: np.ndarray, poses: np.ndarray, words: np.ndarray
    ) -> np.ndarray:
        """``largest_share`` of every ``SWEEP_STRIDE``th pixel in both directions, which speaks for those beside it, too."""
        height, width = asked.shape
        near = cv2.dilate(asked.astype(np.uint8), np.ones((SWEEP_STRIDE, SWEEP_STRIDE), np.uint8)) > 0
        few = np.zeros_like(asked)
        middle = slice(SWEEP_STRIDE // 2, None, SWEEP_STRIDE)
        few[middle, middle] = near[middle, middle]
        share = largest_share(image, few, MAX_SWEEP_INVERSE_DEPTH * self._clip.median, intrinsics, poses, words)[middle, middle]
        y, x = (
            np.minimum(np.arange(size) // SWEEP_STRIDE, known - 1) for size, known in zip((height, width), share.shape, strict=True)
        )
        return share[np.ix_(y, x)]

    def _read_known(self, j: int) -> tuple[np.ndarray, np.ndarray]:
        inverse, weight = self._background.fill(j)
        return inverse, np.where(weight > MIN_DEPTH_WEIGHT, weight, 0).astype(np.float32)

    def _reproject(self, j: int, k: int) -> np.ndarray:
        """Return inverse depth that frame j is sure of, at the pixels of frame k; 0 where it knows none."""
        seen, _ = reproject(*self._sure(j), self._clip.cameras[j], self._clip.cameras[k])
        # Nearer cameras see the same surface with gaps between its pixels.
        closed = cv2.morphologyEx(seen, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
        return np.where(seen > 0, seen, closed)


@kernel
def _plates(
    begin: int, end: int, frame: np.ndarray, values: np.ndarray, intrinsics: np.ndarray, poses: np.ndarray, words: np.ndarray,
    plates: np.ndarray, scatter: np.ndarray, counts: np.ndarray,
) -> None:  # fmt: skip
    """Colors [S, h, w, 3], their mean squared differences [S, h, w] and number of frames of surfaces that frames agree on."""
    J, H, W = values.shape
    half, one, nothing, far = np.float32(0.5), np.float32(1), np.float32(0), np.float32(UNSEEN_DIFFERENCE)
    same, quarter, least = np.float32(SURFACE_TOLERANCE), np.float32(MIN_VOTE_SHARE), np.float32(MIN_VOTES)
    right, bottom, agreeing = np.float32(W - 1), np.float32(H - 1), np.float32(SIMILAR_SHARE)
    K = intrinsics[0]
    room = max(W, LANES)
    for y in range(begin, end):
        rows, left = np.empty((J + 3) * room, np.float32), np.empty(J * LANES, np.float32)
        for x in range(room):  # inverse depths, and the colors of the frame
            for a in range(J):
                rows[a * room + x] = values[a, y, min(x, W - 1)]
            for q in range(3):
                rows[(J + q) * room + x] = np.float32(frame[y, min(x, W - 1), q])
        seen, apart = np.empty(3 * J * LANES, np.float32), np.empty(J * LANES, np.float32)
        found = np.empty(MAX_SURFACES * 5 * room, np.float32)
        for x in range(MAX_SURFACES * 5 * room):
            found[x] = nothing
        dy = (np.float32(y) + half - K[3]) / K[1]
        for block in range(0, room, LANES):
            first = min(block, room - LANES)  # The last block overlaps the one before.
            dx = (lane_numbers() + (np.float32(first) + half - K[2])) / K[0]
            said = broadcast(nothing)
            for a in range(J):
                here = where_above(load(rows, a * room + first), nothing, broadcast(one), broadcast(nothing))
                store(left, a * LANES, here)
                said = said + here
            needed = maximum(broadcast(least), whole(quarter * said + np.float32(0.999)))
            for s in range(MAX_SURFACES):
                most, center = broadcast(nothing), broadcast(nothing)
                for a in range(J):
                    value, votes = load(rows, a * room + first), broadcast(nothing)
                    for b in range(J):
                        off = magnitude(load(rows, b * room + first) - value)
                        votes = votes + where_at_least(same * value, off, load(left, b * LANES), broadcast(nothing))
                    votes = votes * load(left, a * LANES)
                    center = where_above(votes, most, value, center)
                    most = maximum(most, votes)
                most = where_at_least(most, needed, most, broadcast(nothing))
                if largest_lane(most) == nothing:
                    break
                total = broadcast(nothing)
                for b in range(J):
                    value = load(rows, b * room + first)
                    off = magnitude(value - center)
                    total = total + where_at_least(same * center, off, load(left, b * LANES), broadcast(nothing)) * value
                z = where_above(most, nothing, most / total, broadcast(one))
                px, py, n = dx * z, dy * z, broadcast(nothing)
                for j in range(J):
                    off, here = magnitude(load(rows, j * room + first) - center), load(left, j * LANES)
                    holds = where_at_least(same * center, off, here, broadcast(nothing))
                    holds = where_above(most, nothing, holds, broadcast(nothing))
                    store(left, j * LANES, here - holds)
                    P, L = poses[j], intrinsics[j + 1]
                    qz = P[2, 0] * px + P[2, 1] * py + P[2, 2] * z + P[2, 3]
                    u = L[0] * (P[0, 0] * px + P[0, 1] * py + P[0, 2] * z + P[0, 3]) / qz + (L[2] - half)
                    v = L[1] * (P[1, 0] * px + P[1, 1] * py + P[1, 2] * z + P[1, 3]) / qz + (L[3] - half)
                    holds = where_above(qz, np.float32(1e-6) * z, holds, broadcast(nothing))
                    inside = where_above(u, right, broadcast(nothing), holds)
                    holds = where_at_least(u, nothing, inside, broadcast(nothing))
                    inside = where_above(v, bottom, broadcast(nothing), holds)
                    holds = where_at_least(v, nothing, inside, broadcast(nothing))
                    store(apart, j * LANES, broadcast(far))
                    if largest_lane(holds) == nothing:
                        continue
                    u = minimum(maximum(u, broadcast(nothing)), broadcast(right))
                    v = minimum(maximum(v, broadcast(nothing)), broadcast(bottom))
                    red, green, blue = bilinear(words, j * H * W, W, H, u, v)
                    off0, off1 = red - load(rows, J * room + first), green - load(rows, (J + 1) * room + first)
                    off2 = blue - load(rows, (J + 2) * room + first)
                    store(seen, 3 * j * LANES, red)
                    store(seen, (3 * j + 1) * LANES, green)
                    store(seen, (3 * j + 2) * LANES, blue)
                    store(apart, j * LANES, where_above(holds, nothing, off0 * off0 + off1 * off1 + off2 * off2, broadcast(far)))
                    n = n + holds
                red, green, blue, off = average_similar(seen, apart, J, n, agreeing)
                at, none = 5 * s * room + first, broadcast(nothing)
                store(found, at, where_above(n, nothing, red, none))
                store(found, at + room, where_above(n, nothing, green, none))
                store(found, at + 2 * room, where_above(n, nothing, blue, none))
                store(found, at + 3 * room, where_above(n, nothing, off, none))
                store(found, at + 4 * room, n)
        for s in range(MAX_SURFACES):
            for x in range(W):
                for q in range(3):
                    plates[s, y, x, q] = found[(5 * s + q) * room + x]
                scatter[s, y, x], counts[s, y, x] = found[(5 * s + 3) * room + x], np.uint8(found[(5 * s + 4) * room + x])
