"""The cull, and the one place that picks who computes it."""

from __future__ import annotations

import math
from typing import Protocol

from torch import Tensor

from flowsplat.common import devices
from flowsplat.common.devices import Kernels, Later
from flowsplat.gaussians.culling.capacity import RowCapacity
from flowsplat.gaussians.culling.reference import REACH
from flowsplat.geometry import Camera
from flowsplat.splatting.rules import EPS2D


def border(eps2d: float) -> int:
    """Pixels by which the camera of a cull must be wider (``Camera.widen``) where the rasterizer blurs by ``eps2d``.

    The cull itself reckons with the usual blur, and a stronger one reaches farther into the image.
    """
    return max(math.ceil(REACH * (math.sqrt(eps2d) - math.sqrt(EPS2D))), 0)


class CullKernels(Protocol):
    """What each of the twins has."""

    def active_rows(
        self, at_rest: Tensor, means: Tensor, log_scales: Tensor | None, times: Tensor, log_lambdas: Tensor, t: float, p_min: float,
        camera: Camera | None, near: float,
    ) -> tuple[Tensor, int]:  # fmt: skip
        """As below."""


def _twin(kernels: Kernels) -> CullKernels:
    """Who computes it, imported only where that is needed."""
    if kernels == "cpu":
        from flowsplat.gaussians.culling import cpu

        return cpu
    if kernels == "triton":
        from flowsplat.gaussians.culling import triton

        return triton
    from flowsplat.gaussians.culling import reference

    return reference


def active_rows(
    at_rest: Tensor,
    means: Tensor,
    log_scales: Tensor | None,
    times: Tensor,
    log_lambdas: Tensor,
    t: float,
    p_min: float,
    camera: Camera | None,
    near: float,
) -> tuple[Tensor, int]:
    """Rows of the Gaussians to render at ``t``, those at rest first, each kind in order; and how many of them rest.

    Gaussians at rest are culled against the camera, never one that it could show; moving ones by presence alone.

    Args:
        at_rest: [N] bool.
        means: [N, 3]
        log_scales: [N, 3]; None = the camera culls nothing.
        times: [N]
        log_lambdas: [N]
        t: clip time.
        p_min: moving Gaussians below this presence are not rendered.
        camera: who looks; None = all at rest are seen.
        near: planar depth below which nothing is rendered.

    Returns:
        rows [A] int64 on the device of the Gaussians, and the number of those at rest. The host waits for a GPU to count them.
    """
    kernels = devices.kernels_for(means)
    if kernels == "reference" and means.device.type == "cpu":
        kernels = "cpu"  # which culls in any float type
    return _twin(kernels).active_rows(at_rest, means, log_scales, times, log_lambdas, t, p_min, camera, near)


def pad_active_rows(
    at_rest: Tensor,
    means: Tensor,
    log_scales: Tensor | None,
    times: Tensor,
    log_lambdas: Tensor,
    t: float,
    p_min: float,
    camera: Camera | None,
    near: float,
    capacity: RowCapacity,
) -> tuple[Tensor, Later]:
    """As ``active_rows`` by the Triton kernels, without waiting for them: in as many rows as ``capacity`` says.

    Returns:
        rows [A] int64, those at rest from the first one, moving ones from ``capacity.at_rest``; -1 = padding. Those for
        which there is no row are left out. And how many at rest and moving there are.
    """
    from flowsplat.gaussians.culling import triton

    return triton.pad_active_rows(at_rest, means, log_scales, times, log_lambdas, t, p_min, camera, near, capacity)
