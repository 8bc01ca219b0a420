"""What a slice is, and the one place that picks who computes it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from flowsplat.gaussians.gaussians4d import Active, ModelConfig
from flowsplat.gaussians.motion import SeriesMotion


@dataclass(frozen=True)
class Slice:
    """Active Gaussians at a time (A in all, the last M of them moving).

    Attributes:
        means: [A, 3]
        quats: [A, 4] not normalised, or None with ``covars``.
        scales: [A, 3], or None with ``covars``.
        covars: [A, 3, 3] of a model with general covariances, else None.
        opacities: [A], presence included.
        colours: [A, 3] as seen from the camera, >= 0.
        velocities: [M, 3] of the moving ones, per clip length.
        next_means: [A, 3] at the other time; None if none was asked for.
        next_quats: [A, 4] likewise.
    """

    means: Tensor
    quats: Tensor | None
    scales: Tensor | None
    covars: Tensor | None
    opacities: Tensor
    colours: Tensor
    velocities: Tensor
    next_means: Tensor | None
    next_quats: Tensor | None


def slice_gaussians(
    leaves: Mapping[str, Tensor],
    active: Active,
    config: ModelConfig,
    sh_degree: int,
    camera_center: Tensor,
    next_time: float | None = None,
) -> Slice:
    """Evaluate gathered parameters at ``active.t``.

    Args:
        leaves: what ``Gaussians4D.gather`` gave.
        active: which Gaussians and when.
        config: the model.
        sh_degree: harmonics in use.
        camera_center: [3], for the direction of the harmonics.
        next_time: the other time of a flow pair.
    """
    from flowsplat.gaussians.slicing import cpu, reference

    means = leaves["means"]
    fits = means.device.type == "cpu" and means.dtype == torch.float32 and isinstance(config.motion(), SeriesMotion)
    module = cpu if fits else reference
    return module.slice_gaussians(leaves, active, config, sh_degree, camera_center, next_time)
