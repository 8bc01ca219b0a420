"""The motion of any model as short Chebyshev series over the time in which a Gaussian is seen.

A Gaussian is drawn where p(t) >= p_min only, usually a small part of the clip. There the motion series of a model (up to 18
terms a coordinate) have an effective rank of about four. Interpolated at Chebyshev nodes of that interval they
need three or four coefficients, which are displacements in scene units: they round well, and the rest of them is zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from flowsplat.common.errors import InputError
from flowsplat.gaussians.gaussians4d import Gaussians4D
from flowsplat.geometry.rotations import normalize_quats, principal_axes

TIME_NODES = 12
"""Times at which the motion is looked at; the degree of a series stays below. Chosen by eye."""
MIN_LOG_PRECISION = math.log(1e-3)
"""Log precision below which p(t) is 1 everywhere in the clip, to within 0.001."""
_CHANGING = "A motion model whose Gaussians change their shape in time cannot be put into the player."
_WITHIN_TOLERANCE = 0.999
"""Share of the Gaussians whose series keep the tolerance. Chosen by eye."""


@dataclass(frozen=True)
class ChebyshevMotion:
    """M moving Gaussians over their visible intervals.

    Attributes:
        times: [M] center time of p(t).
        log_lambdas: [M] log of its precision.
        means: [M, D + 1, 3] Chebyshev coefficients of the mean on the interval of ``visible_interval``.
        quats: [M, E + 1, 4] likewise of the quaternion, which has about unit length.
        log_scales: [M, 3]
    """

    times: Tensor
    log_lambdas: Tensor
    means: Tensor
    quats: Tensor
    log_scales: Tensor


def visible_interval(times: Tensor, log_lambdas: Tensor, p_min: float) -> tuple[Tensor, Tensor]:
    """Return (middle [M], half length [M]) of the part of the clip, 0 to 1, in which p(t) >= p_min."""
    reach = torch.sqrt(-2 * math.log(p_min) * torch.exp(-log_lambdas))
    start, end = (times - reach).clamp(min=0), (times + reach).clamp(max=1)
    return (start + end) / 2, ((end - start) / 2).clamp(min=1e-6)


def find_seen_in_clip(gaussians: Gaussians4D) -> Tensor:
    """Return [N] bool: drawn at some time of the clip."""
    params = gaussians.params
    reach = torch.sqrt(-2 * math.log(gaussians.config.p_min) * torch.exp(-gaussians.motion.log_precision(params)))
    return gaussians.at_rest | ((params["times"] + reach > 0) & (params["times"] - reach < 1))


def fit_motion(
    gaussians: Gaussians4D, rows: Tensor, times: Tensor, log_lambdas: Tensor, mean_tolerance: float, quat_tolerance: float
) -> ChebyshevMotion:
    """Fit the series of the Gaussians ``rows`` [M].

    Args:
        gaussians: of any motion model.
        rows: which of them.
        times: [M] their center times as the reader of the series knows them (rounded).
        log_lambdas: [M] likewise.
        mean_tolerance: largest error of the mean, in the units of the model, for nearly all Gaussians.
        quat_tolerance: likewise of the unit quaternion.
    """
    params = {name: value[rows] for name, value in gaussians.params.items()}
    middle, half = visible_interval(times, log_lambdas, gaussians.config.p_min)
    nodes = torch.cos(math.pi * (torch.arange(TIME_NODES, dtype=torch.float64) + 0.5) / TIME_NODES)
    states = [gaussians.motion.state(params, middle + half * float(node)) for node in nodes]
    means = torch.stack([state.means for state in states], 1)
    if states[0].covars is not None:
        covars = torch.stack([state.covars for state in states if state.covars is not None], 1)
        if not torch.allclose(covars[:, :1].expand_as(covars), covars, rtol=1e-3, atol=1e-9):
            raise InputError(_CHANGING)
        quats, log_scales = principal_axes(covars[:, 0])
        quats = quats[:, None].expand(-1, TIME_NODES, -1)
    else:
        quats = torch.stack([normalize_quats(state.quats) for state in states if state.quats is not None], 1)
        scales = torch.stack([state.scales for state in states if state.scales is not None], 1)
        if not torch.allclose(scales[:, :1].expand_as(scales), scales, rtol=1e-3, atol=1e-9):
            raise InputError(_CHANGING)
        kept = gaussians.motion.log_scales(params)
        log_scales = torch.log(scales[:, 0]) if kept is None else kept
    # q and -q are one rotation, and the same one is to be stored for all that look alike. In time q is continuous: no node is
    # turned alone, for then a turn of more than half a circle would jump.
    reference = quats[:, TIME_NODES // 2]
    largest = torch.gather(reference, 1, reference.abs().argmax(1, keepdim=True))
    quats = quats * torch.where(largest < 0, -1.0, 1.0)[:, None]
    return ChebyshevMotion(times, log_lambdas, _fit(means, nodes, mean_tolerance), _fit(quats, nodes, quat_tolerance), log_scales)


def _fit(values: Tensor, nodes: Tensor, tolerance: float) -> Tensor:
    """Fit values [M, ``TIME_NODES``, C] to coefficients [M, degree + 1, C] of the lowest degree that keeps the tolerance."""
    degrees = torch.arange(TIME_NODES, dtype=torch.float64)
    basis = torch.cos(degrees[None] * torch.arccos(nodes)[:, None])  # [TIME_NODES, TIME_NODES], T_k at the nodes
    weights = basis * torch.where(degrees == 0, 1.0, 2.0) / TIME_NODES
    coefficients = torch.einsum("jk,mjc->mkc", weights.to(values), values)
    if not len(values):
        return coefficients[:, :1]
    for degree in range(TIME_NODES):
        error = (torch.einsum("jk,mkc->mjc", basis[:, : degree + 1].to(values), coefficients[:, : degree + 1]) - values).abs()
        worst = error.flatten(1).amax(1)
        if float(worst.kthvalue(max(math.ceil(_WITHIN_TOLERANCE * len(worst)), 1)).values) <= tolerance:
            break
    return coefficients[:, : degree + 1]
