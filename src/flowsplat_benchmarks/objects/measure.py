"""Measure how far every object of a scene is from the truth: its distance, depth trajectory and shape offset, its masks and its
number; and what rests.

Errors of depth are natural logarithms of estimated over true planar depth: .02 is 2 %, too far.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from scipy.optimize import linear_sum_assignment

from flowsplat.priors.objects import load_objects
from flowsplat.scenes import Scene
from flowsplat_benchmarks.worlds import read_objects

MIN_OVERLAP = 0.3
"""Intersection over union of a true and an estimated mask of one object from which they count as the same in a frame; an object
without any such frame was never found. Chosen by eye."""

MIN_PIXELS = 20
"""Pixels of an object in a frame below which it does not count there. Chosen by eye."""

FEET_REACH = 6
"""Pixels from the lowest pixels of an object that touches the ground, within which what rests is called the ground at its feet.
Chosen by eye."""

CENTRAL_PERCENTILES = (15.87, 84.13)
"""Percentiles whose half distance is the standard deviation of a normal distribution."""

Record = dict[str, Any]


def measure_scene(scene: Scene) -> Record:
    """Return the figures of a scene, to be written as JSON.

    Returns:
        ``scale`` (see ``depth_scale``), ``parallax`` (whether the static depth is no guess), ``idf1`` of all objects, and
        ``objects``: for each what is true of it (see ``World.describe``) and

        - ``frames``: in which it is seen; ``height``: mean share of the image's height that its mask spans;
        - ``found``: whether its mask and that of one object ever overlap by ``MIN_OVERLAP``;
        - ``ln_distance``: median of ln(estimated / true depth) over its pixels in both masks and over all frames;
          ``depth_trajectory``: robust standard deviation over frames of each frame's median; ``shape_offset``: median over frames
          of the robust standard deviation within a frame; None where it was not found;
        - ``iou``: with the object that overlaps it most in a frame, intersections and unions summed over frames;
        - ``idf1``: of the object that stands for it over the clip, one object for one true object;
        - ``estimated``: the number of that object, or None; and its ``sigma`` and ``cues``, where the object stage tells them;

        and of what rests, by the true and by our masks, in all frames, pixels that were filled in included: ``static`` and
        ``feet`` (those at the feet of objects that touch the ground), each with the ``median`` and ``p90``, the 90th percentile,
        of |ln(estimated / true)|, None where there are none.

    Raises:
        InputError: something of the scene is missing or damaged.
    """
    truth = scene.truth
    assert truth is not None
    known = read_objects(truth)["objects"]
    frames = scene.train_frames
    true, ours = (np.stack([layers.mask(i) for i in frames]) for layers in (truth, scene))
    scale = depth_scale(scene)
    log = np.stack([np.log(scale * scene.depth(i).depth / truth.depth(i).depth) for i in frames])
    measured, total = measure_objects(true, ours, log, len(known))
    told = _read_records(scene)
    records = [{**obj, **record, **told.get(str(record["estimated"]), {})} for obj, record in zip(known, measured, strict=True)]
    rests = (true == 0) & (ours == 0)
    feet = rests & _at_feet(true, known, [scene.timestamps[i] for i in frames])
    return {
        "scale": scale, "parallax": has_parallax(scene), "idf1": total, "objects": records,
        "static": _percentiles(log[rests]), "feet": _percentiles(log[feet]),
    }  # fmt: skip


def measure_objects(true: np.ndarray, ours: np.ndarray, log: np.ndarray, objects: int) -> tuple[list[Record], float]:
    """Return what ``measure_scene`` tells of every object, without what is true of it and what the object stage tells; and the
    IDF1 of all.

    Args:
        true: [T, H, W] numbers of objects, from 1; ours: [T, H, W] those of our masks.
        log: [T, H, W] ln(estimated / true depth).
        objects: how many.
    """
    overlap = overlaps(true, ours, objects)
    assigned, idf1, total = identities(overlap, true, ours)
    records = []
    for index in range(objects):
        inside = true == index + 1
        seen = inside.sum((1, 2)) >= MIN_PIXELS
        found = bool((overlap[index] >= MIN_OVERLAP).any())
        record: Record = {"frames": int(seen.sum()), "height": _mean_height(inside[seen]), "found": found}
        record |= (
            _depth_errors(log, inside & (ours > 0)) if found else dict.fromkeys(("ln_distance", "depth_trajectory", "shape_offset"))
        )
        record |= {"iou": _compute_pooled_iou(inside, ours), "idf1": idf1[index], "estimated": assigned[index]}
        records.append(record)
    return records, total


def has_parallax(scene: Scene) -> bool:
    """Return whether the static depth comes from matches and is no guess."""
    return bool((scene.prior("depth") or {}).get("method") != "guess")


def depth_scale(scene: Scene) -> float:
    """Meters per unit of the scene's depth: 1 where the cameras are true and tell depth.

    Else the median of true over estimated depth over the pixels of all training frames that are static, by the true and by our
    masks, and whose depth is trusted; over all static ones where none is.
    """
    if (scene.prior("cameras") or {}).get("method") == "truth" and has_parallax(scene):
        return 1.0
    truth = scene.truth
    assert truth is not None
    ratios, trusted = [], []
    for i in scene.train_frames:
        static = (truth.mask(i) == 0) & (scene.mask(i) == 0)
        depth = scene.depth(i)
        ratios.append((truth.depth(i).depth / depth.depth)[static])
        trusted.append(depth.trusted[static])
    ratio, sure = np.concatenate(ratios), np.concatenate(trusted)
    return float(np.median(ratio[sure] if sure.any() else ratio))


def overlaps(true: np.ndarray, ours: np.ndarray, objects: int) -> np.ndarray:
    """Return [objects, T, 256] intersection over union of every object with every object number in every frame; 0 where either is
    small.

    Args:
        true: [T, H, W] numbers of objects, ours: of objects.
        objects: how many.
    """
    result = np.zeros((objects, len(true), 256))
    for t, (a, b) in enumerate(zip(true, ours, strict=True)):
        both = np.bincount(a.ravel().astype(int) * 256 + b.ravel(), minlength=(objects + 1) * 256).reshape(objects + 1, 256)
        theirs, found = both.sum(1)[1:, None], both.sum(0)[None]
        shares = both[1:] / np.maximum(theirs + found - both[1:], 1)
        result[:, t] = np.where((theirs >= MIN_PIXELS) & (found >= MIN_PIXELS), shares, 0)
    result[..., 0] = 0
    return result


def identities(overlap: np.ndarray, true: np.ndarray, ours: np.ndarray) -> tuple[list[int | None], list[float], float]:
    """Return one object for one object over the clip, such that the most frames agree (IDF1, Ristani et al., 2016).

    Returns:
        the object of every object or None; the IDF1 of each, 0 without one; and that of all objects and objects together.
    """
    objects = len(overlap)
    hits = (overlap >= MIN_OVERLAP).sum(1)  # [objects, 256]
    seen = np.array([(np.sum(true == n + 1, (1, 2)) >= MIN_PIXELS).sum() for n in range(objects)])
    shown = np.array([0, *((np.sum(ours == n, (1, 2)) >= MIN_PIXELS).sum() for n in range(1, 256))])
    rows, columns = linear_sum_assignment(-hits)
    assigned: list[int | None] = [None] * objects
    idf1, right = [0.0] * objects, 0
    for row, column in zip(rows, columns, strict=True):
        if hits[row, column]:
            assigned[row] = int(column)
            idf1[row] = float(2 * hits[row, column] / (seen[row] + shown[column]))
            right += int(hits[row, column])
    return assigned, idf1, float(2 * right / max(seen.sum() + shown.sum(), 1))


def _depth_errors(log: np.ndarray, inside: np.ndarray) -> Record:
    """``ln_distance``, ``depth_trajectory`` and ``shape_offset`` from errors [T, H, W] at the pixels ``inside``."""
    frames = [values[chosen] for values, chosen in zip(log, inside, strict=True) if chosen.sum() >= MIN_PIXELS]
    if not frames:
        return dict.fromkeys(("ln_distance", "depth_trajectory", "shape_offset"))
    medians = [float(np.median(values)) for values in frames]
    return {
        "ln_distance": float(np.median(np.concatenate(frames))), "depth_trajectory": _spread(np.array(medians)),
        "shape_offset": float(np.median([_spread(values) for values in frames])),
    }  # fmt: skip


def _at_feet(true: np.ndarray, known: list[Record], seconds: list[float]) -> np.ndarray:
    """Return [T, H, W] bool: near the lowest pixels of objects, in frames at whose time these touch the ground."""
    near, around = np.zeros(true.shape, bool), np.ones((2 * FEET_REACH + 1, 2 * FEET_REACH + 1), np.uint8)
    half = np.diff(seconds).mean() / 2 if len(seconds) > 1 else np.inf
    for obj in known:
        for t, second in enumerate(seconds):
            if any(abs(second - contact) <= half for contact in obj["contact"]):
                inside = true[t] == obj["number"]
                rows = np.flatnonzero(inside.any(1))
                if inside.sum() >= MIN_PIXELS:
                    inside[: rows[-1]] = False
                    near[t] |= cv2.dilate(inside.astype(np.uint8), around) > 0
    return near


def _percentiles(log: np.ndarray) -> dict[str, float] | None:
    if not log.size:
        return None
    median, upper = np.percentile(np.abs(log), [50, 90])
    return {"median": float(median), "p90": float(upper)}


def _spread(values: np.ndarray) -> float:
    low, high = np.percentile(values, CENTRAL_PERCENTILES)
    return float(high - low) / 2


def _compute_pooled_iou(inside: np.ndarray, ours: np.ndarray) -> float:
    both = either = 0
    for mine, numbers in zip(inside, ours, strict=True):
        if mine.sum() < MIN_PIXELS:
            continue
        counts = np.bincount(numbers[mine], minlength=256)
        counts[0] = 0
        best = int(counts.argmax())
        both += int(counts[best])
        either += int(mine.sum() + ((numbers == best).sum() if counts[best] else 0) - counts[best])
    return both / either if either else 0.0


def _mean_height(inside: np.ndarray) -> float:
    """Return the mean share of the image's height that masks [T, H, W] span."""
    if not len(inside):
        return 0.0
    return float(np.mean([np.ptp(np.flatnonzero(mask.any(1))) + 1 for mask in inside]) / inside.shape[1])


def _read_records(scene: Scene) -> dict[str, Record]:
    """Return what is believed of the distance of objects by their numbers: ``sigma`` of its logarithm, and ``cues`` that told
    it."""
    return {str(m.number): {"sigma": m.sigma, "cues": sorted(m.cues)} for m in load_objects(scene).objects}
