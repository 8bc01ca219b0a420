"""The oracle of slicing, in plain torch (docs/method/representation.md)."""

from __future__ import annotations

import math
from functools import partial

import torch
from torch import Tensor

from flowsplat.gaussians.gaussians4d import Active, Gaussians4D
from flowsplat.gaussians.motion import SharedMotion
from flowsplat.gaussians.slicing.api import Gradients, Slice
from flowsplat.splatting.harmonics import colors_from_harmonics


def time_gains(log_gains: Tensor, t: float) -> Tensor:
    """Brightness in time exp(sum_k g_k cos(pi k t)) [N] from [N, G]. Ours, background only (docs/method/representation.md)."""
    cosines = [math.cos(math.pi * k * t) for k in range(1, log_gains.shape[1] + 1)]
    return torch.exp(log_gains @ log_gains.new_tensor(cosines))


def slice_gaussians(
    gaussians: Gaussians4D, active: Active, camera_center: Tensor, next_time: float | None, gradients: Gradients | None
) -> Slice:
    """See ``api.slice_gaussians``."""
    leaves = {name: leaf for name, leaf in gaussians.gather(active).items() if name != "slopes"}  # of ``api``
    if gradients is not None:
        for name, leaf in leaves.items():
            leaf.requires_grad_().register_hook(partial(gradients.__setitem__, name))
    n, motion, config = active.num_static, gaussians.motion, gaussians.config
    if isinstance(motion, SharedMotion) and gradients is not None:
        shared = {name: value.detach().requires_grad_() for name, value in gaussians.shared.items()}
        for name, leaf in shared.items():
            leaf.register_hook(partial(gradients.__setitem__, name))
        motion = motion.bind(shared)
    moving = {name: value if name in gaussians.moving_names else value[n:] for name, value in leaves.items()}
    state = motion.state(moving, active.t)
    shape = motion.at_rest({name: value[:n] for name, value in leaves.items() if name not in gaussians.moving_names})
    means = torch.cat([leaves["means"][:n], state.means])
    opacities = torch.sigmoid(leaves["logit_opacities"])
    opacities = torch.cat([opacities[:n], opacities[n:] * state.presence])
    directions = means.detach() - camera_center.to(means.device) if gaussians.sh_degree > 0 else None
    colors = colors_from_harmonics(leaves["sh"], directions, gaussians.sh_degree)
    if config.gains and n:
        colors = torch.cat([colors[:n] * time_gains(leaves["log_gains"], active.t)[:, None], colors[n:]])
    quats = scales = covars = next_means = next_quats = None
    if state.covars is not None:
        covars = _together(shape.covars, state.covars)
    else:
        quats, scales = _together(shape.quats, state.quats), _together(shape.scales, state.scales)
    if next_time is not None:
        later = motion.state(moving, next_time)
        next_means = torch.cat([leaves["means"][:n], later.means])
        if later.quats is not None:
            next_quats = _together(shape.quats, later.quats)
    return Slice(means, quats, scales, covars, opacities, colors, state.velocities, next_means, next_quats)


def _together(resting: Tensor | None, moving: Tensor | None) -> Tensor:
    """Return one tensor of those at rest and those that move."""
    assert resting is not None
    assert moving is not None
    return torch.cat([resting, moving])
