"""The multicut: against every division of small graphs, and what must hold of any graph."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np
import pytest

from flowsplat.priors.objects.identity.multicut import cut_cost, multicut


def divisions(count: int, labels: tuple[int, ...] = ()) -> Iterator[np.ndarray]:
    """All of them, as labels [count]."""
    if len(labels) == count:
        yield np.array(labels)
        return
    for label in range(max(labels, default=-1) + 2):
        yield from divisions(count, (*labels, label))


def graph(count: int, seed: int, share: float = 0.7) -> tuple[np.ndarray, np.ndarray]:
    """Some of the pairs [E, 2] of nodes, and their costs."""
    rng = np.random.default_rng(seed)
    pairs = np.array(list(combinations(range(count), 2)))
    pairs = pairs[rng.random(len(pairs)) < share]
    return pairs, rng.normal(size=len(pairs))


def test_it_is_the_optimum_of_small_graphs_or_close_to_it():
    everything = list(divisions(7))
    assert len(everything) == 877  # Bell's number
    off = []
    for seed in range(100):
        pairs, costs = graph(7, seed)
        best = min(cut_cost(labels, pairs, costs) for labels in everything)
        found = cut_cost(multicut(7, pairs, costs), pairs, costs)
        assert found >= best - 1e-9
        off.append((found - best) / np.abs(costs).sum())
    # It is no exact method: nine of ten are exact, the rest are close.
    assert np.mean(np.array(off) < 1e-9) >= 0.9
    assert max(off) < 0.1


def test_what_only_attracts_is_one_cluster():
    pairs, costs = graph(40, 1, share=0.3)
    assert (multicut(40, pairs, np.abs(costs)) == 0).all()


def test_what_only_repels_stays_alone():
    pairs, costs = graph(40, 1, share=0.3)
    assert multicut(40, pairs, -np.abs(costs)).tolist() == list(range(40))


def test_noisy_costs_give_about_the_planted_clusters():
    rng = np.random.default_rng(0)
    true = np.sort(rng.integers(0, 5, 150))
    pairs = np.array(list(combinations(range(150), 2)))
    pairs = pairs[rng.random(len(pairs)) < 0.3]
    costs = np.where(true[pairs[:, 0]] == true[pairs[:, 1]], 0.7, -0.7) + rng.normal(size=len(pairs))
    found = multicut(150, pairs, costs)
    assert cut_cost(found, pairs, costs) <= cut_cost(true, pairs, costs)
    shared = np.zeros((5, found.max() + 1))
    np.add.at(shared, (true, found), 1)
    assert shared.max(1).sum() > 0.9 * 150


def test_kernighan_lin_moves_repair_what_contraction_did():
    # Nodes 1 and 2 are joined first; 2 then belongs with 3 and 4 all the same.
    pairs = np.array([[0, 1], [1, 2], [2, 3], [2, 4], [3, 4], [0, 2], [0, 3], [0, 4], [1, 3], [1, 4]])
    costs = np.array([0.5, 1.0, 0.9, 0.9, 0.3, -0.6, -1.0, -1.0, -1.0, -1.0])
    best = min(cut_cost(labels, pairs, costs) for labels in divisions(5))
    assert cut_cost(multicut(5, pairs, costs), pairs, costs) == pytest.approx(best)


def test_another_order_of_nodes_and_pairs_changes_nothing():
    for seed in range(5):
        pairs, costs = graph(30, seed)
        found = multicut(30, pairs, costs)
        rng = np.random.default_rng(seed)
        order, shuffled = rng.permutation(30), rng.permutation(len(pairs))
        again = multicut(30, order[pairs[shuffled]], costs[shuffled])[order]
        assert (found[pairs[:, 0]] == found[pairs[:, 1]]).tolist() == (again[pairs[:, 0]] == again[pairs[:, 1]]).tolist()


def test_nothing_and_one_node():
    nothing = np.zeros((0, 2), int), np.zeros(0)
    assert multicut(0, *nothing).tolist() == []
    assert multicut(1, *nothing).tolist() == [0]
