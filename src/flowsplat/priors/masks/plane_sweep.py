"""Is there a depth at which other frames look like a pixel? What rests has one; what moves looks like itself in few of them."""

from __future__ import annotations

import cv2
import numpy as np

from flowsplat.common.kernels import kernel
from flowsplat.common.simd import (
    LANES,
    broadcast,
    byte_of,
    gather,
    lane_numbers,
    largest_lane,
    magnitude,
    maximum,
    minimum,
    where_above,
    where_at_least,
    whole,
)
from flowsplat.common.threads import parallel_for

SAME_OBJECT_DIFFERENCE = 15.0
"""Mean difference in gray levels from the pixel itself from which one beside it belongs to something else. Chosen by eye."""

MAX_DEPTHS = 400
"""Depths that are tried at most, a working pixel apart in the frame that sees them shift most. Chosen by eye."""

MAX_GRAY_DIFFERENCE, MIN_FRAMES = 10.0, 4
"""Mean difference of 3 x 3 pixels in gray levels up to which another frame shows the same, and frames that must see a place.
Chosen by eye."""


def largest_share(
    frame: np.ndarray, asked: np.ndarray, nearest: float, intrinsics: np.ndarray, poses: np.ndarray, words: np.ndarray
) -> np.ndarray:
    """Return the largest share of the frames that look like a pixel at one depth, of those that would see it there, [h, w] float32.

    Args:
        frame: RGB [h, w, 3] uint8.
        asked: [h, w] bool, the pixels of interest.
        nearest: largest inverse depth that is tried.
        intrinsics: fx, fy, cx, cy [1 + J, 4] float32 of the frame and of others.
        poses: [J, 3, 4] float32 of the others, from the axes of the frame's camera.
        words: [J, h, w] the others, as from ``packed``.

    Returns:
        0 to 1; -1 where not asked, along the border, and where fewer than ``MIN_FRAMES`` would see it at any depth.
    """
    result = np.full(asked.shape, -1, np.float32)
    parallel_for(
        _largest_share, len(frame), frame, asked, _limits(frame), np.float32(nearest), intrinsics, poses, words.reshape(-1), result
    )
    return result


def _limits(image: np.ndarray) -> np.ndarray:
    """Return [h, w] float32: mean difference in gray levels up to which another frame shows the same."""
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 0.7)
    slope = sum((cv2.Sobel(smooth, cv2.CV_32F, *axes, scale=1 / 8) ** 2).mean(-1) for axes in ((1, 0), (0, 1)))
    return np.minimum(
        np.float32(MAX_GRAY_DIFFERENCE) + np.float32(0.5) * np.sqrt(slope), np.float32(2 * MAX_GRAY_DIFFERENCE)
    ).astype(np.float32)


@kernel
def _largest_share(
    begin: int, end: int, frame: np.ndarray, asked: np.ndarray, limit: np.ndarray, near: np.float32, intrinsics: np.ndarray,
    poses: np.ndarray, words: np.ndarray, result: np.ndarray,
) -> None:  # fmt: skip
    """As ``largest_share``, with the mean difference ``limit`` [h, w] up to which another frame shows the same.

    As many depths at a time as there are lanes.
    """
    (H, W), J = asked.shape, len(poses)
    half, one, nothing = np.float32(0.5), np.float32(1), np.float32(0)
    right, bottom, fewest = np.float32(W - 1), np.float32(H - 1), np.float32(MIN_FRAMES)
    K = intrinsics[0]
    for y in range(begin, end):
        rays, like, here = np.empty((J, 3), np.float32), np.empty((3, 3), np.bool_), np.empty((3, 3, 3), np.float32)
        for x in range(W):
            if not asked[y, x] or y < 1 or x < 1 or y > H - 2 or x > W - 2:
                continue
            dx, dy = (x + half - K[2]) / K[0], (y + half - K[3]) / K[1]
            n_like = 0
            for b in range(3):
                for a in range(3):
                    total = np.float32(0)
                    for q in range(3):
                        here[b, a, q] = np.float32(frame[y + b - 1, x + a - 1, q])
                        total += abs(here[b, a, q] - np.float32(frame[y, x, q]))
                    like[b, a] = total < np.float32(3 * SAME_OBJECT_DIFFERENCE)
                    n_like += like[b, a]
            most = np.float32(3 * n_like) * limit[y, x]
            longest = np.float32(0)
            for j in range(J):
                for r in range(3):
                    rays[j, r] = poses[j, r, 0] * dx + poses[j, r, 1] * dy + poses[j, r, 2]
                reach = np.float32(0)
                for r in range(2):
                    reach += (poses[j, r, 3]) ** 2
                longest = max(longest, np.sqrt(reach) * near * K[0])
            steps = min(max(int(longest), 8), MAX_DEPTHS)
            best = np.float32(-1)
            for n in range(0, steps, LANES):
                # Those beyond the last one are it once more.
                w = near * minimum(lane_numbers() + np.float32(n + 1), broadcast(np.float32(steps))) / np.float32(steps)
                agree, said = broadcast(nothing), broadcast(nothing)
                for j in range(J):
                    z = rays[j, 2] + w * poses[j, 2, 3]
                    u = intrinsics[j + 1, 0] * (rays[j, 0] + w * poses[j, 0, 3]) / z + intrinsics[j + 1, 2]
                    v = intrinsics[j + 1, 1] * (rays[j, 1] + w * poses[j, 1, 3]) / z + intrinsics[j + 1, 3]
                    holds = where_above(z, np.float32(1e-6), broadcast(one), broadcast(nothing))
                    holds = where_at_least(u, one, where_at_least(u, right, broadcast(nothing), holds), broadcast(nothing))
                    holds = where_at_least(v, one, where_at_least(v, bottom, broadcast(nothing), holds), broadcast(nothing))
                    said = said + holds
                    alike = holds
                    if largest_lane(holds) > nothing:
                        c = whole(minimum(maximum(u, broadcast(one)), broadcast(right - half)))
                        row = whole(minimum(maximum(v, broadcast(one)), broadcast(bottom - half)))
                        total = broadcast(nothing)
                        for b in range(3):
                            for a in range(3):
                                if like[b, a]:
                                    there = gather(words, (j * H + b - 1) * W + a - 1, W, c, row)
                                    total = total + magnitude(byte_of(there, 0) - here[b, a, 0])
                                    total = total + magnitude(byte_of(there, 8) - here[b, a, 1])
                                    total = total + magnitude(byte_of(there, 16) - here[b, a, 2])
                            alike = where_at_least(total, most, broadcast(nothing), holds)
                            if largest_lane(alike) == nothing:
                                break
                    agree = agree + alike
                    # Were all that are left alike, it would still be no more.
                    left = np.float32(J - 1 - j)
                    if largest_lane((agree + left) - best * (said + left)) <= nothing:
                        break
                best = max(best, largest_lane(where_at_least(said, fewest, agree / said, broadcast(np.float32(-1)))))
                if best >= 1:
                    break
            result[y, x] = best
