"""Evidence of motion from matches.

The evidence of a frame is how far its matches lie off the rigid scene: the smaller of the residual under the best depth
and twice the distance from the epipolar line, over the noise of the pair (``background.multiview``). Moving things keep
moving: the evidence is added up along the flow, pulled to the edges of the image, and cut.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from flowsplat.common.progress import track
from flowsplat.geometry.cameras import pixel_grid
from flowsplat.geometry.interpolation import sample_map
from flowsplat.images.edge_smoothing import EdgeSmoother
from flowsplat.priors.background.matched_clip import MAX_REST_NOISES, MatchedClip
from flowsplat.priors.background.static_depth import StaticDepth
from flowsplat.priors.masks.background_plate import FEW_FRAMES
from flowsplat.priors.masks.photometric_residual import Unexplained
from flowsplat.scenes.layers import TRUSTED_CONFIDENCE

MAX_FRAME_EVIDENCE = 1.5
"""Largest evidence of one frame, for or against motion: the logarithm to base 2 of the motion over ``estimate_resting_motion``.
Chosen by eye."""

RESTING_MOTION_RATIO, MIN_RESTING_MOTION = 3.5, 1.0
"""Multiples of the median motion of all pixels that are neither evidence of motion nor of rest, and the least that may be
(docs/method/masks.md)."""
MOTION_SAMPLES = 24
"""Frames that the median is taken from. Chosen by eye."""
FADE_SHARE, FADE_REACH = 0.35, 0.04
"""Flow fades from an object to what rests beside it, so rest ends at this share of the largest motion around it. So far around,
in units of the long side (docs/method/masks.md)."""

EVIDENCE_MEMORY = 0.9
"""Share of the evidence that a frame takes over from the next and the one before. Chosen by eye."""

MIN_OBJECT_SHARE = 0.001
"""Share of the image below which an object is dropped; a hole is closed below a quarter of it. Chosen by eye."""

_EDGE_AWARE_SMOOTHNESS, _COLOR_SIGMA = 10.0, 12.0
"""Smoothness along the edges of the image, and gray levels across which it no longer reaches. Chosen by eye."""


@dataclass(frozen=True)
class Weighing:
    """How evidence is weighed.

    Attributes:
        color: of what the still scene does not explain, against that of matches.
        rare: summed evidence that a pixel needs, because most pixels rest.
        certain: mean evidence beyond that which an object needs.
    """

    color: float
    rare: float
    certain: float


MANY_FRAMES, FEW_IMAGES, MATCHES_ALONE = Weighing(0.35, 4.0, 2.0), Weighing(0.7, 1.5, 1.0), Weighing(0.0, 0.0, 2.0)
"""For clips of many frames, for few images, and where depth is not seen well (docs/method/masks.md)."""


def choose_weighing(clip: MatchedClip) -> Weighing:
    """That of a clip: of many frames errors of depth are the same from frame to frame, and add up along the flow as motion does.

    Where depth is not seen well, it does not tell where else a pixel is to be seen: a bear that the camera follows has so little
    parallax that its own fur, carried from frame to frame, explained a part of it (IoU .90 became .80).
    """
    if not clip.has_sure_depth:
        return MATCHES_ALONE
    return FEW_IMAGES if len(clip) <= FEW_FRAMES else MANY_FRAMES


def motion_evidence(clip: MatchedClip, background: StaticDepth) -> list[np.ndarray]:
    """Summed evidence [h, w] float16 at working resolution of every training frame: positive where something moves.

    Args:
        background: the still scene, as far as it is known without masks.
    """
    rests, how = estimate_resting_motion(clip), choose_weighing(clip)
    own = [compute_own_evidence(clip, k, rests).astype(np.float16) for k in range(len(clip))]
    if how.color:
        unexplained = Unexplained(clip, background)
        for k in track(range(len(clip)), "What the still scene explains"):
            own[k] = (own[k] + np.float32(how.color) * unexplained.evidence(k)).astype(np.float16)
    sums = propagate(clip, own.__getitem__, clip.step_flow, EVIDENCE_MEMORY)
    return [(total - how.rare).astype(np.float16) for total in track(sums, "What moves", len(clip))][::-1]


def propagate(
    clip: MatchedClip, own: Callable[[int], np.ndarray], flow: Callable[[int, int], tuple[np.ndarray, np.ndarray]], memory: float
) -> Iterator[np.ndarray]:
    """Yield the evidence of each training frame and of those before and after it, [h, w] float32, from the last to the first.

    Args:
        own: the evidence of a frame by itself, [h, w]; asked for twice.
        flow: from a training frame and its neighbor to the flow [h, w, 2] between them and its confidence [h, w].
        memory: share that a frame takes over from each neighbor that it is joined with.
    """

    def from_neighbor(evidence: np.ndarray, k: int, j: int) -> np.ndarray:
        if not clip.continuity.are_joined(k, j):
            return np.zeros_like(evidence, np.float32)
        return memory * _warp(evidence, *flow(k, j))

    forward = [own(0).astype(np.float16)]
    for k in range(1, len(clip)):
        forward.append((own(k) + from_neighbor(forward[-1], k, k - 1)).astype(np.float16))
    backward: np.ndarray = np.zeros_like(forward[-1], np.float32)
    for k in range(len(clip) - 1, -1, -1):
        if k + 1 < len(clip):
            backward = from_neighbor(backward, k, k + 1)
        yield forward.pop() + backward
        backward = backward + own(k)


def estimate_resting_motion(clip: MatchedClip) -> float:
    """Return the multiple of its expected noise at which a pixel's matches are evidence of neither motion nor rest.

    What is expected is the noise of a hard clip. Most pixels rest, so that their median tells how large it really is.
    """
    some = [clip[k].motion for k in range(0, len(clip), max(1, len(clip) // MOTION_SAMPLES))]
    known = np.concatenate([motion[motion > 0] for motion in some])
    return (
        float(np.clip(RESTING_MOTION_RATIO * np.median(known), MIN_RESTING_MOTION, MAX_REST_NOISES))
        if len(known)
        else MAX_REST_NOISES
    )


def compute_own_evidence(clip: MatchedClip, k: int, rests: float) -> np.ndarray:
    """Return [h, w] float32: positive where a frame's own matches are evidence of motion, negative of rest, 0 without matches.

    Args:
        rests: where they are neither.
    """
    motion = clip[k].motion
    reach = max(1, round(FADE_REACH * max(motion.shape)))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    largest = cv2.dilate(cv2.medianBlur(motion.astype(np.float32), 5), disc)
    strength = np.log2(np.maximum(motion, 1e-3) / np.clip(FADE_SHARE * largest, rests, MAX_REST_NOISES))
    return np.where(motion > 0, np.clip(strength, -MAX_FRAME_EVIDENCE, MAX_FRAME_EVIDENCE), 0)


def _warp(evidence: np.ndarray, flow: np.ndarray, confidence: np.ndarray) -> np.ndarray:
    """Return evidence [h, w] of another frame at the pixels from which a flow [h, w, 2] leads there; 0 where it is not trusted."""
    height, width = evidence.shape
    points = pixel_grid(width, height) + flow
    there = sample_map(evidence.astype(np.float32), points.reshape(-1, 2)).reshape(evidence.shape)
    return np.where(confidence >= TRUSTED_CONFIDENCE, there, 0)


def rough_cut(evidence: np.ndarray, frame: np.ndarray, certain: float) -> np.ndarray:
    """Return evidence at working resolution and its frame [H, W, 3] to a mask [H, W] uint8 of 0 and 1.

    Args:
        certain: mean evidence that an object needs.
    """
    smooth = EdgeSmoother(frame, _EDGE_AWARE_SMOOTHNESS, _COLOR_SIGMA).filter(enlarge(evidence, frame))
    moving: np.ndarray = (smooth > 0).astype(np.uint8)
    # Slivers, above all along the border where matches are few.
    moving = cv2.morphologyEx(moving, cv2.MORPH_OPEN, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5)))
    return parts(moving, smooth, certain)


def enlarge(evidence: np.ndarray, like: np.ndarray) -> np.ndarray:
    """Return evidence [h, w] at the size of an image [H, W, ...]: [H, W] float32."""
    return cv2.resize(evidence.astype(np.float32), like.shape[1::-1], interpolation=cv2.INTER_LINEAR)


def parts(moving: np.ndarray, support: np.ndarray, least: float) -> np.ndarray:
    """Return the parts of a mask [H, W] uint8 that are large enough and have a mean ``visibility`` [H, W] of ``least``; holes
    closed."""
    smallest = MIN_OBJECT_SHARE * moving.size
    _, holes, stats, _ = cv2.connectedComponentsWithStats(1 - moving, connectivity=4)
    moving = np.where((stats[:, cv2.CC_STAT_AREA] < smallest / 4)[holes], np.uint8(1), moving)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(moving)
    means = np.bincount(labels.ravel(), support.ravel(), count) / stats[:, cv2.CC_STAT_AREA]
    kept = (stats[:, cv2.CC_STAT_AREA] >= smallest) & (means >= least)
    kept[0] = False
    return kept[labels].astype(np.uint8)
