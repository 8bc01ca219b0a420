"""Minimum-cost multicut: how many clusters there are, and what is in them, follows from costs of pairs alone.

Every pair of nodes that is told of has a cost of being in different clusters, positive if they attract each other. What is looked
for is the division with the smallest sum of the costs that are cut. Greedy additive edge contraction joins the pair with the
largest sum until none is positive (Keuper et al., ICCV 2015); then moves of Kernighan and Lin between two clusters, or from one
to a new one, are made as long as the sum falls.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix

from flowsplat.common.kernels import kernel

MAX_ROUNDS = 20
"""Times that all pairs of clusters are looked at, at most; 2 to 5 are needed."""
MIN_GAIN = 1e-9
"""By which a move has to lower the sum."""


def multicut(count: int, pairs: np.ndarray, costs: np.ndarray) -> np.ndarray:
    """Clusters [N] of nodes, numbered from 0 in the order of their first nodes.

    Args:
        count: how many nodes there are.
        pairs: [E, 2] of nodes; one that comes twice counts twice.
        costs: [E] of cutting each.
    """
    rows, columns = pairs.reshape(-1, 2).astype(np.int64).T
    values = np.asarray(costs, np.float64)
    graph = csr_matrix((np.r_[values, values], (np.r_[rows, columns], np.r_[columns, rows])), (count, count))
    graph.setdiag(0)
    graph.eliminate_zeros()
    graph.sum_duplicates()
    graph.sort_indices()
    labels = _improve(graph, _contract_greedily(graph))
    _, first, labels = np.unique(labels, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[labels]


def cut_cost(labels: np.ndarray, pairs: np.ndarray, costs: np.ndarray) -> float:
    """The sum of the costs of the pairs that a division cuts."""
    return float(np.asarray(costs)[labels[pairs[:, 0]] != labels[pairs[:, 1]]].sum())


def _contract_greedily(graph: csr_matrix) -> np.ndarray:
    """[N] labels by greedy additive edge contraction; of equal sums that of the lowest nodes goes first."""
    return _contract(graph.toarray())


@kernel
def _contract(sums: np.ndarray) -> np.ndarray:
    """Contract edges of a dense symmetric graph [N, N], which is changed."""
    count = len(sums)
    labels = np.arange(count)
    best = np.full(count, -1)
    for i in range(count):
        best[i] = _find_largest(sums, labels, i)
    while True:
        a, most = -1, 0.0
        for i in range(count):
            if labels[i] == i and best[i] >= 0 and sums[i, best[i]] > most:
                a, most = i, sums[i, best[i]]
        if a < 0:
            break
        b = best[a]
        if b < a:
            a, b = b, a
        labels[b] = a
        for k in range(count):
            if labels[k] == k and k != a:
                sums[a, k] += sums[b, k]
                sums[k, a] = sums[a, k]
        best[a] = _find_largest(sums, labels, a)
        for k in range(count):
            if labels[k] == k and k != a:
                if best[k] == a or best[k] == b:
                    best[k] = _find_largest(sums, labels, k)
                elif sums[k, a] > 0 and (best[k] < 0 or sums[k, a] > sums[k, best[k]]):
                    best[k] = a
    for i in range(count):
        root = i
        while labels[root] != root:
            root = labels[root]
        labels[i] = root
    return labels


@kernel
def _find_largest(sums: np.ndarray, labels: np.ndarray, i: int) -> int:
    """The root to which another one is drawn most; -1 if to none."""
    found, most = -1, 0.0
    for k in range(len(sums)):
        if k != i and labels[k] == k and sums[i, k] > most:
            found, most = k, sums[i, k]
    return found


def _improve(graph: csr_matrix, labels: np.ndarray) -> np.ndarray:
    """[N] labels after moves between all pairs of clusters that hang together, and out of every one."""
    labels = np.unique(labels, return_inverse=True)[1]
    changed = np.ones(labels.max(initial=-1) + 1, bool)
    for _ in range(MAX_ROUNDS):
        before, count = changed, labels.max(initial=-1) + 1
        changed = np.zeros(count, bool)
        entries = graph.tocoo()
        sums = csr_matrix((entries.data, (labels[entries.row], labels[entries.col])), (count, count)).tocoo()
        # In the order of their sums, not of their nodes: these may come in any.
        order = np.argsort(-sums.data, kind="stable")
        met = [(int(a), int(b)) for a, b in zip(sums.row[order], sums.col[order], strict=True) if before[a] or before[b]]
        alone = [(a, -1) for a, b in met[::-1] if a == b]
        for a, b in [*((a, b) for a, b in met if a < b), *alone]:
            members = np.flatnonzero((labels == a) | (labels == b))
            block = graph[members][:, members].toarray()
            side = _move(block, labels[members] == a)
            moved = side != (labels[members] == a)
            if moved.any():
                new = b if b >= 0 else len(changed)
                if b < 0:
                    changed = np.append(changed, False)
                labels[members] = np.where(side, a, new)
                changed[a] = changed[new] = True
        if not changed.any():
            break
        kept, labels = np.unique(labels, return_inverse=True)
        changed = changed[kept]
    return labels


@kernel
def _move(block: np.ndarray, side: np.ndarray) -> np.ndarray:
    """On which side [N] every node is after the best sequence of moves, repeated; joining both sides is one of them.

    Args:
        block: [N, N] costs.
        side: [N] bool, where each is now.
    """
    count = len(block)
    side = side.copy()
    for _ in range(MAX_ROUNDS):
        gain = np.zeros(count)
        across = 0.0
        for i in range(count):
            for j in range(count):
                gain[i] += -block[i, j] if side[i] == side[j] else block[i, j]
                if side[i] and not side[j]:
                    across += block[i, j]
        trial, free = side.copy(), np.ones(count, np.bool_)
        order, total, best, length = np.zeros(count, np.int64), 0.0, MIN_GAIN, 0
        for step in range(count):
            chosen = -1
            for i in range(count):
                if free[i] and (chosen < 0 or gain[i] > gain[chosen]):
                    chosen = i
            total += gain[chosen]
            free[chosen] = False
            order[step] = chosen
            for j in range(count):
                if free[j]:
                    gain[j] += 2 * block[chosen, j] if trial[j] == trial[chosen] else -2 * block[chosen, j]
            trial[chosen] = not trial[chosen]
            if total > best:
                best, length = total, step + 1
        if across > best:
            return np.ones(count, np.bool_)
        if length == 0:
            return side
        for step in range(length):
            side[order[step]] = not side[order[step]]
    return side
