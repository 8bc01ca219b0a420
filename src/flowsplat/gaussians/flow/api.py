"""Blend color, depth and flow into one image; the one place that picks the backend."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from flowsplat.common import devices
from flowsplat.common.devices import Kernels
from flowsplat.gaussians.flow.reference import FlowModel, flow_features
from flowsplat.gaussians.slicing import Slice
from flowsplat.geometry import Camera
from flowsplat.splatting import Projected


@dataclass(frozen=True)
class FlowView:
    """Where flow goes to.

    Attributes:
        model: how it is splatted.
        camera: of the other frame, in the coordinates of the Gaussians.
        dt: time to the other frame, in clip units.
    """

    model: FlowModel
    camera: Camera
    dt: float


class FlowKernels(Protocol):
    """What each of the twins has."""

    def blend_displacement(self, sliced: Slice, projected: Projected, other: Camera) -> Tensor:
        """Let flow go to the Gaussians' ``next_means`` in the ``other`` camera."""

    def blend_affine(self, sliced: Slice, projected: Projected, camera: Camera, other: Camera) -> Tensor:
        """From the Gaussians in ``camera`` to where they are next in the ``other`` one."""


def _twin(kernels: Kernels) -> FlowKernels:
    """Pick the backend that computes it, imported only where that is needed."""
    if kernels == "cpu":
        from flowsplat.gaussians.flow import cpu

        return cpu
    from flowsplat.gaussians.flow import triton

    return triton


def blend_features(sliced: Slice, projected: Projected, camera: Camera, flow: FlowView | None) -> Tensor:
    """Return features [A, C] of the Gaussians: color, depth, 2 or 6 of flow, and 1 where the other camera does not see the
    Gaussian.

    On the CPU the last one exists only if a Gaussian that is drawn lies behind the other camera; on a GPU it always does,
    because the host would have to wait to learn that.
    """
    if flow is None:
        return torch.cat([sliced.colors, projected.depths[:, None]], 1)
    dtype, device = sliced.means.dtype, sliced.means.device
    kernels = devices.kernels_for(sliced.means)
    if kernels != "reference" and (flow.model == "displacement" or (flow.model == "affine" and sliced.covars is None)):
        twin = _twin(kernels)
        if flow.model == "displacement":
            return twin.blend_displacement(sliced, projected, flow.camera)
        return twin.blend_affine(sliced, projected, camera, flow.camera)
    views = *camera.tensors(dtype, device), *flow.camera.tensors(dtype, device)
    features, front = flow_features(flow.model, sliced, projected, flow.dt, *views, camera.width, camera.height)
    parts = [sliced.colors, projected.depths[:, None], features]
    if device.type != "cpu" or not bool((front | ~projected.visible).all()):
        parts.append((~front).to(dtype)[:, None])
    return torch.cat(parts, 1)
