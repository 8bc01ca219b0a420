"""The flow models in plain torch (docs/method/flow.md, "Flow splatting"); for the displacement the oracle of ``cpu``."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from flowsplat.gaussians.slicing import Slice
from flowsplat.geometry.projection import project_points, world_jacobian
from flowsplat.geometry.rotations import covariances, quats_to_rotations
from flowsplat.splatting import Projected
from flowsplat.splatting.rules import EPS2D, FOOTPRINT_NEAR_PLANE

FlowModel = Literal["mean", "displacement", "affine"]

FLOW_NEAR_PLANE = FOOTPRINT_NEAR_PLANE
"""Planar depth (median depth = 1) below which a Gaussian is behind or grazing the other camera and contributes no flow."""


def flow_channels(model: FlowModel) -> int:
    """Return how many channels the model blends."""
    return 6 if model == "affine" else 2


def flow_features(
    model: FlowModel,
    sliced: Slice,
    projected: Projected,
    dt: float,
    viewmat: Tensor,
    K: Tensor,
    next_viewmat: Tensor,
    next_K: Tensor,
    width: int,
    height: int,
) -> tuple[Tensor, Tensor]:
    """Return features [A, 2 or 6] whose blending gives the flow over a pair, and [A] bool: in front of the other camera.

    Args:
        model: ``mean``, the paper's, from the velocity (*Repairs:* through the Jacobian, times dt); ``displacement``, exact for
            the center; ``affine``, ours, with the rotation inside each Gaussian.
        sliced: the Gaussians, with ``next_means`` (and ``next_quats`` for affine).
        projected: their projection into the first camera.
        dt: time from the first to the second frame, in clip units.
        viewmat: [4, 4] of the first camera.
        K: [3, 3] of the first camera.
        next_viewmat: [4, 4] of the second camera.
        next_K: [3, 3] of the second camera.
        width: of the image.
        height: of the image.
    """
    if model == "mean":
        uv, depth = project_points(sliced.means, next_viewmat, next_K, FLOW_NEAR_PLANE)
        # Only moving Gaussians have a velocity; they come last.
        moving = sliced.means[len(sliced.means) - len(sliced.velocities) :]
        jacobian = world_jacobian(moving, next_viewmat, next_K, width, height, FLOW_NEAR_PLANE)
        own = dt * (jacobian @ sliced.velocities[..., None])[..., 0]
        flow = uv - projected.means2d
        flow = torch.cat([flow[: len(flow) - len(own)], flow[len(flow) - len(own) :] + own])
    else:
        assert sliced.next_means is not None
        uv, depth = project_points(sliced.next_means, next_viewmat, next_K, FLOW_NEAR_PLANE)
        flow = uv - projected.means2d
    front = depth > FLOW_NEAR_PLANE
    flow = torch.where(front[:, None], flow, torch.zeros_like(flow))
    if model != "affine":
        return flow, front
    B = affine_gradient(sliced, viewmat, K, next_viewmat, next_K, width, height)
    B = torch.where(front[:, None, None], B, torch.zeros_like(B))
    center = projected.means2d - flow.new_tensor([width / 2, height / 2])
    offset = flow - (B @ center[..., None])[..., 0]
    return torch.cat([offset, B.flatten(1)], 1), front


def affine_gradient(
    sliced: Slice, viewmat: Tensor, K: Tensor, next_viewmat: Tensor, next_K: Tensor, width: int, height: int
) -> Tensor:
    """B = (J_j M - J_i) G [A, 2, 2]: how the flow varies inside each Gaussian (docs/method/flow.md, "Affine flow", ours).

    G maps an offset in the image to the most likely offset in the Gaussian, under the blur that the rasterizer draws with.
    """
    assert sliced.next_means is not None
    J_i = world_jacobian(sliced.means, viewmat, K, width, height, FLOW_NEAR_PLANE)
    J_j = world_jacobian(sliced.next_means, next_viewmat, next_K, width, height, FLOW_NEAR_PLANE)
    if sliced.covars is not None:
        sigma, J_moved = sliced.covars, J_j
    else:
        assert sliced.quats is not None
        assert sliced.scales is not None
        assert sliced.next_quats is not None
        sigma = covariances(sliced.quats, sliced.scales)
        M = quats_to_rotations(sliced.next_quats) @ quats_to_rotations(sliced.quats).transpose(1, 2)
        J_moved = J_j @ M
    blurred = J_i @ sigma @ J_i.transpose(1, 2) + EPS2D * torch.eye(2, dtype=sigma.dtype, device=sigma.device)
    G = sigma @ J_i.transpose(1, 2) @ _inverse_2x2(blurred)
    return (J_moved - J_i) @ G


def _inverse_2x2(m: Tensor) -> Tensor:
    a, b, c, d = m[..., 0, 0], m[..., 0, 1], m[..., 1, 0], m[..., 1, 1]
    adjugate = torch.stack([torch.stack([d, -b], -1), torch.stack([-c, a], -1)], -2)
    return adjugate / (a * d - b * c)[..., None, None]


def flow_image(blended: Tensor) -> Tensor:
    """Blended features [H, W, 2 or 6] to flow [H, W, 2] in pixels, still premultiplied by alpha."""
    if blended.shape[-1] == 2:
        return blended
    height, width = blended.shape[:2]
    y, x = torch.meshgrid(
        torch.arange(height, dtype=blended.dtype, device=blended.device) + 0.5 - height / 2,
        torch.arange(width, dtype=blended.dtype, device=blended.device) + 0.5 - width / 2,
        indexing="ij",
    )
    u = blended[..., 0] + blended[..., 2] * x + blended[..., 3] * y
    v = blended[..., 1] + blended[..., 4] * x + blended[..., 5] * y
    return torch.stack([u, v], -1)
