"""The mask stage: objects are found by their motion, then cut out by what the images show (docs/method.md, "Flow, masks and
depth").

Matches find what moves, but not its outline: flow takes along what is near an object, and misses what is thin. So the
images decide on the outline: a pixel that differs from the static scene as other frames show it, and that has the
colors of objects, moves; motion decides where no frame sees past it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import cv2
import numpy as np

from flowsplat.common.progress import track
from flowsplat.images.edge_smoothing import EdgeSmoother
from flowsplat.priors.background.matched_clip import MatchedClip
from flowsplat.priors.background.static_depth import static_depth
from flowsplat.priors.flow import FlowEstimator, dis_estimator
from flowsplat.priors.masks.background_plate import CleanPlate
from flowsplat.priors.masks.colors import ColorModel, look_up
from flowsplat.priors.masks.motion import choose_weighing, enlarge, motion_evidence, parts, propagate, rough_cut
from flowsplat.priors.masks.numbers import number_objects
from flowsplat.scenes import Scene

NEUTRAL_RESIDUAL = 1.7
"""Multiples of its noise at which a difference from the plate is evidence of neither motion nor rest. Chosen on garden, workshop,
bear, train and random worlds of seeds 200 to 209 (docs/results.md, Masks of what moves)."""

MAX_PLATE_EVIDENCE = 2.5
"""Largest evidence of a difference from the plate: a logarithm to base 2. Chosen by eye."""

MOTION_WEIGHT, FULL_MOTION_EVIDENCE = 0.6, 8.0
"""Largest evidence of rest that motion gives, and the summed motion evidence at which it does; of motion half as much more.
Chosen by eye."""

COLOR_WEIGHT, MAX_COLOR_EVIDENCE = 0.7, 1.8
"""Weight of the colors' logarithm to base 2, and the most that it counts. Chosen like ``NEUTRAL_RESIDUAL``."""

EVIDENCE_MEMORY = 0.5
"""Share of the evidence that a frame takes over from the next and the one before. Chosen by eye."""

MIN_MOVING_SHARE = 0.3
"""Share of a part that must have been found by its motion (docs/method.md, "Flow, masks and depth")."""

BLOCKED_MARGIN = 0.01
"""Share of the long side by which an object may be larger than its motion shows. Chosen by eye."""

MODEL_FRAMES = 16
"""Frames from which the colors are taken. Chosen by eye."""

_EDGE_AWARE_SMOOTHNESS, _COLOR_SIGMA = 20.0, 10.0
"""Smoothness along the edges of the image, and gray levels across which it no longer reaches. Chosen by eye."""


def mask_stage(scene: Scene, estimate: FlowEstimator = dis_estimator) -> None:
    """Masks with object numbers for the training frames, if there are none. Needs cameras and flow.

    Args:
        estimate: finds the flow between frames that are no neighbors.
    """
    if scene.prior("masks") is not None:
        return
    clip = MatchedClip(scene, estimate)
    motion = motion_evidence(clip, static_depth(clip, False))
    if _rough_masks(clip, motion):
        evidence = _compute_own_evidence(clip, motion)
        for k, mask in enumerate(_cut_masks(clip, evidence, motion)):
            scene.write_mask(scene.train_frames[k], mask)
    objects, share = number_objects(scene)
    # That parts are one object is known when points on them were followed (``identify_objects``).
    things = "1 moving object" if objects == 1 else f"{objects} moving parts"
    verdict = f"{things} on {share:.1%} of the image" if objects else "nothing moves"
    scene.finish_prior("masks", method="motion", verdict=verdict, objects=objects, share=round(share, 5))


def compute_evidence(clip: MatchedClip, shown: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return evidence [H, W] float16 of every training frame, a logarithm to base 2, positive where something moves.

    Overwrites the masks of the training frames.

    Args:
        shown: bool [H, W] of every training frame, what is known to be an object.
    """
    motion = motion_evidence(clip, static_depth(clip, False))
    _rough_masks(clip, motion, shown)
    sums = _propagate(clip, _compute_own_evidence(clip, motion))
    return [total.astype(np.float16) for total in track(sums, "What moves", len(clip))][::-1]


def _rough_masks(clip: MatchedClip, motion: list[np.ndarray], shown: Sequence[np.ndarray] | None = None) -> bool:
    """Write what moves by its motion, and what is known to, as masks of 0 and 1; whether anything does."""
    scene, certain, found = clip.scene, choose_weighing(clip).certain, False
    for k, i in enumerate(scene.train_frames):
        mask = rough_cut(motion[k], scene.frame(i), certain)
        if shown is not None:
            mask = mask | shown[k].astype(np.uint8)
        scene.write_mask(i, mask)
        found = found or bool(mask.any())
    return found


def _compute_own_evidence(clip: MatchedClip, motion: list[np.ndarray]) -> list[np.ndarray]:
    """Return [H, W] float16 of every training frame by itself: its plate, matches and colors."""
    evidence = _plate_evidence(clip, motion)
    _add_colors(clip, evidence, motion)
    return evidence


def _plate_evidence(clip: MatchedClip, motion: list[np.ndarray]) -> list[np.ndarray]:
    """Return [H, W] float16 of every training frame, positive for motion: how it differs from its plate, and the matches."""
    scene = clip.scene
    side = 2 * max(1, round(BLOCKED_MARGIN * max(scene.width, scene.height) / 2)) + 1
    masks = [cv2.dilate(scene.mask(i), np.ones((side, side), np.uint8)) > 0 for i in scene.train_frames]
    plate = CleanPlate(clip, static_depth(clip, True), np.stack(masks))
    evidence = []
    for k in track(range(len(clip)), "Clean plates"):
        residual = plate.residual(k)
        differs = np.clip(
            np.log2(np.maximum(residual, 1e-3) / np.float32(NEUTRAL_RESIDUAL)), -MAX_PLATE_EVIDENCE, MAX_PLATE_EVIDENCE
        )
        moves = MOTION_WEIGHT * np.clip(enlarge(motion[k], residual) / FULL_MOTION_EVIDENCE, -1, 1.5)
        evidence.append((np.where(residual >= 0, differs, 0) + moves).astype(np.float16))
    return evidence


def _add_colors(clip: MatchedClip, evidence: list[np.ndarray], motion: list[np.ndarray]) -> None:
    """Add to the evidence how much the colors are those of objects."""
    scene, colors = clip.scene, ColorModel()
    for k in range(0, len(clip), -(-len(clip) // MODEL_FRAMES)):
        frame = scene.frame(scene.train_frames[k])
        colors.add(frame, _outline(evidence[k], frame, motion[k]) > 0)
    table = colors.table()
    if table is None:
        return
    table = np.float32(COLOR_WEIGHT) * np.clip(table, -MAX_COLOR_EVIDENCE, MAX_COLOR_EVIDENCE)
    for k, i in enumerate(scene.train_frames):
        evidence[k] = (evidence[k] + look_up(table, scene.frame(i))).astype(np.float16)


def _cut_masks(clip: MatchedClip, evidence: list[np.ndarray], motion: list[np.ndarray]) -> list[np.ndarray]:
    """Return the masks [H, W] uint8 of 0 and 1, from evidence that is propagated between frames."""
    scene, numbers = clip.scene, clip.scene.train_frames
    sums = zip(numbers[::-1], motion[::-1], _propagate(clip, evidence), strict=True)
    return [_outline(total, scene.frame(i), moving) for i, moving, total in track(sums, "Masks", len(clip))][::-1]


def _propagate(clip: MatchedClip, evidence: list[np.ndarray]) -> Iterator[np.ndarray]:
    """Yield the evidence [H, W] of each training frame and its neighbors, from the last to the first."""
    scene, numbers = clip.scene, clip.scene.train_frames

    def flow(k: int, j: int) -> tuple[np.ndarray, np.ndarray]:
        found = scene.flow(numbers[k], numbers[j])
        return found.flow, found.confidence

    return propagate(clip, evidence.__getitem__, flow, EVIDENCE_MEMORY)


def _outline(evidence: np.ndarray, frame: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """Return the mask [H, W] uint8 along the edges of the frame, of parts that were found by their motion."""
    smooth = EdgeSmoother(frame, _EDGE_AWARE_SMOOTHNESS, _COLOR_SIGMA).filter(evidence.astype(np.float32))
    return parts((smooth > 0).astype(np.uint8), enlarge(motion, frame) > 0, MIN_MOVING_SHARE)
