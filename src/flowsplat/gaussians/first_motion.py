"""Estimate how the pixels of objects move around one frame: followed along flow and depth, and fitted together with their
neighbors. Ours.

A pixel alone is followed badly: for a frame or two on a fast limb, with depth that jumps from frame to frame. Its neighbors on the
same part share one motion, and where the part turns it is an affine function of the place at every time (to first order
omega x r, to second omega x (omega x r)). So at nodes all over an object a path that is a polynomial in time and affine in the
image is fitted to all pixels around that move alike, and every pixel takes the motion of the nodes that explain its own path.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from flowsplat.gaussians.observations import Observations
from flowsplat.geometry.interpolation import sample_map

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

NODE_SPACING, MIN_NODE_SPACING = 0.0125, 4.5
"""Widths of the image between two nodes, and pixels at least (docs/method/training.md, "Initialization")."""
NEIGHBORHOOD_SIGMA = 1.5
"""Standard deviation, in gaps between nodes, of how far around a node pixels count. Chosen by eye."""
NODE_NEIGHBORS = 48
"""Pixels that are asked at a node (docs/method/training.md, "Initialization")."""
PIXELS_PER_GAP = 3
"""As many pixels in a gap between two nodes are followed, beside those whose motion is wanted. Chosen by eye."""
CANDIDATE_NODES, PIXELS_AT_A_TIME = 8, 20_000
"""Nodes among which a pixel chooses, and how many pixels do so at a time, for the memory (docs/method/training.md,
"Initialization")."""
COLOR_SIGMA, MAX_COLOR_DISTANCE = 30.0, 9.0
"""Gray levels by which colors of one part differ, and the square, in these, beyond which it makes no difference. Chosen by eye."""
PATH_SIGMA, MAX_PATH_DISTANCE = 0.5, 50.0
"""The same of paths, in pixels. Chosen by eye."""
REWEIGHTINGS = 4
"""Of reweighting (docs/method/training.md, "Initialization")."""
PRESENCE_SIGMA = 0.8
"""Standard deviation, in those of the presence, of how much a time counts that is so far off (docs/method/training.md,
"Initialization")."""
CONFIDENCE_POWER, MIN_FLOW_CONFIDENCE = 2.0, 1e-3
"""Flow that does not come back counts this power of its confidence, where that is not less than the second number: it is often
right, and the neighbors judge (docs/method/training.md, "Initialization")."""
TIME_RIDGE, GRADIENT_RIDGE = 1e-3, 1e-1
"""Of the first order in time, in shares of what the observations weigh: ten times as much for every further order. Chosen by eye.
"""
MIN_OWN_SHARE = 0.5
"""Of the pixels around a place, by their weight, what share must belong to the object. Chosen by eye."""
ALONG_RAY_WEIGHT = 0.1
"""What a pixel along the ray counts, relative to one across it. Chosen by eye."""


@dataclass(frozen=True)
class _Paths:
    """Pixels [N] of a frame and where they went, in pixels along its camera's axes: sums over the times at which each was seen.

    Attributes:
        points: [N, 2] pixels.
        colors: [N, 3] gray levels.
        normal: [N, order, order] of w b b^T, with b the powers of time.
        right: [N, order, 3] of w b d^T, with d the way from the start; along the ray it counts ``ALONG_RAY_WEIGHT``.
        square: [N] of w d^T d.
        weight: [N] of w; 0 where a pixel was never found again.
    """

    points: np.ndarray
    colors: np.ndarray
    normal: np.ndarray
    right: np.ndarray
    square: np.ndarray
    weight: np.ndarray


def fit_motion(observations: Observations, k: int, wanted: np.ndarray, sigma: float, order: int, reach: int) -> np.ndarray:
    """Polynomial coefficients [N, order, 3] of the paths of some pixels of frame ``k`` about its time; 0 where nothing is known.

    Args:
        wanted: [H, W] bool, which pixels of objects.
        sigma: clip time for which they are present.
        order: of the polynomial.
        reach: training frames to either side in which they are followed.
    """
    frame = observations[k]
    gap = max(MIN_NODE_SPACING, NODE_SPACING * observations.size[0])
    step = max(1, round(gap / PIXELS_PER_GAP))
    y, x = np.mgrid[: wanted.shape[0], : wanted.shape[1]]
    evenly = (x % step == step // 2) & (y % step == step // 2)
    rows, columns = np.nonzero(frame.mask & (wanted | evenly))
    asked, evenly = wanted[rows, columns], evenly[rows, columns]
    points = np.stack([columns, rows], 1) + 0.5
    start = frame.camera.unproject(points, frame.depth[rows, columns].astype(np.float64))
    # How far a pixel spans at the place of each, in units of the scene.
    unit = frame.depth[rows, columns].astype(np.float64) / frame.camera.K[0, 0]
    axes = np.array([1, 1, ALONG_RAY_WEIGHT])[:, None] * frame.camera.viewmat[:3, :3]
    normal, right = np.zeros((len(points), order, order)), np.zeros((len(points), order, 3))
    square, total = np.zeros(len(points)), np.zeros(len(points))
    owners = frame.object_ids[rows, columns]
    for time, (world, sure) in follow(observations, k, points, owners, reach).items():
        tau = (time - frame.time) / sigma
        basis, weight = tau ** np.arange(1, order + 1), np.exp(-0.5 * (tau / PRESENCE_SIGMA) ** 2) * sure
        moved = np.where(sure[:, None] > 0, world - start, 0) @ axes.T / unit[:, None]
        normal += weight[:, None, None] * np.outer(basis, basis)
        right += (weight[:, None] * moved)[:, None] * basis[:, None]
        square += weight * (moved**2).sum(1)
        total += weight
    paths = _Paths(points, frame.image[rows, columns].astype(np.float64), normal, right, square, total)
    coefficients = np.zeros((len(points), order, 3))
    for number in np.unique(owners[asked]):
        mine = owners == number
        sources = np.flatnonzero(mine & evenly & (total > 0))
        if len(sources) == 0:  # The nearest ones, whosever they are, are the best guess.
            sources = np.flatnonzero(total > 0)
        if len(sources):
            queries = np.flatnonzero(mine & asked)
            coefficients[queries] = _joint(paths, np.flatnonzero(mine), sources, queries, gap)
    scale = unit[asked, None, None] / sigma ** np.arange(1, order + 1)[:, None]
    return np.asarray((coefficients[asked] * scale) @ np.linalg.inv(axes).T)


def follow(
    observations: Observations, k: int, points: np.ndarray, owners: np.ndarray, reach: int
) -> dict[float, tuple[np.ndarray, np.ndarray]]:
    """3D positions [N, 3] of pixels of frame k at the times of its neighbors, along flow and depth, and how sure they are [N].

    Sure as the least sure flow on the way, 0 where lost. Between pixels, flow and depth are those of the object's pixels around,
    never mixed with those of what is behind it, or before it: a pixel that would go on on another object is hidden by that one,
    and the depth there is not its own.

    Args:
        points: [N, 2] pixels.
        owners: [N] whose they are.
    """
    found: dict[float, tuple[np.ndarray, np.ndarray]] = {}
    for step in (1, -1):
        here, sure, current = points.astype(np.float32), np.ones(len(points)), k
        for _ in range(reach):
            frame = observations[current]
            flow = frame.flow(step)
            if flow is None:
                break
            weight = np.where(flow.trusted, 1, flow.confidence**CONFIDENCE_POWER)
            moved, share = _inside(np.dstack([flow.flow, weight.astype(np.float32)]), frame.object_ids, here, owners)
            sure = np.where(share > MIN_OWN_SHARE, np.minimum(sure, moved[:, 2]), 0)
            here = np.where(sure[:, None] > 0, here + moved[:, :2], here)
            current += step
            frame = observations[current]
            depth, share = _inside(frame.depth[..., None], frame.object_ids, here, owners)
            sure = np.where((share > MIN_OWN_SHARE) & (sure > MIN_FLOW_CONFIDENCE), sure, 0)
            if not sure.any():
                break
            world = frame.camera.unproject(here, np.where(sure > 0, depth[:, 0], 1).astype(np.float64))
            found[frame.time] = world, sure
    return found


def _inside(values: np.ndarray, object_ids: np.ndarray, points: np.ndarray, owners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return values [N, C] of a map [H, W, C] at points [N, 2], of the pixels of their owner alone, and the share of those around
    [N]."""
    found, shares = np.zeros((len(points), values.shape[2]), np.float32), np.zeros(len(points), np.float32)
    height, width = object_ids.shape
    for number in np.unique(owners):
        mine = np.flatnonzero(owners == number)
        weight = (object_ids == number).astype(np.float32)
        share = sample_map(weight, points[mine])[:, 0]
        share[~((points[mine] > 0) & (points[mine] < [width, height])).all(1)] = 0
        found[mine] = sample_map(values * weight[..., None], points[mine]) / np.maximum(share, 1e-6)[:, None]
        shares[mine] = share
    return found, shares


def _joint(paths: _Paths, mine: np.ndarray, sources: np.ndarray, queries: np.ndarray, gap: float) -> np.ndarray:
    """Return the motion [Q, order, 3] of the pixels ``queries`` of an object that has the pixels ``mine``, from its pixels
    ``sources``."""
    from scipy.spatial import cKDTree  # A quarter of a second, which those who only look at a scene need not wait.

    nodes = _nodes(paths.points, mine, gap)
    away, index = _nearest(cKDTree(paths.points[sources]), paths.points[nodes], min(NODE_NEIGHBORS, len(sources)))
    motion = _fit(paths, nodes, sources[index], away, gap)
    tree = cKDTree(paths.points[nodes])
    parts = [queries[first : first + PIXELS_AT_A_TIME] for first in range(0, len(queries), PIXELS_AT_A_TIME)]
    return np.concatenate([_choose_motion(paths, nodes, motion, tree, part, gap) for part in parts])


def _choose_motion(
    paths: _Paths, nodes: np.ndarray, motion: np.ndarray, tree: cKDTree, queries: np.ndarray, gap: float
) -> np.ndarray:
    """Return the motion [Q, order, 3] of pixels from that of the nodes: of those around that explain their own paths and have their
    color."""
    away, index = _nearest(tree, paths.points[queries], min(CANDIDATE_NODES, len(nodes)))
    place = _make_design_rows(paths.points[queries][:, None], paths.points[nodes[index]], gap)
    models = (place[..., None, None] * motion[index]).sum(-3)
    cost = (away / gap) ** 2 + np.minimum(_unlike(paths, queries[:, None], nodes[index]), MAX_COLOR_DISTANCE)
    cost += np.minimum(_misfit(paths, queries[:, None], models) / PATH_SIGMA**2, MAX_PATH_DISTANCE)
    share = np.exp(-0.5 * (cost - cost.min(1, keepdims=True)))
    share /= share.sum(1, keepdims=True)
    return np.asarray((share[..., None, None] * models).sum(1))


def _fit(paths: _Paths, nodes: np.ndarray, index: np.ndarray, away: np.ndarray, gap: float) -> np.ndarray:
    """Return the motion [M, 3 (constant, across, down), order, 3] at the nodes, of the pixels ``index`` [M, K] around that move
    alike."""
    place = _make_design_rows(paths.points[index], paths.points[nodes][:, None], gap)
    prior = (
        np.exp(-0.5 * np.minimum(away / (NEIGHBORHOOD_SIGMA * gap), 4) ** 2) / (1 + _unlike(paths, index, nodes[:, None])) + 1e-6
    )
    (count, around), order = index.shape, paths.normal.shape[-1]
    ridges = np.concatenate([TIME_RIDGE * 10.0 ** np.arange(order), np.tile(GRADIENT_RIDGE * 10.0 ** np.arange(order), 2)])
    normal, right = paths.normal[index].reshape(count, around, -1), paths.right[index].reshape(count, around, -1)
    squares = (place[..., :, None] * place[..., None, :]).reshape(count, around, 9)
    factor = np.ones(index.shape)
    for _ in range(REWEIGHTINGS):
        w = (prior * factor)[..., None]
        A = ((w * squares).transpose(0, 2, 1) @ normal).reshape(count, 3, 3, order, order).transpose(0, 1, 3, 2, 4)
        b = ((w * place).transpose(0, 2, 1) @ right).reshape(count, 3 * order, 3)
        ridge = (w[..., 0] * paths.weight[index]).sum(1)[:, None] * ridges
        C = np.linalg.solve(A.reshape(count, 3 * order, -1) + ridge[:, None] * np.eye(3 * order), b).reshape(count, 3, order, 3)
        rest = _misfit(paths, index, (place[..., None, None] * C[:, None]).sum(-3))
        factor = 1 / (1 + rest / np.maximum(_compute_weighted_median(rest, prior), PATH_SIGMA**2)[:, None])
    return np.asarray(C)


def _nodes(points: np.ndarray, mine: np.ndarray, gap: float) -> np.ndarray:
    """Select of pixels ``mine`` those nearest to the middle of every cell that is ``gap`` wide."""
    cell = np.floor(points[mine] / gap)
    off = np.linalg.norm(points[mine] / gap - cell - 0.5, axis=1)
    order = np.lexsort((off, cell[:, 0], cell[:, 1]))
    first = np.ones(len(order), bool)
    first[1:] = (cell[order][1:] != cell[order][:-1]).any(1)
    return np.asarray(mine[order[first]])


def _nearest(tree: cKDTree, points: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return distances and indices [N, count]."""
    away, index = tree.query(points, k=count)
    return away.reshape(-1, count), index.reshape(-1, count)


def _make_design_rows(points: np.ndarray, nodes: np.ndarray, gap: float) -> np.ndarray:
    """Return [..., 3]: 1, and how far points are from nodes, across and down."""
    offsets = (points - nodes) / (NEIGHBORHOOD_SIGMA * gap)
    return np.concatenate([np.ones((*offsets.shape[:-1], 1)), offsets], -1)


def _unlike(paths: _Paths, pixels: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return [...] squares of how much colors differ."""
    return np.asarray(((paths.colors[pixels] - paths.colors[others]) ** 2).sum(-1) / COLOR_SIGMA**2)


def _misfit(paths: _Paths, pixels: np.ndarray, models: np.ndarray) -> np.ndarray:
    """Return [...] mean squares in pixels of what motions [..., order, 3] leave of the paths of pixels [...]; 0 for one without
    any."""
    left = paths.square[pixels] - 2 * (models * paths.right[pixels]).sum((-2, -1))
    left = left + (models * (paths.normal[pixels] @ models)).sum((-2, -1))
    return np.asarray(np.maximum(left, 0) / np.maximum(paths.weight[pixels], 1e-9))


def _compute_weighted_median(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return [M] of values [M, K]."""
    order = np.argsort(values, 1)
    summed = np.cumsum(np.take_along_axis(weights, order, 1), 1)
    middle = (summed < 0.5 * summed[:, -1:]).sum(1)
    return np.take_along_axis(values, np.take_along_axis(order, middle[:, None], 1), 1)[:, 0]
