"""Density control: pure functions from Gaussians and their statistics to new Gaussians and an index map
(docs/method/training.md)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from flowsplat.gaussians.gaussians4d import Gaussians4D, concatenate
from flowsplat.gaussians.motion import Shape
from flowsplat.geometry.rotations import quats_to_rotations
from flowsplat.splatting.rules import C0

SPLIT_SHRINKING = 1.6
"""How many times smaller the children of a split are, as in 3D Gaussian splatting."""


@dataclass
class DensityStatistics:
    """What training saw of every Gaussian since the last round, [N] float32 each.

    Attributes:
        gradient: sum of the norms of the gradient of one image's loss with respect to the 2D mean in normalized device
            coordinates (both losses count).
        visits: in how many images it was drawn.
        flow_residual: sum of |rendered - prior flow| in pixels where it was on the visible surface.
        flow_visits: how often that was.
        color_residual: sum of |rendered - true color|, 0 to 1, at the same times.
    """

    gradient: Tensor
    visits: Tensor
    flow_residual: Tensor
    flow_visits: Tensor
    color_residual: Tensor

    @staticmethod
    def zeros(count: int, device: torch.device | str = "cpu") -> DensityStatistics:
        """Return statistics of nothing seen yet."""
        return DensityStatistics(*(torch.zeros(count, device=device) for _ in range(5)))


@dataclass(frozen=True)
class DensityResult:
    """New Gaussians; row k comes from old row ``index[k]`` and has no optimizer history where ``is_new[k]``."""

    gaussians: Gaussians4D
    index: Tensor
    is_new: Tensor


def largest_scale(gaussians: Gaussians4D) -> Tensor:
    """Return [N] the largest spatial standard deviation."""
    shape = gaussians.motion.at_rest(gaussians.params)
    if shape.scales is not None:
        return shape.scales.amax(1)
    assert shape.covars is not None
    return torch.sqrt(torch.diagonal(shape.covars, dim1=1, dim2=2).amax(1))


@torch.no_grad()
def densify(
    gaussians: Gaussians4D,
    statistics: DensityStatistics,
    threshold: float,
    clone_below: float,
    cap: int,
    generator: torch.Generator,
) -> DensityResult:
    """Clone small Gaussians and split large ones where the mean gradient exceeds ``threshold``, as 3DGS does.

    Children inherit everything. A split samples two children from the Gaussian, in space and (where it fades within the clip)
    in time, re-expands their motion about the new center time and shrinks them by ``SPLIT_SHRINKING``.
    """
    count = len(gaussians)
    keep = torch.ones(count, dtype=torch.bool, device=gaussians.device)
    mean_gradient = statistics.gradient / statistics.visits.clamp(min=1)
    candidates = torch.nonzero(mean_gradient > threshold).squeeze(1)
    room = max(cap - count, 0)
    if len(candidates) > room:
        candidates = candidates[torch.sort(mean_gradient[candidates], descending=True, stable=True).indices[:room]]
        candidates = torch.sort(candidates).values
    small = largest_scale(gaussians)[candidates] < clone_below
    clones, parents = candidates[small], candidates[~small]
    keep[parents] = False
    survivors = torch.nonzero(keep).squeeze(1)
    children = [_split(gaussians.select(parents), generator) for _ in range(2)]
    merged = concatenate([gaussians.select(survivors), gaussians.select(clones), *children])
    index = torch.cat([survivors, clones, parents, parents])
    is_new = torch.ones(len(index), dtype=torch.bool, device=index.device)
    is_new[: len(survivors)] = False
    return DensityResult(merged, index, is_new)


def _split(parents: Gaussians4D, generator: torch.Generator) -> Gaussians4D:
    """Return one child of each parent; the random numbers are the host's, the same on every device."""
    count, params, device = len(parents), dict(parents.params), parents.device
    sigma_t = torch.exp(-0.5 * parents.motion.log_precision(params))
    in_time = ~parents.at_rest & parents.dynamic & (sigma_t <= 1)
    shift = torch.where(in_time, sigma_t * torch.randn(count, generator=generator).to(device), torch.zeros_like(sigma_t))
    params = parents.motion.recenter(params, shift)
    noise = torch.randn(count, 3, generator=generator).to(device)
    offset = _draw_points(parents.motion.at_rest(params), noise)
    params = parents.motion.shrunk(params, math.log(SPLIT_SHRINKING), in_time)
    params["means"] = params["means"] + offset
    if parents.has_slopes:  # a child is as bright as its parent was there
        brighter = (params["slopes"] * noise[:, :2]).sum(1, keepdim=True)
        params["sh"] = torch.cat([params["sh"][:, :1] + (brighter / C0)[:, None], params["sh"][:, 1:]], 1)
        params["slopes"] = params["slopes"] / SPLIT_SHRINKING
    return Gaussians4D(params, parents.dynamic, parents.config, parents.sh_degree, parents.object_ids, shared=parents.shared)


def _draw_points(shape: Shape, noise: Tensor) -> Tensor:
    """Return [N, 3] points of normal distributions about 0 with these shapes, from standard normal ones."""
    if shape.covars is not None:
        root = torch.linalg.cholesky(shape.covars + 1e-12 * torch.eye(3, device=noise.device))
        return (root @ noise[..., None])[..., 0]
    assert shape.quats is not None
    assert shape.scales is not None
    return (quats_to_rotations(shape.quats) @ (shape.scales * noise)[..., None])[..., 0]


@torch.no_grad()
def prune(gaussians: Gaussians4D, times: np.ndarray, min_opacity: float, max_scale: float) -> DensityResult:
    """Remove the transparent, the oversized (``max_scale`` 0 = none is) and those that no training time ever shows.

    Where none is, the result holds ``gaussians`` themselves.

    Args:
        times: [T] clip times of the training frames, rising.
    """
    keep = torch.sigmoid(gaussians.params["logit_opacities"]) >= min_opacity
    if max_scale > 0:
        keep &= largest_scale(gaussians) <= max_scale
    keep &= gaussians.at_rest | (_best_presence(gaussians, times) >= gaussians.config.p_min)
    for value in gaussians.params.values():
        keep &= torch.isfinite(value.reshape(len(value), -1)).all(1)
    index = torch.nonzero(keep).squeeze(1)
    # Most rounds remove none, and what is kept beside Gaussians is several times as large as they are.
    kept = gaussians if len(index) == len(gaussians) else gaussians.select(index)
    return DensityResult(kept, index, torch.zeros(len(index), dtype=torch.bool, device=index.device))


def _best_presence(gaussians: Gaussians4D, times: np.ndarray) -> Tensor:
    """Return [N] p at the training time nearest to each Gaussian's center time."""
    sorted_times = torch.as_tensor(times, dtype=torch.float32, device=gaussians.device)
    center = gaussians.params["times"].contiguous()
    after = torch.searchsorted(sorted_times, center).clamp(max=len(sorted_times) - 1)
    before = (after - 1).clamp(min=0)
    distance = torch.minimum((sorted_times[after] - center).abs(), (sorted_times[before] - center).abs())
    return torch.exp(-0.5 * torch.exp(gaussians.motion.log_precision(gaussians.params)) * distance**2)


@torch.no_grad()
def reset_opacities(gaussians: Gaussians4D, opacity: float) -> None:
    """Bring every opacity down to at most ``opacity``, in place."""
    limit = math.log(opacity / (1 - opacity))
    gaussians.params["logit_opacities"].clamp_(max=limit)


@torch.no_grad()
def revise_dynamic(
    gaussians: Gaussians4D,
    statistics: DensityStatistics,
    moving_residual: float,
    moving_color: float,
    resting_pixels: float,
    focal: float,
    log_lambda: float,
) -> tuple[int, int]:
    """Let background that moves become dynamic and dynamic Gaussians that rest become background, in place. Ours.

    Args:
        moving_residual: background whose flow residual stays above this many pixels, over at least two visits, is dynamic from
            now on, about the time of the frame that it was made from, if its color is wrong, too:
        moving_color: from this mean difference on, 0 to 1. Where nothing is to be seen flow is a guess.
        resting_pixels: dynamic Gaussians that would move less than this many pixels over the whole clip, and explain the flow
            where they are seen, are background.
        focal: pixels, to tell the size of motion at the median depth.
        log_lambda: temporal precision of the newly dynamic.

    Returns:
        how many became dynamic, how many came to rest.
    """
    visited = statistics.flow_visits >= 2
    residual = statistics.flow_residual / statistics.flow_visits.clamp(min=1)
    color = statistics.color_residual / statistics.flow_visits.clamp(min=1)
    to_dynamic = ~gaussians.dynamic & visited & (residual > moving_residual) & (color >= moving_color)
    speed = torch.zeros(len(gaussians), device=gaussians.device)
    rows = torch.nonzero(gaussians.dynamic).squeeze(1)
    if len(rows):
        chosen = gaussians.select(rows)
        sigma = torch.exp(-0.5 * chosen.motion.log_precision(chosen.params))
        times = chosen.params["times"]
        center, side = (chosen.motion.state(chosen.params, t) for t in (times, times + sigma))
        later = times + sigma - times  # what is left of sigma beside a time
        traveled = torch.maximum((side.means - center.means).norm(dim=1) / later.clamp(min=1e-6), center.velocities.norm(dim=1))
        speed[rows] = focal * traveled
    to_rest = gaussians.dynamic & visited & (speed < resting_pixels) & (residual < 0.5 * moving_residual)
    moved = torch.nonzero(to_dynamic).squeeze(1)
    if len(moved):
        chosen = gaussians.select(moved)
        for name, value in chosen.motion.with_precision(chosen.params, log_lambda).items():
            gaussians.params[name][moved] = value
    gaussians.dynamic[to_dynamic] = True
    gaussians.dynamic[to_rest] = False
    return len(moved), int(to_rest.sum())
