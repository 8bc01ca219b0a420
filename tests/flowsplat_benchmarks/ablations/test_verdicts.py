"""Verdicts on differences."""

from __future__ import annotations

import pytest

from flowsplat_benchmarks.ablations.verdicts import Effect, counts, effect, verdict


def runs(*values: float) -> dict[tuple[str, int], float]:
    """Of two seeds on every scene."""
    return {("abc"[k // 2], k % 2): value for k, value in enumerate(values)}


ZERO = runs(*[0.0] * 6)


def judged(values: dict, expected: int) -> str:
    found = effect(values, dict.fromkeys(values, 30.0) | dict.fromkeys(ZERO, 30.0))
    assert found is not None
    return verdict(found, expected)


def test_an_effect_is_paired_by_scene_and_seed():
    base = {("a", 0): 30.0, ("a", 1): 31.0, ("b", 0): 20.0}
    found = effect({("a", 0): 29.0, ("a", 1): 29.0, ("b", 0): 19.5, ("c", 0): 5.0}, base)
    assert found is not None
    assert found.differences == {("a", 0): -1.0, ("a", 1): -2.0, ("b", 0): -0.5}
    assert found.mean == pytest.approx((-1.5 - 0.5) / 2), "scenes count alike, however many seeds they have"
    assert found.of_scene("a") == -1.5
    assert found.of_scene("c") is None
    assert found.spread == pytest.approx(0.7638, abs=1e-4)


def test_without_common_runs_there_is_no_effect():
    assert effect({("a", 0): 1.0}, {("a", 1): 1.0}) is None


@pytest.mark.parametrize(
    ("differences", "expected", "said"),
    [
        ((-1.0, -1.2, -0.8, -0.9, -1.1, -1.0), -1, "confirmed"),
        ((-1.0, -1.2, -0.8, -0.9, -1.1, -1.0), 1, "contradicted"),
        ((0.5, 0.6, 0.4, 0.5, 0.5, 0.6), -1, "contradicted"),
        ((0.5, 0.6, 0.4, 0.5, 0.5, 0.6), 1, "confirmed"),
        ((-1.0, 1.2, -0.8, 0.9, -1.1, 0.4), -1, "not separable"),
        ((-0.1, -0.1, -0.1, -0.1, -2.0, -2.0), -1, "not separable"),  # one scene alone
        ((0.01, -0.02, 0.0, 0.03, -0.01, 0.0), 0, "no difference"),
        ((0.02, 0.02, 0.02, 0.02, 0.02, 0.02), -1, "no difference"),  # however alike the runs are
        ((0.3, -0.3, 0.3, -0.3, 0.1, 0.0), -1, "not separable"),
        ((0.04, 0.06, 0.04, 0.06, 0.04, 0.04), -1, "no difference"),
        ((0.06, 0.07, 0.06, 0.07, 0.06, 0.07), 1, "confirmed"),
        ((0.5, 0.6, 0.4, 0.5, 0.5, 0.6), 0, "contradicted"),
        ((2.0, -1.0, 2.0, -1.0, 0.1, 0.1), 0, "not separable"),
        ((0.0,) * 6, -1, "no difference"),
        ((0.0,) * 6, 0, "no difference"),
    ],
)
def test_verdicts(differences, expected, said):
    assert judged({key: 30.0 + value for key, value in runs(*differences).items()}, expected) == said


@pytest.mark.parametrize("expected", [-1, 0, 1])
def test_one_run_has_no_spread_and_tells_nothing(expected):
    assert verdict(Effect({("a", 0): -9.0}, -9.0, None), expected) == "one run"


def test_counting():
    told = counts(["confirmed", "not separable", "confirmed"])
    assert told == "2 confirmed, 0 contradicted, 1 not separable, 0 no difference, 0 one run"
