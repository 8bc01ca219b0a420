"""Depth of the still scene at full size: from half of it, its edges from the images, and what frames agree on."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial

import cv2
import numpy as np

from flowsplat.common.threads import compute_once
from flowsplat.geometry import Camera
from flowsplat.priors.background.depth_edge_refinement import EdgeRefiner
from flowsplat.priors.background.depth_voting import vote_on_depth
from flowsplat.priors.background.fill import upsample
from flowsplat.priors.background.matched_clip import MatchedClip
from flowsplat.priors.background.static_depth import StaticDepth

VOTING_OFFSETS = (2, 4, 8, 16)
"""Training frames before and after, which vote on the depth of a frame's pixels (docs/method/depth.md)."""
REFINEMENT_ROUNDS = 2
"""Of both: edges are found again from what frames agreed on, and what is found is agreed on again. Chosen on workshop and garden
(docs/method/depth.md; docs/notebook/2026-11.md)."""
AGREED_VOTE_SHARE = 0.9
"""Share of the votes from which a pixel is not asked about once more, unless one that is lies within ``DISAGREEMENT_RADIUS``
pixels. Chosen on workshop and garden (docs/method/depth.md; docs/notebook/2026-11.md)."""
DISAGREEMENT_RADIUS = 4
"""Pixels around one that frames do not agree on which are asked about, too (docs/method/depth.md).
Chosen by eye."""

Planes = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Inverse depth of a training frame, the weight of its matches, and the share of the frames that agree, each [H, W] float32."""


class RefinedDepth:
    """That of the frames of a clip. It is fastest if these are asked for one after the other (``walk``)."""

    def __init__(self, clip: MatchedClip, background: StaticDepth, has_masks: bool):
        self._clip, self._background, self._has_masks = clip, background, has_masks
        self._edges = EdgeRefiner(clip, has_masks, REFINEMENT_ROUNDS * (VOTING_OFFSETS[-1] + 4))
        self._moving = compute_once(self._find_moving, 2 * VOTING_OFFSETS[-1] + 4)
        depth: Callable[[int], Planes] = self._coarse
        self._rounds: list[Callable[[int], Planes]] = []
        for n in range(REFINEMENT_ROUNDS if clip.has_parallax else 0):
            # The first frame of a later round asks for frames ahead that ask for frames ahead of theirs. A frame is last asked for
            # by one that comes long after the one that asked before it: what others asked for in between must not push it out.
            kept = (2 * (REFINEMENT_ROUNDS - n) + 1) * VOTING_OFFSETS[-1] + 4
            self._rounds.append(compute_once(self._sharpen(depth, first=n == 0), kept))
            depth = self._vote(self._rounds[n])  # Asked for once, by the next round or by the caller: not kept.
        self._depth = depth

    def __call__(self, k: int) -> Planes:
        """Return inverse depth of the still scene in training frame ``k``, behind objects, too, and how sure it is: see
        ``Planes``."""
        return self._depth(k)

    def walk(self, then: Callable[[int], None], frames: Sequence[int]) -> Iterator[Callable[[], object]]:
        """Yield what to do, one after the other or a few at once, to do ``then`` with these frames: first what others ask of it."""
        ahead, rounds = VOTING_OFFSETS[-1] + 1, len(self._rounds)
        first, last = frames[0], frames[-1]
        for step in range(first - 2 * rounds * ahead, last + 1):
            for n, work in enumerate(self._rounds):
                reach, k = (rounds - n) * VOTING_OFFSETS[-1], step + (rounds - n) * ahead
                if max(first - reach, 0) <= k <= min(last + reach, len(self._clip) - 1):
                    yield partial(work, k)
            if step in frames:
                yield partial(then, step)

    def _coarse(self, k: int) -> Planes:
        scene = self._clip.scene
        frame, (inverse, weight) = scene.frame(scene.train_frames[k]), self._background.fill(k)
        if self._has_masks:
            hidden = self._clip.mask(k) > 0
            inverse = np.where(hidden, self._background.plate(k), inverse) if hidden.any() else inverse
        size = (scene.width, scene.height)
        smooth = upsample(weight.astype(np.float32), np.zeros_like(frame), *size)
        return upsample(inverse, frame, *size), np.maximum(smooth, 0), np.ones_like(smooth)

    def _sharpen(self, depth: Callable[[int], Planes], first: bool) -> Callable[[int], Planes]:
        around = np.ones((2 * DISAGREEMENT_RADIUS + 1, 2 * DISAGREEMENT_RADIUS + 1), np.uint8)

        def doubted(share: np.ndarray) -> np.ndarray | None:
            return None if first else cv2.dilate((share < AGREED_VOTE_SHARE).astype(np.uint8), around) > 0

        def sharpened(k: int) -> Planes:
            inverse, weight, share = depth(k)
            return self._edges(k, inverse, doubted(share)), weight, share

        return sharpened

    def _vote(self, depth: Callable[[int], Planes]) -> Callable[[int], Planes]:
        def agreed_upon(k: int) -> Planes:
            clip, (inverse, weight, _) = self._clip, depth(k)
            near = [j for offset in VOTING_OFFSETS for j in (k - offset, k + offset) if 0 <= j < len(clip)]
            others = [(depth(j)[0], ~self._moving(j)[1], self._camera(j)) for j in near if clip.continuity.same_piece(k, j)]
            inverse, share = vote_on_depth(inverse, ~self._moving(k)[0], self._camera(k), others)
            return inverse, weight, share

        return agreed_upon

    def _camera(self, k: int) -> Camera:
        return self._clip.scene.cameras[self._clip.scene.train_frames[k]]

    def _find_moving(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Objects, and these with what is beside them, each [H, W] bool."""
        scene = self._clip.scene
        if not self._has_masks:
            return (np.zeros((scene.height, scene.width), bool),) * 2
        moving = scene.mask(scene.train_frames[k]) > 0
        return moving, cv2.dilate(moving.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
