"""The fit of the costs of object ids: on made-up features, what is fitted is found again; and what is stored is of this code."""

from __future__ import annotations

import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.priors.objects.identity.clusters import FEATURES
from flowsplat.priors.objects.identity.cost import make_costs, read_weights
from flowsplat.priors.objects.identity.pairs import Trajectories
from flowsplat_benchmarks.scripts.identity import Known, fit_cost, idf1, plain


def read_known(true: np.ndarray, part: np.ndarray) -> Known:
    tracks = Trajectories(np.zeros((*part.shape, 2), np.float32), part, np.zeros((len(part), 3)), np.zeros((2, 4, 4), bool))
    return Known(tracks, true, true.max(1), np.zeros((0, 2), int), np.zeros((0, 9)))


def test_logistic_regression_finds_the_log_odds_that_were_drawn_from():
    rng = np.random.default_rng(0)
    features = rng.normal(size=(40000, 2))
    log_odds = 0.5 + 1.5 * features[:, 0] - features[:, 0] * features[:, 1]
    same = rng.random(len(features)) < 1 / (1 + np.exp(-log_odds))
    cost = fit_cost([features], [same], [np.ones(len(features))], 1e-4)
    inside = np.abs(log_odds) < 4
    assert np.abs(cost(features) - log_odds)[inside].mean() < 0.1


def test_idf1_of_right_joined_and_missing_ids():
    true = np.array([[1, 1], [1, 1], [2, 2], [2, 2]])
    known = read_known(true, np.ones((4, 2), np.int16))
    assert idf1(np.array([5, 5, 3, 3]), known) == 1
    assert idf1(np.array([1, 1, 1, 1]), known) == 0.5
    assert idf1(np.array([1, 1, 0, 0]), known) == pytest.approx(2 * 4 / (4 + 8))
    assert idf1(np.array([0, 0, 0, 0]), known) == 0


def test_what_is_stored_belongs_to_the_features_that_are_computed():
    costs = make_costs(read_weights(), FEATURES)
    again = plain(costs, read_weights()["fitted on"])
    assert again == read_weights()
    with pytest.raises(InputError, match="other features"):
        make_costs(read_weights(), {**FEATURES, "tracks": FEATURES["tracks"][1:]})
