"""Depth near its jumps: flow lets near surfaces swell by several pixels, and the pictures tell where they end.

A pixel near a jump of depth belongs to one of the surfaces around it. Each of them proposes its depth; other frames show the
pixel's surroundings where the right one leads (a vote of colours, weighed by likeness to the pixel, as in
https://doi.org/10.1109/TPAMI.2006.70). What another frame hides speaks for nothing: the better half of the frames counts, of those
whose picture holds the place.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np
from numba import prange

from flowsplat.common.kernels import parallel_kernel
from flowsplat.geometry import Camera
from flowsplat.priors.background.matched_clip import MatchedClip

OFFSETS = (-16, -8, -4, 4, 8, 16)
"""Training frames before and after that are asked."""
REACHES = (4, 9, 15)
"""Pixels from which the nearest and the farthest surface are proposed."""
JUMP = 0.06
"""Range of inverse depth within the last reach, as a share of it, from which a pixel is asked about."""
ROUNDS = 2
KEEP = 0.95
"""The depth that a pixel has stays, unless another has less than this share of its cost."""
WINDOW = 4
"""Pixels to either side that vote."""
LIKENESS = 20.0
"""Sum of the differences in red, green and blue at which a pixel's vote counts half."""
_COLOUR, _GRADIENT, _WORST = 60.0, 20.0, 60.0
"""Largest difference of colours and of gradients that counts; cost where no frame says anything."""


def features(picture: np.ndarray) -> np.ndarray:
    """Red, green, blue and size of the gradient [H, W, 4] float32 of a picture [H, W, 3] uint8."""
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32)
    across, down = cv2.Sobel(grey, cv2.CV_32F, 1, 0) / 4, cv2.Sobel(grey, cv2.CV_32F, 0, 1) / 4
    return np.dstack([picture.astype(np.float32), np.hypot(across, down)])


def refine_edges(
    inverse: np.ndarray, still: np.ndarray, picture: np.ndarray, camera: Camera, pictures: np.ndarray, moving: np.ndarray,
    cameras: Sequence[Camera], doubted: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """Inverse depth [H, W] float32 with its jumps where the pictures have them.

    Args:
        inverse: [H, W] float32, positive.
        still: [H, W] bool, pixels that may change.
        picture: features [H, W, 4] of the frame.
        pictures: [J, H, W, 4] those of other frames.
        moving: [J, H, W] bool, where these show something that moves, which says nothing of the still scene.
        cameras: [J] of these, at least one.
        doubted: [H, W] bool, the only pixels that are asked about; None = all near a jump.
    """
    poses = np.array([other.pose_from(camera) for other in cameras], np.float32).reshape(-1, 3, 4)
    intrinsics = np.array([c.intrinsics for c in [camera, *cameras]], np.float32)
    for _ in range(ROUNDS):
        around = [cv2.getStructuringElement(cv2.MORPH_RECT, (2 * reach + 1, 2 * reach + 1)) for reach in REACHES]
        far, close = [cv2.erode(inverse, each) for each in around], [cv2.dilate(inverse, each) for each in around]
        proposed = [inverse, *far, *close]  # Equal ones are neighbours, and are tried once.
        asked = still & (close[-1] - far[-1] > JUMP * inverse)
        if doubted is not None:
            asked &= doubted
        near = cv2.dilate(asked.astype(np.uint8), np.ones((2 * WINDOW + 1, 2 * WINDOW + 1), np.uint8)) > 0
        every = np.stack(proposed, -1)
        costs = _costs(every, near, picture, pictures, moving, intrinsics, poses)
        inverse = _chosen(every, costs, asked, picture)
    return inverse


class EdgeRefiner:
    """Refines the frames of a clip one after the other."""

    def __init__(self, clip: MatchedClip, has_masks: bool):
        self._clip, self._has_masks = clip, has_masks
        self._seen = lru_cache(maxsize=2 * OFFSETS[-1] + 2)(self._see)

    def __call__(self, k: int, inverse: np.ndarray, doubted: np.ndarray | None = None) -> np.ndarray:
        """Inverse depth [H, W] float32 of training frame k at full size, with its jumps where the pictures have them.

        ``doubted`` as in ``refine_edges``.
        """
        scene, same = self._clip.scene, self._clip.continuity.same_piece
        others = [j for j in (k + offset for offset in OFFSETS) if 0 <= j < len(self._clip) and same(k, j)]
        if not others:
            return inverse
        cameras = [scene.cameras[scene.train_frames[j]] for j in (k, *others)]
        (picture, _, moving), seen = self._seen(k), [self._seen(j) for j in others]
        return refine_edges(
            inverse, ~moving, picture, cameras[0], np.stack([each[0] for each in seen]), np.stack([each[1] for each in seen]),
            cameras[1:], doubted,
        )  # fmt: skip

    def _see(self, k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Features of a frame, movers and what is close to them, and movers."""
        scene, i = self._clip.scene, self._clip.scene.train_frames[k]
        moving = scene.mask(i) > 0 if self._has_masks else np.zeros((scene.height, scene.width), bool)
        return features(scene.frame(i)), cv2.dilate(moving.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0, moving


@parallel_kernel
def _costs(
    proposed: np.ndarray, near: np.ndarray, picture: np.ndarray, pictures: np.ndarray, moving: np.ndarray,
    intrinsics: np.ndarray, poses: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """[H, W, L] float32: how much the better half of the frames differs from each pixel at each proposed inverse depth.

    Of every other pixel, as on a chessboard: they vote as well as all, in half the time.
    """
    H, W, L = proposed.shape
    J = len(poses)
    kept = max(J // 2, 1)
    result = np.full((H, W, L), np.float32(_WORST), np.float32)
    half, one, worst = np.float32(0.5), np.float32(1), np.float32(_WORST)
    most, steepest = np.float32(_COLOUR), np.float32(_GRADIENT)
    K0 = intrinsics[0]
    for y in prange(H):
        best, rays = np.empty(kept, np.float32), np.empty((J, 3), np.float32)
        for x in range(W):
            if not near[y, x] or (x + y) % 2:
                continue
            dx, dy = (x + half - K0[2]) / K0[0], (y + half - K0[3]) / K0[1]
            red, green, blue, slope = picture[y, x, 0], picture[y, x, 1], picture[y, x, 2], picture[y, x, 3]
            for j in range(J):
                for r in range(3):
                    rays[j, r] = poses[j, r, 0] * dx + poses[j, r, 1] * dy + poses[j, r, 2]
            for n in range(L):
                w = proposed[y, x, n]
                if n > 0 and w == proposed[y, x, n - 1]:
                    result[y, x, n] = result[y, x, n - 1]
                    continue
                best[:] = worst
                said = 0
                for j in range(J):
                    z = rays[j, 2] + w * poses[j, 2, 3]
                    if z <= np.float32(1e-6):
                        continue
                    nearer = one / z
                    u = intrinsics[j + 1, 0] * (rays[j, 0] + w * poses[j, 0, 3]) * nearer + intrinsics[j + 1, 2] - half
                    v = intrinsics[j + 1, 1] * (rays[j, 1] + w * poses[j, 1, 3]) * nearer + intrinsics[j + 1, 3] - half
                    if not (u >= 0 and v >= 0 and u < W - 1 and v < H - 1):
                        continue
                    c, row = int(u), int(v)
                    if moving[j, row, c]:
                        continue
                    said += 1
                    a, b = u - np.float32(c), v - np.float32(row)
                    a00, a01, a10, a11 = (one - a) * (one - b), a * (one - b), (one - a) * b, a * b
                    p, q = pictures[j, row, c], pictures[j, row, c + 1]
                    s, t = pictures[j, row + 1, c], pictures[j, row + 1, c + 1]
                    off0 = abs(a00 * p[0] + a01 * q[0] + a10 * s[0] + a11 * t[0] - red)
                    off1 = abs(a00 * p[1] + a01 * q[1] + a10 * s[1] + a11 * t[1] - green)
                    off2 = abs(a00 * p[2] + a01 * q[2] + a10 * s[2] + a11 * t[2] - blue)
                    off3 = abs(a00 * p[3] + a01 * q[3] + a10 * s[3] + a11 * t[3] - slope)
                    total = half * min(off0 + off1 + off2, most) + min(off3, steepest)
                    # The smallest ones stay in order.
                    k = kept - 1
                    if total < best[k]:
                        while k > 0 and best[k - 1] > total:
                            best[k] = best[k - 1]
                            k -= 1
                        best[k] = total
                counted = min(max((said + 1) // 2, 1), kept)
                total = np.float32(0)
                for k in range(counted):
                    total += best[k]
                result[y, x, n] = total / np.float32(counted)
    return result


@parallel_kernel
def _chosen(proposed: np.ndarray, costs: np.ndarray, asked: np.ndarray, picture: np.ndarray) -> np.ndarray:
    """[H, W] the proposal of the least cost around each pixel, by pixels that look like it; the first where none is asked for."""
    H, W, L = costs.shape
    result = proposed[:, :, 0].copy()
    scale = np.float32(1 / LIKENESS)
    for y in prange(H):
        total = np.empty(L, np.float32)
        for x in range(W):
            if not asked[y, x]:
                continue
            total[:] = 0
            red, green, blue = picture[y, x, 0], picture[y, x, 1], picture[y, x, 2]
            for r in range(max(y - WINDOW, 0), min(y + WINDOW + 1, H)):
                first = max(x - WINDOW, 0)
                for c in range(first + (first + r) % 2, min(x + WINDOW + 1, W), 2):
                    off = abs(picture[r, c, 0] - red) + abs(picture[r, c, 1] - green) + abs(picture[r, c, 2] - blue)
                    weight = np.float32(1) / (np.float32(1) + (off * scale) * (off * scale))
                    for n in range(L):
                        total[n] += weight * costs[r, c, n]
            total[0] *= np.float32(KEEP)
            result[y, x] = proposed[y, x, total.argmin()]
    return result
