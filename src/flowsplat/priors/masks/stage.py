"""The mask stage: objects are found by their motion, then cut out by what the images show (docs/method/masks.md).

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
from flowsplat.priors.masks.background_plate import CleanPlate, PlateComparison
from flowsplat.priors.masks.colors import ColorModel, look_up
from flowsplat.priors.masks.evidence import Tables, read_tables, weigh_color, weigh_plates
from flowsplat.priors.masks.motion import choose_weighing, enlarge, motion_evidence, parts, propagate, rough_cut
from flowsplat.priors.masks.numbers import number_objects
from flowsplat.scenes import Scene

MAX_EVIDENCE = 5.0
"""Most that a pixel's own evidence counts: a logarithm to base 2. Caps of 3 and 8 cut the same masks (docs/notebook/2026-11.md,
"Masks of what moves")."""

EVIDENCE_MEMORY = 0.5
"""Share of the evidence that a frame takes over from the next and the one before. Chosen by eye."""

MIN_CUT_EVIDENCE = 2.0
"""Summed evidence from which a pixel is in a mask. What rests in a mask costs more than what is missed of an object, above all
where it brings the contact with the ground nearer (docs/notebook/2026-11.md, "Masks of what moves")."""

MIN_MOVING_SHARE = 0.1
"""Share of a part that must have been found by its motion: .3 loses more of what moves than of what rests
(docs/notebook/2026-11.md, "Masks of what moves")."""

BLOCKED_MARGIN = 0.01
"""Share of the long side by which an object may be larger than its motion shows. Chosen by eye."""

MODEL_FRAMES = 16
"""Frames from which the colors are taken. Chosen by eye."""

_EDGE_AWARE_SMOOTHNESS, _COLOR_SIGMA = 5.0, 10.0
"""Smoothness along the edges of the image, and gray levels across which it no longer reaches: smoothness of 2 to 20 cuts nearly the
same masks (docs/notebook/2026-11.md, "Masks of what moves")."""


def mask_stage(scene: Scene, estimate: FlowEstimator = dis_estimator) -> None:
    """Masks with object numbers for the training frames, if there are none. Needs cameras and flow.

    Args:
        estimate: finds the flow between frames that are no neighbors.
    """
    if scene.prior("masks") is not None:
        return
    clip = MatchedClip(scene, estimate)
    motion = motion_evidence(clip, static_depth(clip, False))
    if write_rough_masks(clip, motion):
        evidence = _compute_own_evidence(clip, motion)
        for k, mask in enumerate(cut_masks(clip, evidence, motion)):
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
    write_rough_masks(clip, motion, shown)
    sums = _propagate(clip, _compute_own_evidence(clip, motion))
    return [total.astype(np.float16) for total in track(sums, "What moves", len(clip))][::-1]


def write_rough_masks(clip: MatchedClip, motion: list[np.ndarray], shown: Sequence[np.ndarray] | None = None) -> bool:
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
    """Return [H, W] float16 of every training frame by itself: its plates, matches and colors."""
    tables = read_tables()
    evidence, has_plate = [], []
    for found, moving in compare_plates(clip, motion):
        evidence.append(weigh_plates(tables, found, moving).astype(np.float16))
        has_plate.append(found.similar >= 0)
    return weigh_colors(clip, tables, evidence, has_plate, motion)


def weigh_colors(
    clip: MatchedClip, tables: Tables, evidence: list[np.ndarray], has_plate: list[np.ndarray], motion: list[np.ndarray]
) -> list[np.ndarray]:
    """Return evidence [H, W] float16 of every training frame together with what its colors say."""
    colors = learn_colors(clip, evidence, motion)
    if colors is None:
        return evidence
    frames = map(clip.scene.frame, clip.scene.train_frames)
    return [
        weigh_color(tables, own, look_up(colors, frame), seen).astype(np.float16)
        for own, frame, seen in zip(evidence, frames, has_plate, strict=True)
    ]


def compare_plates(clip: MatchedClip, motion: list[np.ndarray]) -> Iterator[tuple[PlateComparison, np.ndarray]]:
    """Yield how each training frame differs from its plates, and its summed motion [H, W]; the rough masks must be written."""
    scene = clip.scene
    side = 2 * max(1, round(BLOCKED_MARGIN * max(scene.width, scene.height) / 2)) + 1
    masks = [cv2.dilate(scene.mask(i), np.ones((side, side), np.uint8)) > 0 for i in scene.train_frames]
    overlay = scene.overlay
    blocked = np.stack(masks) if overlay is None else np.stack(masks) | overlay
    plate = CleanPlate(clip, static_depth(clip, True), blocked)
    for k in track(range(len(clip)), "Clean plates"):
        found = plate.compare(k)
        if overlay is not None:
            found.similar[overlay] = -1
        yield found, enlarge(motion[k], found.similar)


def learn_colors(clip: MatchedClip, evidence: list[np.ndarray], motion: list[np.ndarray]) -> np.ndarray | None:
    """Return the table for ``look_up``: how much more often objects have a color than what is round them; None without objects."""
    scene, colors = clip.scene, ColorModel()
    for k in range(0, len(clip), -(-len(clip) // MODEL_FRAMES)):
        frame = scene.frame(scene.train_frames[k])
        colors.add(frame, _outline(evidence[k], frame, motion[k], 0) > 0)
    return colors.table()


def cut_masks(clip: MatchedClip, evidence: list[np.ndarray], motion: list[np.ndarray]) -> list[np.ndarray]:
    """Return the masks [H, W] uint8 of 0 and 1, from evidence that is propagated between frames."""
    scene, numbers = clip.scene, clip.scene.train_frames
    sums = zip(numbers[::-1], motion[::-1], _propagate(clip, evidence), strict=True)
    masks = track(sums, "Masks", len(clip))
    return [_outline(total, scene.frame(i), moving, MIN_CUT_EVIDENCE) for i, moving, total in masks][::-1]


def _propagate(clip: MatchedClip, evidence: list[np.ndarray]) -> Iterator[np.ndarray]:
    """Yield the evidence [H, W] of each training frame and its neighbors, from the last to the first."""
    scene, numbers = clip.scene, clip.scene.train_frames

    def flow(k: int, j: int) -> tuple[np.ndarray, np.ndarray]:
        found = scene.flow(numbers[k], numbers[j])
        return found.flow, found.confidence

    return propagate(clip, lambda k: np.clip(evidence[k], -MAX_EVIDENCE, MAX_EVIDENCE), flow, EVIDENCE_MEMORY)


def _outline(evidence: np.ndarray, frame: np.ndarray, motion: np.ndarray, least: float) -> np.ndarray:
    """Return the mask [H, W] uint8 of more evidence than ``least`` along the edges of the frame, of parts that were found by their
    motion."""
    smooth = EdgeSmoother(frame, _EDGE_AWARE_SMOOTHNESS, _COLOR_SIGMA).filter(evidence.astype(np.float32))
    return parts((smooth > least).astype(np.uint8), enlarge(motion, frame) > 0, MIN_MOVING_SHARE)
