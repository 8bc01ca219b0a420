"""Render 4D Gaussians from a camera at a time: colour, alpha, depth and flow in one rasterization."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from flowsplat.gaussians.flow import FlowModel, flow_channels, flow_features, flow_image
from flowsplat.gaussians.gaussians4d import NEAR_PLANE, Active, Gaussians4D
from flowsplat.gaussians.slicing import Slice, slice_gaussians
from flowsplat.geometry import Camera
from flowsplat.splatting import Projected, blend, project
from flowsplat.splatting.api import BackendName


@dataclass(frozen=True)
class RenderedFrame:
    """Differentiable pictures of one frame, premultiplied by alpha, in the normalised coordinates of the model.

    Attributes:
        colour: [H, W, 3]
        alpha: [H, W]
        depth: [H, W]
        flow: [H, W, 2], or None.
        unseen: [H, W] how much of a pixel is held by Gaussians behind the other camera; None where there are none.
        sliced: the Gaussians.
        projected: their projection.
    """

    colour: Tensor
    alpha: Tensor
    depth: Tensor
    flow: Tensor | None
    unseen: Tensor | None
    sliced: Slice
    projected: Projected


def render_leaves(
    leaves: Mapping[str, Tensor],
    active: Active,
    gaussians: Gaussians4D,
    camera: Camera,
    *,
    flow_to: tuple[Camera, float] | None = None,
    flow_model: FlowModel = "displacement",
    backend: BackendName = "auto",
) -> RenderedFrame:
    """Render gathered parameters, differentiable in them.

    Args:
        leaves: from ``Gaussians4D.gather``.
        active: the same that it was gathered for.
        gaussians: for its configuration and harmonics degree.
        camera: in normalised coordinates.
        flow_to: the other camera and clip time that flow goes to.
        flow_model: METHOD 3.
        backend: of the rasterizer.
    """
    dtype = leaves["means"].dtype
    viewmat, K = camera.tensors(dtype)
    center = torch.as_tensor(camera.center, dtype=dtype)
    next_time = flow_to[1] if flow_to is not None else None
    sliced = slice_gaussians(leaves, active, gaussians.config, gaussians.sh_degree, center, next_time)
    width, height = camera.width, camera.height
    projected = project(
        sliced.means, sliced.quats, sliced.scales, sliced.opacities, viewmat, K, width, height, covars=sliced.covars,
        near_plane=NEAR_PLANE, backend=backend,
    )  # fmt: skip
    features = [sliced.colours, projected.depths[:, None]]
    hidden = None
    if flow_to is not None:
        other = flow_to[0].tensors(dtype)
        flow, front = flow_features(
            flow_model, sliced, projected, flow_to[1] - active.t, viewmat, K, *other, width, height
        )
        features.append(flow)
        if not bool((front | ~projected.visible).all()):
            hidden = (~front).to(dtype)[:, None]
            features.append(hidden)
    image, alpha = blend(projected, sliced.opacities, torch.cat(features, 1), width, height)
    end = 4 + (flow_channels(flow_model) if flow_to is not None else 0)
    return RenderedFrame(
        colour=image[..., :3],
        alpha=alpha,
        depth=image[..., 3],
        flow=flow_image(image[..., 4:end]) if flow_to is not None else None,
        unseen=image[..., end] if hidden is not None else None,
        sliced=sliced,
        projected=projected,
    )


@torch.no_grad()
def render(
    gaussians: Gaussians4D,
    camera: Camera,
    t: float,
    *,
    flow_to: tuple[Camera, float] | None = None,
    flow_model: FlowModel = "displacement",
    backend: BackendName = "auto",
) -> RenderedFrame:
    """Render the Gaussians at clip time ``t``, without gradients; camera in normalised coordinates."""
    active = gaussians.active(t, camera)
    leaves = gaussians.gather(active)
    return render_leaves(leaves, active, gaussians, camera, flow_to=flow_to, flow_model=flow_model, backend=backend)


def fill_uncovered(colour: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Give uncovered pixels the colour of their nearest covered neighbours, by push-pull over a pyramid. Ours.

    Borders that no training frame saw would be black otherwise (1.6 dB on a panning clip). The filling is ramped in where
    transmittance is between 0.3 and 0.7, so that covered areas do not get brighter (METHOD 7).

    Args:
        colour: [H, W, 3] float32 premultiplied.
        alpha: [H, W] float32.
    """
    transmittance = 1 - alpha
    if transmittance.max() < 0.3:
        return colour
    levels = [(colour, alpha)]
    while max(levels[-1][1].shape) > 1:
        c, a = levels[-1]
        size = (max(a.shape[1] // 2, 1), max(a.shape[0] // 2, 1))
        levels.append((cv2.resize(c, size, interpolation=cv2.INTER_AREA), cv2.resize(a, size, interpolation=cv2.INTER_AREA)))
    c, a = levels[-1]
    filled = c / np.maximum(a, 1e-6)[..., None]
    for c, a in levels[-2::-1]:
        upsampled = cv2.resize(filled, a.shape[::-1], interpolation=cv2.INTER_LINEAR)
        filled = c + (1 - np.clip(a, 0, 1))[..., None] * upsampled
    ramp = np.clip((transmittance - 0.3) / 0.4, 0, 1) * transmittance
    return colour + ramp[..., None] * filled
