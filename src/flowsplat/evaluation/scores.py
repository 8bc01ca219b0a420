"""Score an image against its target, in whole and by region, and average over images."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from flowsplat.evaluation.detail import DetailPair, Sharpness
from flowsplat.evaluation.metrics import mean_inside, psnr, ssim_map
from flowsplat.evaluation.perceptual import PerceptualMetric

Figures = dict[str, Any]
METRICS = ("psnr", "ssim", "lpips")
SHARPNESS_METRICS = Sharpness._fields
"""Of images that a model renders; what other methods predict is not asked for it."""


def score_image(
    image: np.ndarray,
    target: np.ndarray,
    regions: Mapping[str, np.ndarray | None],
    lpips: PerceptualMetric | None,
    overlay: np.ndarray | None = None,
    with_sharpness: bool = False,
) -> Figures:
    """``psnr``, ``ssim``, ``lpips`` of a float image [H, W, 3], and the same for every region.

    Args:
        with_sharpness: also ``detail`` and ``contrast`` (``evaluation.detail``), None where the target has too little to tell.
        regions: masks [H, W] bool by name; a region without a mask, or too small to measure, becomes None.
        lpips: the metric, or None where it cannot be measured. It looks at patches, so it has no value for a region.
        overlay: [H, W] bool, what is burnt into the target: it is in no region, and both images have the same there.
    """
    seen = None
    if overlay is not None:
        seen, image = ~overlay, np.where(overlay[..., None], target, image)
        regions = {name: None if mask is None else mask & seen for name, mask in regions.items()}
    similarity = ssim_map(image, target)
    figures: Figures = {
        "psnr": psnr(image, target, seen),
        "ssim": mean_inside(similarity, seen),
        "lpips": None if lpips is None else lpips(image, target),
    }
    pair = DetailPair(image, target) if with_sharpness else None
    figures |= _measure_sharpness(pair, seen)
    for name, mask in regions.items():
        value = None if mask is None else psnr(image, target, mask)
        if value is None:
            figures[name] = None
            continue
        figures[name] = {"psnr": value, "ssim": mean_inside(similarity, mask), "lpips": None, **_measure_sharpness(pair, mask)}
    return figures


def _measure_sharpness(pair: DetailPair | None, mask: np.ndarray | None) -> Figures:
    if pair is None:
        return {}
    found = pair.measure(mask)
    return dict.fromkeys(SHARPNESS_METRICS) if found is None else found._asdict()


def summarize(scores: Sequence[Figures | None], regions: Sequence[str] = ()) -> Figures | None:
    """Means over the images that have a score, with their ``count``, and the same for ``regions``; None for none."""
    measured = [score for score in scores if score is not None]
    if not measured:
        return None
    figures: Figures = {name: mean_of(score[name] for score in measured) for name in METRICS}
    if any(name in score for score in measured for name in SHARPNESS_METRICS):
        figures |= {name: mean_of(score.get(name) for score in measured) for name in SHARPNESS_METRICS}
    figures["count"] = len(measured)
    for region in regions:
        figures[region] = summarize([score[region] for score in measured])
    return figures


def mean_of(values: Iterable[float | None]) -> float | None:
    """Return the mean of the values that are there, None if none is.

    >>> mean_of([1.0, None, 3.0]), mean_of([None])
    (2.0, None)
    """
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def pick(metrics: Mapping[str, Any], *path: str) -> Any:
    """Return the value under a path of keys; None where anything on the way is missing or null."""
    value: Any = metrics
    for key in path:
        value = value.get(key) if isinstance(value, Mapping) else None
    return value
