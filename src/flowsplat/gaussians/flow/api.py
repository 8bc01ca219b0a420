"""What is blended into one picture: colour, depth and flow; and the one place that picks who computes it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

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


def blend_features(sliced: Slice, projected: Projected, camera: Camera, flow: FlowView | None) -> Tensor:
    """Features [A, C] of the Gaussians: colour, depth, 2 or 6 of flow, and 1 where the other camera does not see the Gaussian.

    The last one exists only if a Gaussian that is drawn lies behind the other camera.
    """
    if flow is None:
        return torch.cat([sliced.colours, projected.depths[:, None]], 1)
    dtype = sliced.means.dtype
    if sliced.means.device.type == "cpu" and dtype == torch.float32:
        from flowsplat.gaussians.flow import cpu

        if flow.model == "displacement":
            return cpu.blend_displacement(sliced, projected, flow.camera)
        if flow.model == "affine" and sliced.covars is None:
            return cpu.blend_affine(sliced, projected, camera, flow.camera)
    features, front = flow_features(
        flow.model, sliced, projected, flow.dt, *camera.tensors(dtype), *flow.camera.tensors(dtype), camera.width, camera.height
    )
    parts = [sliced.colours, projected.depths[:, None], features]
    if not bool((front | ~projected.visible).all()):
        parts.append((~front).to(dtype)[:, None])
    return torch.cat(parts, 1)
