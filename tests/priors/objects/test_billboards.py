"""The guess that every object has: a billboard before what it hides."""

from __future__ import annotations

import numpy as np
import pytest

from flowsplat.priors.objects.billboards import growth, place_billboard, smooth_billboards


def test_a_card_stands_on_the_ground_at_its_feet():
    plate = np.linspace(0.1, 1, 40, dtype=np.float32)[:, None] * np.ones((1, 30), np.float32)
    mask = np.zeros((40, 30), bool)
    mask[8:30, 10:16] = True
    assert place_billboard(mask, plate) >= plate[29, 0] * 0.99
    assert place_billboard(mask, plate) < plate[34, 0]


def test_cards_are_smooth_and_stay_near():
    billboards, still = np.full(40, 0.5), np.zeros(40)
    billboards[10:13] = np.nan
    billboards[20] = 5.0
    smooth = smooth_billboards(billboards, still, still)
    assert np.isnan(smooth[10:13]).all()
    np.testing.assert_allclose(smooth[np.isfinite(smooth)], 0.5)
    assert smooth_billboards(np.where(np.arange(40) % 2, 0.5, 0.7), still, still)[20] > 0.65
    assert np.isnan(smooth_billboards(np.full(5, np.nan), still[:5], still[:5])).all()


def test_cards_do_not_reach_across_a_cut():
    halves = np.repeat([1.5, 0.5], 40)
    np.testing.assert_allclose(smooth_billboards(halves, np.zeros(80), np.repeat([0, 1], 40)), halves)


def test_what_grows_comes_nearer():
    nearness = smooth_billboards(np.full(40, 0.5), np.full(40, 0.01), np.zeros(40))
    np.testing.assert_allclose(np.diff(np.log(nearness)), 0.007, atol=2e-3)


@pytest.mark.parametrize("factor", [0.9, 1.0, 1.2])
def test_growth_is_that_of_the_object_and_not_of_what_is_near_it(factor):
    rows, columns = np.mgrid[:60, :80].astype(np.float32)
    mask = np.zeros((60, 80), bool)
    mask[15:45, 20:60] = True
    flow = np.stack([(factor - 1) * (columns - 40) + 3, (factor - 1) * (rows - 30)], -1)
    flow[15:25, 20:30] = 9
    flow[~mask] = 0
    assert growth(mask, flow, np.ones((60, 80), np.float32)) == pytest.approx(np.log(factor), abs=0.02)
    assert growth(mask, flow, np.zeros((60, 80), np.float32)) == 0
