"""How far the input camera is looked past, and how it springs back."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import flowsplat.output.player
from flowsplat.common.files import read_text
from flowsplat.output.viewer import elastic
from flowsplat.output.viewer.elastic import MAX_PULL, REST, SPRING_SECONDS, STILL_SECONDS, ElasticTurn, resist

REACH = 5.0


def pulled(turn: tuple[float, float], now: float = 0.0) -> ElasticTurn:
    found = ElasticTurn()
    found.pull(turn, REACH, now)
    return found


def test_the_numbers_are_those_of_the_page():
    script = read_text(Path(flowsplat.output.player.__file__).parent / "assets" / "elastic_view.js")
    theirs = dict(re.findall(r"^const (\w+) = ([\d.]+);", script, re.MULTILINE))
    for name in ("REST", "MAX_PULL", "SPRING_SECONDS"):
        assert float(theirs[name]) == getattr(elastic, name)


def test_resistance_grows_and_ends():
    pulls = np.linspace(0, MAX_PULL, 400)
    shown = np.array([resist(float(pull)) for pull in pulls])
    slopes = np.diff(shown) / np.diff(pulls)
    free = pulls[1:] <= REST
    np.testing.assert_allclose(slopes[free], 1)
    assert (np.diff(slopes[~free]) < 0).all()
    assert (slopes > 0).all()
    assert 0.999 < shown[-1] < 1
    assert np.abs(np.diff(slopes)).max() < 0.06, "without a jerk"


@pytest.mark.parametrize("turn", [(0.0, 0.0), (4.9, 0.0), (-3.0, 1.9), (0.0, -2.4)])
def test_within_the_reach_it_follows_and_stays(turn):
    view = pulled(turn)
    for now in (0.0, 0.2, 5.0):
        assert view.turn(now) == pytest.approx(turn)
        assert not view.is_moving(now)


@pytest.mark.parametrize("turn", [(6.0, 0.0), (-60.0, 20.0), (0.0, 80.0), (180.0, 90.0)])
def test_beyond_it_resists_and_springs_back_to_the_reach(turn):
    view = pulled(turn, 10.0)
    lengths = []
    for now in np.arange(10.0, 13.0, 0.02).tolist():
        x, y = view.turn(now)
        assert np.arctan2(y, x) == pytest.approx(np.arctan2(turn[1], turn[0])), "along the way that it was pulled"
        lengths.append(np.hypot(x, 2 * y))
        assert view.is_moving(now) == (lengths[-1] > REACH * (1 + 1e-9))
    held = round(STILL_SECONDS / 0.02)
    assert REACH < lengths[0] < min(np.hypot(turn[0], 2 * turn[1]), REACH / REST)
    assert np.ptp(lengths[:held]) == 0
    assert (np.diff(lengths[held:]) <= 0).all()
    assert lengths[-1] == pytest.approx(REACH)
    assert view.turn(13.0) == view.turn(99.0)
    one = view.turn(10.0 + STILL_SECONDS + 8 * SPRING_SECONDS)
    assert np.hypot(one[0], 2 * one[1]) == pytest.approx(REACH, rel=0.01)


def test_farther_than_counts_it_is_no_longer_on_its_way():
    """From wherever it was pulled, it is back after the same time."""
    assert pulled((9e9, 0.0)).turn(0.5) == pytest.approx(pulled((MAX_PULL * REACH / REST, 0.0)).turn(0.5))


def test_back_at_once():
    view = pulled((50.0, 0.0))
    view.reset()
    assert view.turn(0.0) == (0, 0)
    assert not view.is_held(0.0)
    assert not view.is_moving(0.0)
