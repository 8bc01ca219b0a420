"""A law of motion speaks for a distance only where the path obeys it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flowsplat.priors.objects import depth_trajectory
from flowsplat.priors.objects.depth_trajectory import check_laws
from flowsplat.priors.objects.path import MAX_REDUCED_CHI_SQUARE, Law, constant_height, pivot
from tests.priors.objects.test_distance import UP, moving_scene

GOOD = {
    "pivot": Law(0.2, 0.02, 1.0, {"rest": 0.1, "turned": 60.0, "lever": 3.0}),
    "height": Law(0.2, 0.02, 1.0, {"explained": 0.9}),
}


def told(monkeypatch, **changed: Law) -> set[str]:
    """Which laws speak where ``GOOD`` is what they say, but for what is changed."""
    laws = {**GOOD, **changed}
    monkeypatch.setattr(depth_trajectory, "pivot", lambda path: laws["pivot"])
    monkeypatch.setattr(depth_trajectory, "constant_height", lambda path, normal: laws["height"])
    return set(check_laws(None, UP)[0])  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["pivot", "height"])
def test_a_fit_above_the_noise_cannot_vouch_for_a_law(name, monkeypatch):
    assert told(monkeypatch) == {"pivot", "height"}
    assert told(monkeypatch, **{name: replace(GOOD[name], fit=MAX_REDUCED_CHI_SQUARE)}) == {"pivot", "height"}
    assert told(monkeypatch, **{name: replace(GOOD[name], fit=1.01 * MAX_REDUCED_CHI_SQUARE)}) == {"pivot", "height"} - {name}
    assert told(monkeypatch, **{name: replace(GOOD[name], fit=np.nan)}) == {"pivot", "height"} - {name}


@pytest.mark.parametrize("seed", range(3))
def test_what_obeys_a_law_is_far_below_the_gate_and_what_hops_far_above(seed):
    assert constant_height(moving_scene("rolling", seed)[0], UP).fit < MAX_REDUCED_CHI_SQUARE / 5
    assert pivot(moving_scene("pendulum", seed)[0]).fit < MAX_REDUCED_CHI_SQUARE / 5
    hopping = moving_scene("hopping", seed)[0]
    assert not constant_height(hopping, UP).holds
    assert not pivot(hopping).holds
