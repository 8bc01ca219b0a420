"""The fit of who comes back: how worlds are seen, how joins are counted, and that what is stored is of this code."""

from __future__ import annotations

import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.common.files import read_json
from flowsplat.priors.objects.identity.cost import Cost
from flowsplat.priors.objects.identity.returning import FEATURES, WEIGHTS, make_classifier
from flowsplat_benchmarks.scripts.returning import (
    GROUPS,
    Known,
    Rendered,
    choose_gate,
    draw_episode,
    list_worlds,
    plain,
    read_known,
    score,
)


def made_up(probabilities: list[float], pairs: list[tuple[int, int]], same: list[bool]) -> tuple[Known, Cost]:
    """An episode whose pairs get these probabilities, by their first feature."""
    features = np.zeros((len(pairs), len(FEATURES)))
    features[:, 0] = [np.log(p / (1 - p)) for p in probabilities]
    count = len(FEATURES)
    cost = Cost(np.zeros(count), np.ones(count), np.append(1.0, np.zeros(count + count * (count + 1) // 2)))
    frames = np.array([(5 * a, 5 * b) for a, b in pairs])
    return Known(np.array(pairs), frames, features, np.array(same), np.array(same)), cost


def test_joins_are_counted_and_the_gate_is_the_lowest_with_few_wrong_ones():
    known, cost = made_up([0.96, 0.75, 0.9], [(1, 2), (3, 4), (5, 6)], [True, False, True])
    found = score([[known]], cost, 0.5)
    assert (found.joins, found.wrong, found.possible) == (3, 1, 2)
    assert str(found) == "3 joins, 1 wrong: precision 0.667, recall 1.000 of 2"
    assert score([[known]], cost, 0.95).joins == 1
    assert choose_gate([[known]], cost) == 0.8


def test_an_absence_gives_another_number_and_its_object_is_known():
    frames, size = 24, (72, 128)
    masks, images = np.zeros((2, frames, *size), np.uint8)
    masks[:, 20:50, 40:60], masks[:, 30:60, 80:100] = 1, 2
    images = np.repeat(images[..., None] + np.where(masks == 1, 200, 90)[..., None], 3, -1).astype(np.uint8)
    K = np.tile(np.array([[128.0, 0, 64], [0, 128, 36], [0, 0, 1]]), (frames, 1, 1))
    world = Rendered(images, masks, np.tile(np.eye(4), (frames, 1, 1)), K, np.arange(frames) / 6)
    told = set()
    for seed in range(12):
        clip, owners = draw_episode(world, world, np.random.default_rng(seed))
        labels = np.stack([clip.mask(k) for k in range(frames)])
        for number in np.unique(labels[labels > 0]):
            seen = np.flatnonzero((labels == number).any((1, 2)))
            assert np.diff(seen).max(initial=1) <= 2, "shorter absences keep their number"
        known = read_known(clip, owners)
        if known is not None:
            assert (known.frames[:, 0] < known.frames[:, 1]).all()
            assert np.isfinite(known.features).all()
            assert (known.same == (owners[known.pairs[:, 0]] == owners[known.pairs[:, 1]])).all()
            told |= set(known.same.tolist())
    assert told == {False, True}


def test_groups_share_no_world_and_what_is_stored_belongs_to_the_features_that_are_computed():
    names = [world for group in GROUPS for world in list_worlds(group)]
    assert len(names) == len(set(names))
    values = read_json(WEIGHTS)
    assert plain(make_classifier(values), values["fitted on"]) == values
    assert {tuple(name.split("-")) for name in values["fitted on"]} <= {(kind, str(seed)) for kind, seed in list_worlds("fitted")}
    with pytest.raises(InputError, match="other features"):
        make_classifier({**values, "features": values["features"][1:]})
