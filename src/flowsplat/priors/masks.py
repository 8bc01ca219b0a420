"""Masks of moving objects without learned weights: what many matches say does not rest.

The evidence of a frame is how far its matches lie off the rigid scene: the smaller of the residual under the best depth
and twice the distance from the epipolar line, over the noise of the pair (``depth.multiview``). Moving things keep
moving: the evidence is added up along the flow, pulled to the edges of the picture, and cut into objects.
"""

from __future__ import annotations

import cv2
import numpy as np

from flowsplat.common.progress import track
from flowsplat.geometry.cameras import pixel_grid
from flowsplat.priors.continuity import Continuity
from flowsplat.priors.depth.clip import RESTS, SolvedClip
from flowsplat.priors.flow import sample_map
from flowsplat.scenes import Scene

STRONGEST = 1.5
"""Most that one frame can say, for or against: the logarithm to base 2 of the motion over ``RESTS``."""

MEMORY = 0.9
"""Share of the evidence that a frame takes over from the next and the one before."""

CERTAIN = 2.0
"""Mean evidence that an object needs: more than one frame can give."""

SMALLEST = 0.001
"""Share of the picture below which an object is dropped; a hole is closed below a quarter of it."""

FRAGMENT = 0.2
"""Share of an object's largest part up to which another part still belongs to it."""

_SMOOTHNESS, _COLOUR_SIGMA = 10.0, 12.0


def mask_stage(scene: Scene) -> None:
    """Masks with object numbers for the training frames, if there are none. Needs cameras and flow."""
    if scene.prior("masks") is not None:
        return
    clip = SolvedClip(scene)
    forward: list[np.ndarray] = []
    for k in range(len(clip)):
        evidence = _evidence(clip, k)
        if k > 0:
            evidence += MEMORY * _carried(clip, forward[-1], k, k - 1)
        forward.append(evidence.astype(np.float16))
    backward: np.ndarray = np.zeros_like(forward[-1], np.float32)
    for k in track(range(len(clip) - 1, -1, -1), "Masks"):
        if k + 1 < len(clip):
            backward = MEMORY * _carried(clip, backward, k, k + 1)
        moving = _cut(forward[k] + backward, scene.frame(scene.train_frames[k]))
        scene.write_mask(scene.train_frames[k], moving)
        backward = backward + _evidence(clip, k)
    objects, share = _number(scene)
    verdict = f"{objects} moving object{'s' * (objects > 1)} on {share:.1%} of the picture" if objects else "nothing moves"
    scene.finish_prior("masks", method="motion", verdict=verdict, objects=objects, share=round(share, 5))


def _evidence(clip: SolvedClip, k: int) -> np.ndarray:
    """[h, w] float32: positive where a frame's own matches speak for motion, negative for rest, 0 without matches."""
    motion = clip[k].motion
    strength = np.log2(np.maximum(motion, 1e-3) / np.float32(RESTS))
    return np.where(motion > 0, np.clip(strength, -STRONGEST, STRONGEST), 0)


def _carried(clip: SolvedClip, evidence: np.ndarray, k: int, j: int) -> np.ndarray:
    """The evidence of training frame ``j`` at the pixels of its neighbour ``k``, [h, w]; 0 without a trusted match."""
    if not clip.continuity.joined(k, j):
        return np.zeros_like(evidence, np.float32)
    flow, confidence = clip.step_flow(k, j)
    points = pixel_grid(clip.width, clip.height) + flow
    carried = sample_map(evidence.astype(np.float32), points.reshape(-1, 2)).reshape(evidence.shape)
    return np.where(confidence >= 0.5, carried, 0)


def _cut(evidence: np.ndarray, frame: np.ndarray) -> np.ndarray:
    """Evidence at working resolution and its frame [H, W, 3] to a mask [H, W] uint8 of 0 and 1."""
    height, width = frame.shape[:2]
    large = cv2.resize(evidence.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    smooth = cv2.ximgproc.fastGlobalSmootherFilter(np.ascontiguousarray(frame), large, _SMOOTHNESS, _COLOUR_SIGMA)
    moving: np.ndarray = (smooth > 0).astype(np.uint8)
    # Slivers, above all along the border where matches are few.
    moving = cv2.morphologyEx(moving, cv2.MORPH_OPEN, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7)))
    smallest = SMALLEST * height * width
    _, holes, stats, _ = cv2.connectedComponentsWithStats(1 - moving, connectivity=4)
    moving = np.where((stats[:, cv2.CC_STAT_AREA] < smallest / 4)[holes], np.uint8(1), moving)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(moving)
    means = np.bincount(labels.ravel(), smooth.ravel(), count) / stats[:, cv2.CC_STAT_AREA]
    kept = (stats[:, cv2.CC_STAT_AREA] >= smallest) & (means >= CERTAIN)
    kept[0] = False
    return kept[labels].astype(np.uint8)


def _number(scene: Scene) -> tuple[int, float]:
    """Give the parts of the stored masks object numbers that follow them over time.

    A part takes the number that most of its pixels had one frame before, or a new one if most had none. Of several parts
    with one number the largest keeps it, with its fragments; the others part ways.

    Returns:
        How many objects there are, and the share of all pixels they cover.
    """
    frames = scene.train_frames
    continuity = Continuity(scene)
    grid = pixel_grid(scene.width, scene.height)
    before = np.zeros((scene.height, scene.width), np.uint8)
    highest, pixels = 0, 0
    for index, i in enumerate(frames):
        count, labels = cv2.connectedComponents((scene.mask(i) > 0).astype(np.uint8))
        numbers = np.zeros(count, np.uint8)
        if index and not continuity.same_piece(index, index - 1):
            before = np.zeros_like(before)
        elif index and count > 1:
            came_from = np.floor(grid + scene.flow(i, frames[index - 1]).flow).astype(int)
            x, y = (np.clip(came_from[..., axis], 0, size - 1) for axis, size in ((0, scene.width), (1, scene.height)))
            before = before[y, x]
        areas = np.bincount(labels.ravel(), minlength=count)
        taken: dict[int, int] = {}
        for part in sorted(range(1, count), key=lambda part: -areas[part]):
            number = int(np.bincount(before[labels == part], minlength=1).argmax())
            if number == 0 or areas[part] > FRAGMENT * taken.get(number, areas[part] / FRAGMENT):
                highest = min(highest + 1, 255)
                number = highest
            taken.setdefault(number, int(areas[part]))
            numbers[part] = number
        before = np.asarray(numbers[labels])
        scene.write_mask(i, before)
        pixels += int((before > 0).sum())
    return highest, pixels / (len(frames) * scene.width * scene.height)
