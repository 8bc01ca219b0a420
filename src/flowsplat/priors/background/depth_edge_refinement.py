"""Depth near its jumps: flow lets near surfaces swell by several pixels, and the images tell where they end.

A pixel near a jump of depth belongs to one of the surfaces around it. Each of them proposes its depth; other frames show the
pixel's surroundings where the right one leads (a vote of colors, weighed by likeness to the pixel, as in
https://doi.org/10.1109/TPAMI.2006.70). What another frame hides speaks for nothing: the better half of the frames counts, of those
whose image holds the place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from flowsplat.common.kernels import helper, inline, kernel
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
from flowsplat.common.threads import compute_once, parallel_for
from flowsplat.geometry import Camera
from flowsplat.priors.background.bits import pack
from flowsplat.priors.background.matched_clip import MatchedClip

FRAME_OFFSETS = (-16, -8, -4, 4, 8, 16)
"""Training frames before and after that are asked (docs/method/depth.md)."""
PROPOSAL_RADII = (4, 9, 15)
"""Pixels from which the nearest and the farthest surface are proposed. Chosen on workshop and garden (docs/method/depth.md;
docs/notebook/2026-11.md)."""
MIN_DEPTH_RANGE = 0.06
"""Range of inverse depth within the last reach, as a share of it, from which a pixel is asked about (docs/method/depth.md)."""
REFINEMENT_ROUNDS = 2
"""How often every edge is refined. docs/method/depth.md has two."""
MAX_COST_RATIO = 0.95
"""The depth that a pixel has stays, unless another has less than this share of its cost. Chosen by eye."""
VOTE_RADIUS = 4
"""Pixels to either side that vote (docs/method/depth.md)."""
VOTING_COLOR_SCALE = 20.0
"""Sum of the differences in red, green and blue at which a pixel's vote counts half. Chosen by eye."""
_MAX_COLOR_DIFFERENCE, _MAX_GRADIENT_DIFFERENCE, _UNSEEN_COST = 60.0, 20.0, 60.0
"""Largest difference of colors and of gradients that counts; cost where no frame says anything. Chosen by eye."""
_ROW_MARGIN = VOTE_RADIUS
"""Numbers before and after a row, so that what lies beside the image can be loaded; of costs they are 0: no vote."""


@dataclass(frozen=True)
class EdgeView:
    """What a frame shows, in eight bytes a pixel.

    Attributes:
        words: [H, W] red, green, blue, and whether something moves there, which says nothing of the still scene (``packed``).
        slopes: [H, W] float32, size of the gradient of its gray.
    """

    words: np.ndarray
    slopes: np.ndarray

    @staticmethod
    def of(image: np.ndarray, moving: np.ndarray) -> EdgeView:
        """Pack an image [H, W, 3] uint8 and what moves in it [H, W] bool."""
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
        across, down = cv2.Sobel(gray, cv2.CV_32F, 1, 0) / 4, cv2.Sobel(gray, cv2.CV_32F, 0, 1) / 4
        return EdgeView(pack(image[None], moving[None])[0], np.hypot(across, down))

    @property
    def features(self) -> np.ndarray:
        """Red, green, blue and size of the gradient [H, W, 4] float32."""
        bits = self.words.view(np.uint32)
        return np.dstack([*((bits >> shift & 255).astype(np.float32) for shift in (0, 8, 16)), self.slopes])


def refine_edges(
    inverse: np.ndarray, still: np.ndarray, view: EdgeView, camera: Camera, others: Sequence[EdgeView], cameras: Sequence[Camera],
    doubted: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """Return inverse depth [H, W] float32 with its jumps where the images have them.

    Args:
        inverse: [H, W] float32, positive.
        still: [H, W] bool, pixels that may change.
        view: the frame.
        camera: of the frame.
        others: other frames, at least one.
        cameras: of these.
        doubted: [H, W] bool, the only pixels that are asked about; None = all near a jump.
    """
    poses = np.array([other.pose_from(camera) for other in cameras], np.float32).reshape(-1, 3, 4)
    intrinsics = np.array([c.intrinsics for c in [camera, *cameras]], np.float32)
    words, slopes = np.stack([other.words for other in others]), np.stack([other.slopes for other in others])
    image = view.features
    for _ in range(REFINEMENT_ROUNDS):
        around = [cv2.getStructuringElement(cv2.MORPH_RECT, (2 * reach + 1, 2 * reach + 1)) for reach in PROPOSAL_RADII]
        far, close = [cv2.erode(inverse, each) for each in around], [cv2.dilate(inverse, each) for each in around]
        proposed = [inverse, *far, *close]  # Equal ones are neighbors, and are tried once.
        asked = still & (close[-1] - far[-1] > MIN_DEPTH_RANGE * inverse)
        if doubted is not None:
            asked &= doubted
        if not asked.any():
            break
        near = cv2.dilate(asked.astype(np.uint8), np.ones((2 * VOTE_RADIUS + 1, 2 * VOTE_RADIUS + 1), np.uint8)) > 0
        every = np.stack(proposed)
        costs = _costs(every, near, image, words, slopes, intrinsics, poses)
        inverse = _choose_proposals(every, costs, asked, image)
    return inverse


class EdgeRefiner:
    """Refines the frames of a clip one after the other, or a few at once; those it is asked for lie up to ``room`` apart."""

    def __init__(self, clip: MatchedClip, has_masks: bool, room: int):
        self._clip, self._has_masks = clip, has_masks
        self._seen = compute_once(self._see, 2 * FRAME_OFFSETS[-1] + room)

    def __call__(self, k: int, inverse: np.ndarray, doubted: np.ndarray | None = None) -> np.ndarray:
        """Return inverse depth [H, W] float32 of training frame k at full size, with its jumps where the images have them.

        ``doubted`` as in ``refine_edges``.
        """
        scene, same = self._clip.scene, self._clip.continuity.same_piece
        others = [j for j in (k + offset for offset in FRAME_OFFSETS) if 0 <= j < len(self._clip) and same(k, j)]
        if not others:
            return inverse
        cameras = [scene.cameras[scene.train_frames[j]] for j in (k, *others)]
        (view, moving), seen = self._seen(k), [self._seen(j)[0] for j in others]
        return refine_edges(inverse, ~moving, view, cameras[0], seen, cameras[1:], doubted)

    def _see(self, k: int) -> tuple[EdgeView, np.ndarray]:
        """Return a frame, where objects and what is close to them say nothing, and objects [H, W] bool."""
        scene, i = self._clip.scene, self._clip.scene.train_frames[k]
        moving = scene.mask(i) > 0 if self._has_masks else np.zeros((scene.height, scene.width), bool)
        near = cv2.dilate(moving.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        return EdgeView.of(scene.frame(i), near), moving


@inline
def _mix(corners, shift, a00, a01, a10, a11):
    """A byte of four words, bilinear."""
    p, q, s, t = corners
    return a00 * byte_of(p, shift) + a01 * byte_of(q, shift) + a10 * byte_of(s, shift) + a11 * byte_of(t, shift)


def _costs(
    proposed: np.ndarray, near: np.ndarray, image: np.ndarray, words: np.ndarray, slopes: np.ndarray, intrinsics: np.ndarray,
    poses: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Return [L, H, S] float32: how much the better half of the frames differs from a pixel at each proposed inverse depth [L, H,
    W].

    Of every other pixel, as on a chessboard: they vote as well as all, in half the time. A row holds its columns y % 2, y % 2 + 2,
    ... from ``_ROW_MARGIN`` on, and 0 beside them. ``words``: colors and objects of the others as from ``packed``,
    ``slopes``: the sizes of their gradients, each [J, H, W].
    """
    L, H, W = proposed.shape
    result = np.zeros((L, H, _row_size(W)), np.float32)
    parallel_for(
        _costs_of_rows, H, proposed, near, image, words.reshape(-1), slopes.reshape(-1), intrinsics, poses, result.reshape(-1)
    )
    return result


@kernel
def _costs_of_rows(
    begin: int, end: int, proposed: np.ndarray, near: np.ndarray, image: np.ndarray, words: np.ndarray, slopes: np.ndarray,
    intrinsics: np.ndarray, poses: np.ndarray, flat: np.ndarray,
) -> None:  # fmt: skip
    L, H, W = proposed.shape
    J = len(poses)
    kept = max(J // 2, 1)
    S = _row_size(W)
    half, one, worst = np.float32(0.5), np.float32(1), np.float32(_UNSEEN_COST)
    most, steepest, nothing = np.float32(_MAX_COLOR_DIFFERENCE), np.float32(_MAX_GRADIENT_DIFFERENCE), np.float32(0)
    right, bottom = np.float32(W - 1), np.float32(H - 1)
    K0 = intrinsics[0]
    for y in range(begin, end):
        depths, seen, wanted = np.empty(L * S, np.float32), np.empty(4 * S, np.float32), np.empty(S, np.bool_)
        for i in range(S):
            wanted[i] = False
            for n in range(4):
                seen[n * S + i] = nothing
            for n in range(L):
                depths[n * S + i] = one
        for i in range((W - y % 2 + 1) // 2):
            x = 2 * i + y % 2
            wanted[i] = near[y, x]
            for n in range(L):
                depths[n * S + i] = proposed[n, y, x]
                flat[(n * H + y) * S + _ROW_MARGIN + i] = worst
            for n in range(4):
                seen[n * S + i] = image[y, x, n]
        best = np.empty(kept * LANES, np.float32)
        dy = (np.float32(y) + half - K0[3]) / K0[1]
        for first in range(0, (W + 1) // 2, LANES):
            if not _any(wanted, first):
                continue
            x = np.float32(2) * lane_numbers() + np.float32(2 * first + y % 2)
            dx = (x + (half - K0[2])) / K0[0]
            red, green, blue, slope = load(seen, first), load(seen, S + first), load(seen, 2 * S + first), load(seen, 3 * S + first)
            for n in range(L):
                out = (n * H + y) * S + _ROW_MARGIN + first
                same = n > 0
                for i in range(first, first + LANES):
                    same = same and depths[n * S + i] == depths[(n - 1) * S + i]
                if same:
                    store(flat, out, load(flat, out - H * S))
                    continue
                w = load(depths, n * S + first)
                for k in range(kept):
                    store(best, k * LANES, broadcast(worst))
                said = broadcast(nothing)
                for j in range(J):
                    P, K = poses[j], intrinsics[j + 1]
                    z = P[2, 0] * dx + (P[2, 1] * dy + P[2, 2]) + w * P[2, 3]
                    nearer = one / z
                    u = K[0] * (P[0, 0] * dx + (P[0, 1] * dy + P[0, 2]) + w * P[0, 3]) * nearer + (K[2] - half)
                    v = K[1] * (P[1, 0] * dx + (P[1, 1] * dy + P[1, 2]) + w * P[1, 3]) * nearer + (K[3] - half)
                    holds = where_above(z, np.float32(1e-6), broadcast(one), broadcast(nothing))
                    holds = where_at_least(u, nothing, where_at_least(u, right, broadcast(nothing), holds), broadcast(nothing))
                    holds = where_at_least(v, nothing, where_at_least(v, bottom, broadcast(nothing), holds), broadcast(nothing))
                    if largest_lane(holds) == nothing:
                        continue
                    u = minimum(maximum(u, broadcast(nothing)), broadcast(right - half))
                    v = minimum(maximum(v, broadcast(nothing)), broadcast(bottom - half))
                    c, row = whole(u), whole(v)
                    start, below = j * H * W, (j * H + 1) * W
                    corners = (
                        gather(words, start, W, c, row), gather(words, start + 1, W, c, row),
                        gather(words, below, W, c, row), gather(words, below + 1, W, c, row),
                    )  # fmt: skip
                    holds = where_above(byte_of(corners[0], 24), nothing, broadcast(nothing), holds)
                    said = said + holds
                    a, b = u - c, v - row
                    a00, a01, a10, a11 = (one - a) * (one - b), a * (one - b), (one - a) * b, a * b
                    off = magnitude(_mix(corners, 0, a00, a01, a10, a11) - red)
                    off = off + magnitude(_mix(corners, 8, a00, a01, a10, a11) - green)
                    off = off + magnitude(_mix(corners, 16, a00, a01, a10, a11) - blue)
                    there = a00 * gather(slopes, start, W, c, row) + a01 * gather(slopes, start + 1, W, c, row)
                    there = there + a10 * gather(slopes, below, W, c, row) + a11 * gather(slopes, below + 1, W, c, row)
                    total = half * minimum(off, broadcast(most)) + minimum(magnitude(there - slope), broadcast(steepest))
                    total = where_above(holds, nothing, total, broadcast(worst))
                    for k in range(kept):  # The smallest ones stay in order.
                        before = load(best, k * LANES)
                        store(best, k * LANES, minimum(before, total))
                        total = maximum(before, total)
                total, counted = load(best, 0), broadcast(one)
                for k in range(1, kept):
                    total = total + where_at_least(said, np.float32(2 * k + 1), load(best, k * LANES), broadcast(nothing))
                    counted = counted + where_at_least(said, np.float32(2 * k + 1), broadcast(one), broadcast(nothing))
                store(flat, out, total / counted)
            for i in range(max((W - y % 2 + 1) // 2, first), first + LANES):
                for n in range(L):
                    flat[(n * H + y) * S + _ROW_MARGIN + i] = nothing


@helper
def _any(wanted: np.ndarray, first: int) -> bool:
    found = False
    for i in range(first, first + LANES):
        found |= wanted[i]
    return found


@helper
def _row_size(width: int) -> int:
    """Return numbers in a row of every other pixel, with room beside them."""
    return (width + 1) // 2 + LANES + 2 * _ROW_MARGIN


def _choose_proposals(proposed: np.ndarray, costs: np.ndarray, asked: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Return [H, W] the proposal of the least cost around each pixel, by pixels that look like it; the first where none is asked
    for."""
    voters = np.zeros((3, *costs.shape[1:]), np.float32)  # the colors of the pixels that vote, as their costs lie
    for parity in range(2):
        row = image[parity::2, parity::2, :3]
        voters[:, parity::2, _ROW_MARGIN : _ROW_MARGIN + row.shape[1]] = row.transpose(2, 0, 1)
    result = proposed[0].copy()
    parallel_for(_choose_rows, len(result), proposed, costs.reshape(-1), voters.reshape(-1), asked, image, result)
    return result


@kernel
def _choose_rows(
    begin: int, end: int, proposed: np.ndarray, votes: np.ndarray, voters: np.ndarray, asked: np.ndarray, image: np.ndarray,
    result: np.ndarray,
) -> None:  # fmt: skip
    L, H, W = proposed.shape
    S = len(votes) // (L * H)
    scale, one = np.float32(1 / VOTING_COLOR_SCALE), np.float32(1)
    for y in range(begin, end):
        totals, found = np.empty(L * LANES, np.float32), np.empty(LANES, np.float32)
        near, mine, wanted = np.empty(L * S, np.float32), np.empty(3 * S, np.float32), np.empty(S, np.bool_)
        for parity in range(2):
            columns = (W - parity + 1) // 2
            for i in range(S):
                x = min(2 * i + parity, W - 1)
                wanted[i] = i < columns and asked[y, x]
                for n in range(L):
                    near[n * S + i] = proposed[n, y, x]
                for n in range(3):
                    mine[n * S + i] = image[y, x, n]
            for first in range(0, columns, LANES):
                if not _any(wanted, first):
                    continue
                red, green, blue = load(mine, first), load(mine, S + first), load(mine, 2 * S + first)
                for n in range(L):
                    store(totals, n * LANES, broadcast(np.float32(0)))
                for r in range(max(y - VOTE_RADIUS, 0), min(y + VOTE_RADIUS + 1, H)):
                    for aside in range(-VOTE_RADIUS + (parity + r + VOTE_RADIUS) % 2, VOTE_RADIUS + 1, 2):
                        at = r * S + _ROW_MARGIN + first + (parity + aside - r % 2) // 2
                        off = magnitude(load(voters, at) - red) + magnitude(load(voters, H * S + at) - green)
                        off = (off + magnitude(load(voters, 2 * H * S + at) - blue)) * scale
                        weight = one / (one + off * off)
                        for n in range(L):
                            store(totals, n * LANES, load(totals, n * LANES) + weight * load(votes, n * H * S + at))
                best, chosen = load(totals, 0) * np.float32(MAX_COST_RATIO), load(near, first)
                for n in range(1, L):
                    total = load(totals, n * LANES)
                    chosen = where_above(best, total, load(near, n * S + first), chosen)
                    best = minimum(best, total)
                store(found, 0, chosen)
                for i in range(first, min(first + LANES, columns)):
                    if wanted[i]:
                        result[y, 2 * i + parity] = found[i - first]
