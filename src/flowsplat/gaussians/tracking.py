"""Tracks out of the model: a pixel at a time becomes a path in 3D, carried by the Gaussians that are seen there."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from flowsplat.gaussians.gaussians4d import Gaussians4D
from flowsplat.gaussians.model import SceneModel
from flowsplat.gaussians.render import RenderedFrame, render_active
from flowsplat.geometry import Camera
from flowsplat.geometry.rotations import covariances, quats_to_rotations
from flowsplat.splatting.rules import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN

MAX_CARRIERS = 32
"""At most so many Gaussians carry a point. Chosen by eye."""
SURFACE_TOLERANCE = 0.05
"""Relative difference of depth up to which two things are one surface. Chosen by eye."""
HANDOVER_SHARE = 0.5
"""Carriers hand over when less than this share of the weight that they were chosen for is left. Chosen by eye."""
HANDOVER_SIGMAS = 4.0
"""Standard deviations from a point within which a Gaussian may take over; further away the nearest ones do. Chosen by eye."""
MAX_CARRIER_DISTANCE = 0.1
"""Share of its distance to the camera further than which nothing takes over a point. Chosen by eye."""


@dataclass(frozen=True)
class Paths:
    """Where Q points were over T frames.

    Attributes:
        points: [Q, T, 3] float64 in the coordinates of the scene's cameras. NaN where nothing carried the point: its pixel was
            empty, or its carriers faded and nothing took over.
        visible: [Q, T] bool: inside the image, and the rendered depth there is the point's.
        objects: [Q] uint8 number of the object that each point is on, as most of what is seen at its pixel says; 0 = on none.
    """

    points: np.ndarray
    visible: np.ndarray
    object_ids: np.ndarray


@torch.no_grad()
def follow_points(model: SceneModel, cameras: Sequence[Camera], timestamps: np.ndarray, queries: np.ndarray) -> Paths:
    """Follow points of the image through the model. Ours; the paper shows no tracks.

    The Gaussians that make up the pixel, by their weights alpha_i T_i (docs/method/flow.md, "Compositing"), carry the point that
    is seen
    there along
    their own rigid motion, objects or background, whichever holds more of it. A Gaussian carries while its presence is at
    least ``p_min``; when half of the weight has faded, those take over that are present where the point is.

    Args:
        cameras: [T] of the scene.
        timestamps: [T] seconds, rising.
        queries: [Q, 3]: u, v in pixels (the center of the top-left pixel is 0.5, 0.5) and the number of the frame.

    Raises:
        ValueError: the shapes do not fit.
    """
    queries = np.asarray(queries, np.float64)
    if queries.ndim != 2 or queries.shape[1] != 3 or len(cameras) != len(timestamps):
        raise ValueError(f"queries must be [Q, 3], not {list(queries.shape)}, and there must be one camera a time")
    model = model.to("cpu")
    normalized = [model.similarity.camera(camera) for camera in cameras]
    times = [model.clip_time(float(t)) for t in timestamps]
    starts = queries[:, 2].astype(np.int64)
    points = np.full((len(queries), len(times), 3), np.nan)
    chosen: dict[int, _Carriers] = {}
    for frame in np.unique(starts).tolist():
        here = np.flatnonzero(starts == frame)
        rendered = _render(model, normalized[frame], times[frame])
        found = [_find_point_at(model.gaussians, rendered, normalized[frame], queries[q, :2]) for q in here]
        for q, (point, carriers) in zip(here.tolist(), found, strict=True):
            if carriers is not None:
                points[q, frame], chosen[q] = point, carriers
    object_ids = np.zeros(len(queries), np.uint8)
    for q, carriers in chosen.items():
        numbers = model.gaussians.object_ids[torch.from_numpy(carriers.rows)].numpy()
        object_ids[q] = np.bincount(numbers, carriers.weights).argmax()
    for order in (range(len(times)), range(len(times) - 1, -1, -1)):
        _carry_along(model.gaussians, normalized, times, list(order), starts, dict(chosen), points)
    visible = np.zeros(points.shape[:2], bool)
    for i, (camera, t) in enumerate(zip(normalized, times, strict=True)):
        visible[:, i] = _is_seen(points[:, i], camera, _render(model, camera, t))
    return Paths(model.similarity.inverse().points(points), visible, object_ids)


@dataclass(frozen=True)
class _Carriers:
    """The Gaussians of one point.

    ``rows`` [K]; ``weights`` [K] as if all were fully present; ``promised`` is the weight that they had when they were chosen.
    """

    rows: np.ndarray
    weights: np.ndarray
    promised: float


# -- at the query


def _render(model: SceneModel, camera: Camera, t: float) -> _Frame:
    active = model.gaussians.active(t, camera)
    return _Frame(render_active(model.gaussians, active, camera, backend=model.backend), active.rows.numpy(), t)


@dataclass(frozen=True)
class _Frame:
    """A rendered frame, with the rows of its Gaussians and its time."""

    rendered: RenderedFrame
    rows: np.ndarray
    t: float


def pixel_weights(rendered: RenderedFrame, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which of the rendered Gaussians make up the image at the position ``uv`` [2] (pixels).

    Returns:
        their indices [K], front to back, and their weights alpha_i T_i [K], by the rules of the rasterizer.
    """
    projected = rendered.projected
    offset = torch.as_tensor(uv, dtype=projected.means2d.dtype) - projected.means2d
    near = torch.nonzero((offset.abs() <= projected.radii).all(1) & projected.visible).squeeze(1)
    near = near[torch.sort(projected.depths[near], stable=True).indices]
    x, y = offset[near].double().unbind(1)
    a, b, c = projected.conics[near].double().unbind(1)
    alpha = rendered.sliced.opacities[near].double() * torch.exp(-0.5 * (a * x * x + c * y * y) - b * x * y)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha.clamp(max=ALPHA_MAX), torch.zeros_like(alpha))
    after = torch.cumprod(1 - alpha, 0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    weights = torch.where(after > TRANSMITTANCE_MIN, alpha * before, torch.zeros_like(alpha))
    return near[weights > 0].numpy(), weights[weights > 0].numpy()


def _find_point_at(gaussians: Gaussians4D, frame: _Frame, camera: Camera, uv: np.ndarray) -> tuple[np.ndarray, _Carriers | None]:
    """Return the point [3] that is seen at a pixel, and who carries it; None where the pixel is empty."""
    index, weights = pixel_weights(frame.rendered, uv)
    if not len(index):
        return np.full(3, np.nan), None
    depths = frame.rendered.projected.depths.numpy()[index].astype(np.float64)
    moving = gaussians.dynamic.numpy()[frame.rows[index]]
    kind = moving == (weights[moving].sum() > weights[~moving].sum())
    index, weights, depths = index[kind], weights[kind], depths[kind]
    # The surface is where half of the weight is passed; what lies behind or before it does not move this point.
    order = np.argsort(depths)
    surface = depths[order][np.searchsorted(np.cumsum(weights[order]), 0.5 * weights.sum())]
    own = np.abs(depths / surface - 1) <= SURFACE_TOLERANCE
    index, weights, depths = index[own], weights[own], depths[own]
    point = camera.unproject(uv, np.average(depths, weights=weights))
    rows = frame.rows[index]
    return point, _strongest(gaussians, rows, weights, gaussians.presence(frame.t, torch.from_numpy(rows)).double().numpy())


def _strongest(gaussians: Gaussians4D, rows: np.ndarray, weights: np.ndarray, presence: np.ndarray) -> _Carriers:
    """Carriers from the weights and the presence that Gaussians have at a time."""
    best = np.argsort(-weights, kind="stable")[:MAX_CARRIERS]
    rows, weights, presence = rows[best], weights[best], presence[best]
    return _Carriers(rows, weights / np.maximum(presence, gaussians.config.p_min), float(weights.sum()))


# -- along the clip


def _carry_along(
    gaussians: Gaussians4D,
    cameras: Sequence[Camera],
    times: Sequence[float],
    order: list[int],
    starts: np.ndarray,
    carriers: dict[int, _Carriers],
    points: np.ndarray,
) -> None:
    """Fill ``points`` [Q, T, 3] from the frame of each query onwards, in the order of the frames that is given."""
    for here, there in pairwise(order):
        forward = there > here
        alive = [q for q in carriers if (starts[q] <= here if forward else starts[q] >= here)]
        apply_confidence_fade = [
            alive[k] for k in np.flatnonzero(_are_faded(gaussians, [carriers[q] for q in alive], times[there]))
        ]
        successors = _take_over(
            gaussians, cameras[here], times[here], times[there], apply_confidence_fade, carriers, points[:, here]
        )
        for q, successor in zip(apply_confidence_fade, successors, strict=True):
            if successor is None:
                del carriers[q]
            else:
                carriers[q] = successor
        alive = [q for q in alive if q in carriers]
        if alive:
            points[alive, there] = _step(gaussians, [carriers[q] for q in alive], points[alive, here], times[here], times[there])


def _are_faded(gaussians: Gaussians4D, carriers: list[_Carriers], t: float) -> np.ndarray:
    """Return [A] bool: less than ``HANDOVER_SHARE`` of the weight is left at time ``t``."""
    owner, rows = _flat(carriers)
    present = gaussians.presence(t, rows).double().numpy()
    weights = np.concatenate([[], *(each.weights for each in carriers)])
    left = np.bincount(owner, np.where(present >= gaussians.config.p_min, weights * present, 0), len(carriers))
    return left < HANDOVER_SHARE * np.array([each.promised for each in carriers])


def _flat(carriers: list[_Carriers]) -> tuple[np.ndarray, Tensor]:
    """For all carriers one after the other: whose they are [S], and their rows [S]."""
    owner = np.repeat(np.arange(len(carriers)), [len(each.rows) for each in carriers])
    return owner, torch.from_numpy(np.concatenate([np.zeros(0, np.int64), *(each.rows for each in carriers)]))


def _step(gaussians: Gaussians4D, carriers: list[_Carriers], points: np.ndarray, t: float, to: float) -> np.ndarray:
    """Return points [A, 3] at time ``t`` moved to time ``to``: the weighted mean of where their carriers bring them."""
    owner, rows = _flat(carriers)
    before, after = _place(gaussians, rows, t), _place(gaussians, rows, to)
    arm = (torch.from_numpy(points[owner]) - before.means)[..., None]
    moved = (after.means + (after.rotations @ before.rotations.transpose(1, 2) @ arm).squeeze(-1)).numpy()
    present = torch.where(after.presence >= gaussians.config.p_min, torch.minimum(before.presence, after.presence), 0.0)
    weights = np.concatenate([each.weights for each in carriers]) * present.numpy()
    total = np.bincount(owner, weights, len(carriers))
    return np.stack([np.bincount(owner, weights * moved[:, k], len(carriers)) / total for k in range(3)], 1)


@dataclass(frozen=True)
class _Placed:
    """Some Gaussians at a time, float64: ``means`` [N, 3], ``rotations`` [N, 3, 3], ``covars`` [N, 3, 3], ``presence`` [N]."""

    means: Tensor
    rotations: Tensor
    covars: Tensor
    presence: Tensor


def _place(gaussians: Gaussians4D, rows: Tensor, t: float) -> _Placed:
    params = {name: value[rows].double() for name, value in gaussians.params.items()}
    state = gaussians.motion.state(params, t)
    rest = gaussians.at_rest[rows]
    means = torch.where(rest[:, None], params["means"], state.means)
    presence = gaussians.presence(t, rows).double()
    shape = gaussians.motion.at_rest(params)
    if state.covars is not None and shape.covars is not None:  # which do not say how a Gaussian turned
        covars = torch.where(rest[:, None, None], shape.covars, state.covars)
        return _Placed(means, torch.eye(3, dtype=torch.float64).expand(len(rows), 3, 3), covars, presence)
    assert state.quats is not None
    assert state.scales is not None
    assert shape.quats is not None
    assert shape.scales is not None
    quats = torch.where(rest[:, None], shape.quats, state.quats)
    scales = torch.where(rest[:, None], shape.scales, state.scales)
    return _Placed(means, quats_to_rotations(quats), covariances(quats, scales), presence)


# -- handing over


def _take_over(
    gaussians: Gaussians4D,
    camera: Camera,
    t: float,
    to: float,
    apply_confidence_fade: list[int],
    carriers: dict[int, _Carriers],
    points: np.ndarray,
) -> Iterator[_Carriers | None]:
    """For every point in ``apply_confidence_fade`` those of the same kind that are present where it is, now and at the next
    time."""
    present = torch.minimum(gaussians.presence(t), gaussians.presence(to)) >= gaussians.config.p_min
    by_kind: dict[bool, list[int]] = defaultdict(list)
    for q in apply_confidence_fade:
        by_kind[bool(gaussians.dynamic[carriers[q].rows[0]])].append(q)
    found: dict[int, _Carriers] = {}
    for kind, members in by_kind.items():
        rows = torch.nonzero(present & (gaussians.dynamic == kind)).squeeze(1)
        if not len(rows):
            continue
        tree = cKDTree(_centers(gaussians, rows, t))
        distance, nearest = (part.reshape(len(members), -1) for part in tree.query(points[members], min(MAX_CARRIERS, len(rows))))
        depth = np.abs(camera.project(points[members])[1])
        near = rows.numpy()[nearest]
        weights, presence = _density(gaussians, near, points[members], t, depth / camera.K[0, 0])
        for k in np.flatnonzero(distance[:, 0] <= MAX_CARRIER_DISTANCE * depth):
            found[members[k]] = _strongest(gaussians, near[k], weights[k], presence[k])
    yield from (found.get(q) for q in apply_confidence_fade)


def _centers(gaussians: Gaussians4D, rows: Tensor, t: float) -> np.ndarray:
    """Return [N, 3] float32 means at a time."""
    params = {name: value[rows] for name, value in gaussians.params.items()}
    return torch.where(gaussians.at_rest[rows][:, None], params["means"], gaussians.motion.state(params, t).means).numpy()


def _density(
    gaussians: Gaussians4D, rows: np.ndarray, points: np.ndarray, t: float, pixels: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return how much each of some Gaussians (``rows`` [Q, K]) holds of points [Q, 3] at a time, and their presence: [Q, K] both.

    Args:
        pixels: [Q] the size of a pixel at each point.
    """
    flat = torch.from_numpy(rows.ravel())
    placed = _place(gaussians, flat, t)
    opacities = torch.sigmoid(gaussians.params["logit_opacities"][flat]).double() * placed.presence
    arm = torch.from_numpy(points).repeat_interleave(rows.shape[1], 0) - placed.means
    slack = torch.from_numpy(pixels).repeat_interleave(rows.shape[1])[:, None, None] ** 2
    # Discs on a surface are thin: a pixel of slack, or none of them would reach a point beside its plane.
    blurred = placed.covars + slack * torch.eye(3, dtype=torch.float64)
    squared = (arm * torch.linalg.solve(blurred, arm)).sum(1)
    inside = opacities * torch.exp(-0.5 * squared)
    beside = opacities / (arm.square().sum(1) + slack.flatten())
    reached = (squared.reshape(rows.shape) <= HANDOVER_SIGMAS**2).any(1, keepdim=True)
    weights = torch.where(reached, inside.reshape(rows.shape), beside.reshape(rows.shape))
    return weights.numpy(), placed.presence.reshape(rows.shape).numpy()


# -- visibility


def _is_seen(points: np.ndarray, camera: Camera, frame: _Frame) -> np.ndarray:
    """Return [Q] whether points [Q, 3] are in the image and at the depth of what is rendered at one of the nearest four pixels."""
    rendered = frame.rendered
    alpha = rendered.alpha.numpy()
    depth = np.where(alpha >= 0.5, rendered.depth.numpy() / np.maximum(alpha, 1e-6), np.inf)
    known = np.isfinite(points).all(1)
    uv, z = camera.project(np.where(known[:, None], points, 0))
    inside = known & (z > 0) & (uv >= 0).all(1) & (uv < [camera.width, camera.height]).all(1)
    seen = np.zeros(len(points), bool)
    corner = np.floor(np.where(inside[:, None], uv, 0) - 0.5).astype(int)
    for step in ((0, 0), (1, 0), (0, 1), (1, 1)):
        x, y = np.clip(corner + step, 0, [camera.width - 1, camera.height - 1]).T
        seen |= np.abs(z / depth[y, x] - 1) <= SURFACE_TOLERANCE
    return seen & inside
