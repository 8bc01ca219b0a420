"""A law of motion speaks for a distance only where the path obeys it."""

from __future__ import annotations

import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from flowsplat.priors.objects import depth_trajectory
from flowsplat.priors.objects.depth_trajectory import check_laws
from flowsplat.priors.objects.path import MAX_REDUCED_CHI_SQUARE, Law, constant_height, pivot
from tests.priors.objects.test_distance import UP, moving_scene

GOOD = {
    "pivot": Law(0.2, 0.02, 1.0, {"rest": 0.1, "turned": 60.0}),
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


@pytest.mark.parametrize("measures", [{"rest": 0.3, "turned": 60.0}, {"rest": 0.1, "turned": 20.0}])
def test_a_pivot_that_moves_or_about_which_little_turns_says_nothing(measures, monkeypatch):
    assert told(monkeypatch, pivot=replace(GOOD["pivot"], measures=measures)) == {"height"}


@pytest.mark.parametrize(("differ", "believed"), [(set(), True), ({0}, True), ({1}, True), ({0, 1}, False), ({0, 2}, False)])
def test_one_unlucky_way_to_halve_the_tracks_does_not_decide(differ, believed, monkeypatch):
    """``differ``: of the three ways to halve them, those whose halves tell different motions."""
    calls = itertools.count(-1)  # all tracks first, then half after half

    def solved(observations):
        way, half = divmod(next(calls), 2)
        off = 0.5 if way in differ and half else 0.0
        return SimpleNamespace(inliers=1.0, noise=0.2, log_depths=lambda: np.linspace(0, off, 20))

    monkeypatch.setattr(depth_trajectory, "solve_rigid", solved)
    monkeypatch.setattr(depth_trajectory, "TRACKS_PER_FRAME", (50,))
    motion, _ = depth_trajectory.rigid_motions(np.zeros((40, 20, 2)), np.ones((40, 20), bool), np.eye(3))
    assert (motion is not None) == believed
