"""An object from the frame on which it was shown to all others: along the flow, corrected by what moves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from flowsplat.geometry.cameras import pixel_grid
from flowsplat.geometry.interpolation import sample_map
from flowsplat.images.edge_smoothing import EdgeSmoother
from flowsplat.priors.masks.colors import ColorModel, look_up
from flowsplat.priors.prompts.cutting import (
    COLOR_SIGMA,
    COLOR_WEIGHT,
    EDGE_AWARE_SMOOTHNESS,
    EVIDENCE_WEIGHT,
    MAX_COLOR_EVIDENCE,
    MAX_EVIDENCE,
    correct,
    cut_out,
    list_excluded,
)
from flowsplat.priors.prompts.grabcut import EDGE_BAND, snap_to_edges
from flowsplat.priors.prompts.parsing import Prompt
from flowsplat.scenes import Scene

MIN_FLOW_CONFIDENCE = 0.3
"""Mean confidence of the flow below which a carried part of a mask is dropped. Chosen by eye."""

MAX_GRAY_DIFFERENCE = 30.0
"""Gray levels beyond which a pixel is not the one that the flow says it was. Chosen by eye."""

CARRIED_EVIDENCE = 2.0
"""Evidence, a logarithm to base 2, that what was carried is the object; it falls to its negative within ``EDGE_BAND`` of the
edge. Chosen on tuned scenes and random worlds (docs/method/masks.md; docs/notebook/2026-11.md, Clicks and boxes)."""

MAX_BANDS = 3.0
"""Bands round what was carried within which the object may be. Chosen by eye."""

OTHER_OBJECT_EVIDENCE, OTHER_OBJECT_BANDS = 1.0, 1.0
"""Evidence of motion that belongs to something else where it is not found to be the object, and bands from it beyond which
(docs/method/masks.md)."""


@dataclass
class MaskPart:
    """An object on one frame.

    Attributes:
        mask: bool [H, W].
        sure: how sure the flow was along which it came, 0 to 1.
        doubted: bool [H, W], where the evidence of what moves is not that of the object; None = it is not known.
    """

    mask: np.ndarray
    sure: float
    doubted: np.ndarray | None = None


@dataclass
class Walk:
    """Follows one object.

    Attributes:
        scene: with flow.
        prompts: the first shows the object, the others correct it.
        evidence: of each training frame [H, W], a logarithm to base 2, positive where something moves; None = it is not known.
    """

    scene: Scene
    prompts: Sequence[Prompt]
    evidence: Sequence[np.ndarray] | None = None
    _table: np.ndarray | None = field(init=False, default=None)
    _rests: bool = field(init=False, default=False)

    def parts(self) -> list[MaskPart]:
        """Return the object in every training frame."""
        frames = self.scene.train_frames
        parts = [MaskPart(np.zeros((self.scene.height, self.scene.width), bool), 0.0)] * len(frames)
        shown: list[int] = []
        for prompt in self.prompts:
            start = frames.index(prompt.frame)
            if not (prompt.clicks or prompt.box or list_excluded(prompt, parts[start].mask)):
                continue  # It was meant of another object: this one stays as it is, to the bit.
            parts[start] = self._cut_shown(prompt, start, parts[start].mask if shown else None)
            for steps in (range(start + 1, len(frames)), range(start - 1, -1, -1)):
                before = start
                for k in steps:
                    # Between two frames that were looked at each speaks for those nearer to it.
                    if any(abs(k - other) < abs(k - start) or k == other for other in shown):
                        break
                    parts[k] = self._next(parts[before], before, k)
                    before = k
            shown.append(start)
        return parts

    def _cut_shown(self, prompt: Prompt, k: int, carried: np.ndarray | None) -> MaskPart:
        """Return the object on a frame with a prompt."""
        frames = self.scene.train_frames
        image, other = self.scene.frame(prompt.frame), frames[k + 1] if k + 1 < len(frames) else frames[k - 1]
        flow = self.scene.flow(prompt.frame, other)
        evidence = None if self.evidence is None else self.evidence[k].astype(np.float32)
        if carried is None or prompt.box is not None:
            mask = cut_out(image, flow, prompt, evidence)
        else:
            mask = correct(image, flow, prompt, carried, evidence)
        if not mask.any():
            return MaskPart(mask, 1.0)
        if carried is None:
            # What a user shows and nothing says moves may move later, but that it rests is no reason to drop it.
            self._rests = evidence is not None and float(np.median(evidence[mask])) <= 0
        colors = ColorModel()
        colors.add(image, mask)
        table = colors.table()
        if table is not None:
            self._table = np.float32(COLOR_WEIGHT) * np.clip(table, -MAX_COLOR_EVIDENCE, MAX_COLOR_EVIDENCE)
        doubted = None if evidence is None else (evidence > 0) != mask
        return MaskPart(mask, 1.0, doubted)

    def _next(self, part: MaskPart, before: int, k: int) -> MaskPart:
        """Return one training frame further: where the flow back ends inside it, with the edge where the image has one."""
        if not part.mask.any():
            return MaskPart(part.mask, 0.0)
        scene, frames = self.scene, self.scene.train_frames
        back = scene.flow(frames[k], frames[before])
        source = (pixel_grid(scene.width, scene.height) + back.flow).reshape(-1, 2)
        inside = ((source > 0).all(1) & (source < [scene.width, scene.height]).all(1)).reshape(part.mask.shape)

        def carried(values: np.ndarray) -> np.ndarray:
            there = sample_map(values.astype(np.float32), source).reshape(part.mask.shape)
            return (there > 0.5) & inside

        moved, image = carried(part.mask), scene.frame(frames[k])
        was = sample_map(scene.frame(frames[before]), source).reshape(image.shape)
        apart = cv2.blur(np.abs(image.astype(np.float32) - was).mean(-1), (5, 5))
        trusted = np.where(apart < MAX_GRAY_DIFFERENCE, back.confidence, 0)
        if self.evidence is None:
            moved = _reliable(moved, trusted)
            return MaskPart(snap_to_edges(image, moved) if moved.any() else moved, _mean(back.confidence, moved))
        evidence = self.evidence[k].astype(np.float32)
        moved = _reliable(moved, np.maximum(trusted, np.clip(evidence, 0, 1)))
        if not moved.any():
            return MaskPart(moved, 0.0)
        doubted = None if part.doubted is None else carried(part.doubted)
        found = self._outline(image, moved, evidence, doubted)
        if doubted is not None:
            # What moves beside the object now is not a part of it later.
            away = cv2.distanceTransform((~found).astype(np.uint8), cv2.DIST_L2, 5)
            doubted |= (evidence > OTHER_OBJECT_EVIDENCE) & (away > OTHER_OBJECT_BANDS * _band(found))
        return MaskPart(found, _mean(back.confidence, moved), doubted)

    def _outline(self, image: np.ndarray, moved: np.ndarray, evidence: np.ndarray, doubted: np.ndarray | None) -> np.ndarray:
        band = _band(moved)
        inner = cv2.distanceTransform(moved.astype(np.uint8), cv2.DIST_L2, 5)
        outer = cv2.distanceTransform((~moved).astype(np.uint8), cv2.DIST_L2, 5)
        held = np.float32(CARRIED_EVIDENCE) * np.clip((inner - outer) / band, -1, 1)
        moves = np.clip(EVIDENCE_WEIGHT * evidence, 0 if self._rests else -MAX_EVIDENCE, MAX_EVIDENCE)
        if doubted is not None:
            moves = np.where(doubted, 0, moves)
        total = held + moves
        if self._table is not None:
            total = total + look_up(self._table, image)
        total = np.where(outer > MAX_BANDS * band, -MAX_EVIDENCE, total).astype(np.float32)
        found = EdgeSmoother(image, EDGE_AWARE_SMOOTHNESS, COLOR_SIGMA).filter(total) > 0
        _, labels = cv2.connectedComponents(found.astype(np.uint8))
        kept = np.isin(labels, np.unique(labels[found & moved])) & found
        return kept if kept.any() else moved


def _band(mask: np.ndarray) -> float:
    """``EDGE_BAND`` in pixels."""
    return max(2.0, EDGE_BAND * max(mask.shape))


def _mean(confidence: np.ndarray, mask: np.ndarray) -> float:
    return float(confidence[mask].mean()) if mask.any() else 0.0


def _reliable(mask: np.ndarray, confidence: np.ndarray) -> np.ndarray:
    """Return the parts of a mask, bool [H, W], to which the flow leads with some confidence: not what it makes of an object that
    left."""
    count, labels = cv2.connectedComponents(mask.astype(np.uint8))
    means = np.bincount(labels.ravel(), confidence.ravel(), count) / np.maximum(np.bincount(labels.ravel(), minlength=count), 1)
    kept = means >= MIN_FLOW_CONFIDENCE
    kept[0] = False
    return kept[labels]
