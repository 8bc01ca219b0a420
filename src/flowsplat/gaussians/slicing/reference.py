"""The oracle of slicing, in plain torch (METHOD 1)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial

import torch
from torch import Tensor

from flowsplat.gaussians.gaussians4d import Active, Gaussians4D
from flowsplat.gaussians.slicing.api import Gradients, Slice
from flowsplat.splatting.harmonics import colours_from_harmonics


def time_gains(log_gains: Tensor, t: float) -> Tensor:
    """Brightness in time exp(sum_k g_k cos(pi k t)) [N] from [N, G]. Ours, background only (METHOD 1)."""
    cosines = [math.cos(math.pi * k * t) for k in range(1, log_gains.shape[1] + 1)]
    return torch.exp(log_gains @ log_gains.new_tensor(cosines))


def slice_gaussians(
    gaussians: Gaussians4D, active: Active, camera_center: Tensor, next_time: float | None, gradients: Gradients | None
) -> Slice:
    """See ``api.slice_gaussians``."""
    leaves = gaussians.gather(active)
    if gradients is not None:
        for name, leaf in leaves.items():
            leaf.requires_grad_().register_hook(partial(gradients.__setitem__, name))
    n, motion, config = active.num_static, gaussians.motion, gaussians.config
    moving = {name: value if name in gaussians.moving_names else value[n:] for name, value in leaves.items()}
    state = motion.state(moving, active.t)
    means = torch.cat([leaves["means"][:n], state.means])
    opacities = torch.sigmoid(leaves["logit_opacities"])
    opacities = torch.cat([opacities[:n], opacities[n:] * state.presence])
    directions = means.detach() - camera_center.to(means.device) if gaussians.sh_degree > 0 else None
    colours = colours_from_harmonics(leaves["sh"], directions, gaussians.sh_degree)
    if config.gains and n:
        colours = torch.cat([colours[:n] * time_gains(leaves["log_gains"], active.t)[:, None], colours[n:]])
    quats = scales = covars = next_means = next_quats = None
    if state.covars is not None:
        covars = state.covars if n == 0 else torch.cat([motion.state(_resting(leaves, n), 0.0).covars, state.covars])  # type: ignore[list-item]
    else:
        assert state.quats is not None
        quats = torch.cat([leaves["quats"][:n], state.quats])
        scales = torch.exp(leaves["log_scales"])
    if next_time is not None:
        later = motion.state(moving, next_time)
        next_means = torch.cat([leaves["means"][:n], later.means])
        if later.quats is not None:
            next_quats = torch.cat([leaves["quats"][:n], later.quats])
    return Slice(means, quats, scales, covars, opacities, colours, state.velocities, next_means, next_quats)


def _resting(leaves: Mapping[str, Tensor], n: int) -> dict[str, Tensor]:
    resting = {name: value[:n] for name, value in leaves.items() if name not in ("times", "log_gains")}
    return {**resting, "times": torch.zeros(n, device=leaves["means"].device)}
