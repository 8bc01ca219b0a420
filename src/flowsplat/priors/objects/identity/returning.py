"""Whether an object that begins is one that ended before: who left the image, or was hidden for long, and came back.

No track lasts through an absence, so an object gets another number after it. Whether two of them are one is a logistic function of
how alike they look next to the absence, how large they are, where the one went and the other came from; its weights are fitted to
random worlds (``returning.json``). Below a probability with which joins are rarely wrong, nothing is joined.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.files import read_json
from flowsplat.geometry import Camera
from flowsplat.priors.objects.areas import SMALL_PART_SHARE
from flowsplat.priors.objects.identity.appearance import Appearance, MaskedFrames, look
from flowsplat.priors.objects.identity.cost import Cost

WEIGHTS = Path(__file__).with_name("returning.json")
"""Written by ``python -m flowsplat_benchmarks.scripts.returning``, which says what it was fitted on."""
MIN_FRAMES, MIN_AREA = 3, 0.0008
"""Frames in which an object must be seen, and the share of the image that it must fill in one of them, to be compared. Chosen by
eye."""
MIN_ABSENCE = 2
"""Frames between two numbers from which it is an absence; what goes on at once was told apart by its motion. Chosen by eye."""
SHARED_NUMBER = 255
"""Number that all further objects share where there are more (``paint``)."""
MAX_DISTANCE = 2.0
"""Long sides of the image: what is farther from where it was is as good as anywhere. Chosen by eye."""
EXTRAPOLATED_SECONDS = 0.5
"""Seconds for which what is not seen is taken to go on as before. Chosen by eye."""
NO_OTHERS_MARGIN = 0.25
"""Of ``margin``, where nothing else is there that could be mistaken for it. Chosen by eye."""
FEATURES = (
    "colors", "colors by thirds", "median colors by thirds", "height", "area", "aspect", "seconds", "distance",
    "distance by size", "distance if it went on", "borders that it passes", "same border", "margin",
)  # fmt: skip


@dataclass(frozen=True)
class Pair:
    """Two numbers, of which one ends before the other begins.

    Attributes:
        before, after: the numbers.
        last, first: frames, the last one of ``before`` and the first one of ``after``.
        probability: that they are one object.
    """

    before: int
    after: int
    last: int
    first: int
    probability: float


@dataclass(frozen=True)
class ReturnClassifier:
    """The fitted function, and what is done with it.

    Attributes:
        cost: log odds of ``FEATURES``.
        gate: probability from which two numbers are joined.
        maybe: probability from which it is said that they may be one.
    """

    cost: Cost
    gate: float
    maybe: float


def make_classifier(values: Mapping[str, Any]) -> ReturnClassifier:
    """Return what ``WEIGHTS`` holds.

    Raises:
        InputError: it was fitted to other features.
    """
    if values["features"] != list(FEATURES):
        raise InputError(f"{WEIGHTS.name} has other features; run python -m flowsplat_benchmarks.scripts.returning.")
    cost = Cost(*(np.array(values[key], float) for key in ("mean", "deviation", "weights")))
    return ReturnClassifier(cost, float(values["gate"]), float(values["maybe"]))


@cache
def read_classifier() -> ReturnClassifier:
    """Return the package's own."""
    return make_classifier(read_json(WEIGHTS))


def list_pairs(clip: MaskedFrames) -> tuple[list[tuple[int, int]], np.ndarray]:
    """Return the pairs of numbers, one of which ends before the other begins, in the same piece of the clip.

    Small parts are not among them: what they are of is not known, and not whether they are one thing (``areas``).

    Returns:
        The pairs, the earlier number first, and the areas [T, 256] of all numbers in pixels.
    """
    masks = (clip.mask(k) for k in range(len(clip.times)))
    areas = np.stack([np.bincount(mask.ravel(), minlength=256) for mask in masks])
    areas[:, [0, SHARED_NUMBER]] = 0
    large = areas.sum(0) >= SMALL_PART_SHARE * areas.sum(0).max()
    fit = large & (areas.max(0) >= MIN_AREA * clip.mask(0).size) & ((areas > 0).sum(0) >= MIN_FRAMES)
    spans = {int(n): np.flatnonzero(areas[:, n])[[0, -1]] for n in np.flatnonzero(fit)}
    pairs = []
    for a, b in combinations(spans, 2):
        if spans[a][0] > spans[b][0]:
            a, b = b, a
        absent, pieces = spans[b][0] - spans[a][1] - 1, clip.pieces[[*spans[a], *spans[b]]]
        if absent >= MIN_ABSENCE and (pieces == pieces[0]).all():
            pairs.append((a, b))
    return pairs, areas


def compute_features(clip: MaskedFrames, pairs: Sequence[tuple[int, int]], areas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ``FEATURES`` [E, F] of pairs, and the last frame of the earlier and the first one of the later number [E, 2].

    Args:
        pairs, areas: of ``list_pairs``.
    """
    size = clip.mask(0).size
    large = np.flatnonzero(areas.max(0) >= MIN_AREA * size).tolist()
    seen = {number: np.flatnonzero(areas[:, number]) for number in large}
    ends: dict[tuple[int, bool], Appearance] = {}

    def look_at(number: int, is_end: bool) -> Appearance:
        if (number, is_end) not in ends:
            ends[number, is_end] = look(clip, number, seen[number], areas[seen[number], number], is_end)
        return ends[number, is_end]

    features = np.zeros((len(pairs), len(FEATURES)))
    frames = np.zeros((len(pairs), 2), int)
    for row, (a, b) in enumerate(pairs):
        end, start = look_at(a, True), look_at(b, False)
        own = _compare_colors(end, start)
        distances_to_others: list[float] = []
        for other in large:
            if other in (a, b):
                continue
            if areas[areas[:, a] > 0, other].any():  # it is not the one that ended
                distances_to_others.append(_compare_colors(look_at(other, True), start)[1])
            if areas[areas[:, b] > 0, other].any():  # nor the one that begins
                distances_to_others.append(_compare_colors(end, look_at(other, False))[1])
        margin = min(distances_to_others) - own[1] if distances_to_others else NO_OTHERS_MARGIN
        features[row] = [*own, *_compare_outlines(clip, end, start), margin]
        frames[row] = end.frame, start.frame
    return features, frames


def _compare_colors(end: Appearance, start: Appearance) -> tuple[float, float, float]:
    """Return Bhattacharyya distances of the histograms, of all and the mean of those of thirds; and of medians, ln."""
    apart = np.sqrt(np.maximum(1 - np.sqrt(end.colors * start.colors).sum(1), 0))
    apart = np.where(end.colors.any(1) & start.colors.any(1), apart, apart[0])
    return float(apart[0]), float(apart[1:].mean()), float(np.log(np.linalg.norm(end.lab - start.lab, axis=1).mean() / 10 + 0.1))


def _compare_outlines(clip: MaskedFrames, end: Appearance, start: Appearance) -> list[float]:
    seconds = float(clip.times[start.frame] - clip.times[end.frame])
    cameras, long_side = (clip.cameras[end.frame], clip.cameras[start.frame]), max(clip.mask(0).shape)
    stays = _turn_with_camera(end.middle, *cameras)
    goes = _turn_with_camera(end.middle + end.velocity * min(seconds, EXTRAPOLATED_SECONDS), *cameras)
    came = start.middle - start.velocity * min(seconds, EXTRAPOLATED_SECONDS)
    away, on, back = (
        min(float(np.linalg.norm(p - q)) / long_side, MAX_DISTANCE)
        for p, q in ((stays, start.middle), (goes, start.middle), (stays, came))
    )
    size = np.sqrt(end.area * start.area) ** 0.5
    passed, same = int(end.borders.any()) + int(start.borders.any()), bool((end.borders & start.borders).any())
    return [
        abs(np.log(end.height / start.height)), 0.5 * abs(np.log(end.area / start.area)), abs(np.log(end.aspect / start.aspect)),
        np.log(seconds + 0.1), np.log(away + 0.02), np.log(away / size + 0.1), np.log(min(on, back) + 0.02), passed, float(same),
    ]  # fmt: skip


def _turn_with_camera(place: np.ndarray, before: Camera, after: Camera) -> np.ndarray:
    """Return where a far point that one camera sees at ``place`` [2] is in another one's image; far outside if behind it."""
    ray = np.linalg.solve(before.K, np.array([*place, 1.0]))
    x, y, z = after.K @ after.viewmat[:3, :3] @ before.viewmat[:3, :3].T @ ray
    return np.array([x, y]) / z if z > 1e-3 else np.full(2, np.inf)


def score_pairs(clip: MaskedFrames, classifier: ReturnClassifier | None = None) -> list[Pair]:
    """Return all pairs of numbers of which one ends before the other begins, and the probability that each is one object.

    Args:
        classifier: None = the package's own.
    """
    pairs, areas = list_pairs(clip)
    if not pairs:
        return []
    features, frames = compute_features(clip, pairs, areas)
    log_odds = (classifier or read_classifier()).cost(features)
    probabilities = 1 / (1 + np.exp(-log_odds))
    return [Pair(a, b, int(f[0]), int(f[1]), float(p)) for (a, b), f, p in zip(pairs, frames, probabilities, strict=True)]


def join_pairs(pairs: Sequence[Pair], gate: float) -> list[Pair]:
    """Return the pairs that are joined, by time: the surest first, each number with one that it goes on from and one that goes on.

    A chain of them never holds two numbers that are seen at one time.
    """
    follows, goes_on = set[int](), set[int]()
    joined = []
    for pair in sorted(pairs, key=lambda each: -each.probability):
        if pair.probability >= gate and pair.before not in goes_on and pair.after not in follows:
            goes_on.add(pair.before)
            follows.add(pair.after)
            joined.append(pair)
    return sorted(joined, key=lambda each: (each.last, each.first))
