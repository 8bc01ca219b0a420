"""Slice 4D Gaussians at a time; the one place that picks the backend."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import torch
from torch import Tensor

from flowsplat.common.devices import Kernels
from flowsplat.gaussians.gaussians4d import Active, Gaussians4D
from flowsplat.geometry.rotations import normalize_quats, principal_axes

Gradients = dict[str, Tensor]
"""By parameter, the gradient of the rows that ``Gaussians4D.rows_of`` names."""

NAMES = (
    "means", "logit_opacities", "sh", "log_gains", "quats", "log_scales", "times", "log_lambdas",
    "mean_poly", "mean_cos", "mean_sin", "quat_poly", "quat_cos", "quat_sin",
)  # fmt: skip
"""Parameters of a series motion, in the order in which its kernels take them."""


@dataclass(frozen=True)
class Slice:
    """Active Gaussians at a time (A in all, the last M of them moving).

    Attributes:
        means: [A, 3]
        quats: [A, 4] not normalized, or None with ``covars``.
        scales: [A, 3], or None with ``covars``.
        covars: [A, 3, 3] of a model with general covariances, else None.
        opacities: [A], presence included.
        colors: [A, 3] as seen from the camera, >= 0.
        velocities: [M, 3] of the moving ones, per clip length.
        next_means: [A, 3] at the other time; None if none was asked for.
        next_quats: [A, 4] likewise.
        slopes: [A, 2] by how much each gets brighter along its first two axes, a standard deviation; None = not at all.
    """

    means: Tensor
    quats: Tensor | None
    scales: Tensor | None
    covars: Tensor | None
    opacities: Tensor
    colors: Tensor
    velocities: Tensor
    next_means: Tensor | None
    next_quats: Tensor | None
    slopes: Tensor | None = None

    def decompose(self) -> tuple[Tensor, Tensor]:
        """Return unit quaternions [A, 4] and logarithms of scales [A, 3], of general covariances their principal axes."""
        if self.covars is not None:
            return principal_axes(self.covars)
        assert self.quats is not None
        assert self.scales is not None
        return normalize_quats(self.quats), torch.log(self.scales)


class SliceKernels(Protocol):
    """What each of the twins has."""

    def slice_gaussians(
        self, gaussians: Gaussians4D, active: Active, camera_center: Tensor, next_time: float | None, gradients: Gradients | None
    ) -> Slice:
        """As below."""


def _twin(kernels: Kernels) -> SliceKernels:
    """Pick the backend that computes it, imported only where that is needed."""
    if kernels == "cpu":
        from flowsplat.gaussians.slicing import cpu

        return cpu
    if kernels == "triton":
        from flowsplat.gaussians.slicing import triton

        return triton
    from flowsplat.gaussians.slicing import reference

    return reference


def slice_gaussians(
    gaussians: Gaussians4D,
    active: Active,
    camera_center: Tensor,
    next_time: float | None = None,
    gradients: Gradients | None = None,
) -> Slice:
    """Evaluate the active Gaussians at ``active.t``.

    The rows are read where they lie: parameters are far larger than what one frame shows, so neither copies of them nor
    gradients in their full size are ever made.

    Args:
        gaussians: the model.
        active: which Gaussians and when.
        camera_center: [3], for the direction of the harmonics; on the CPU the device need not be waited for.
        next_time: the other time of a flow pair.
        gradients: where the gradients of the parameters go in the backward pass (a parameter that nothing depends on may be
            missing then); None = the slice is not differentiable.
    """
    sliced = _twin(gaussians.sliced_by).slice_gaussians(gaussians, active, camera_center, next_time, gradients)
    if not gaussians.has_slopes:
        return sliced
    slopes = gaussians.params["slopes"][active.rows]
    if gradients is not None:
        slopes.requires_grad_().register_hook(partial(gradients.__setitem__, "slopes"))
    return replace(sliced, slopes=slopes)
