"""Slopes in the image in plain torch: the oracle of ``cpu`` and ``triton``."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from flowsplat.gaussians.slicing import Slice
from flowsplat.geometry import Camera
from flowsplat.geometry.projection import world_jacobian
from flowsplat.geometry.rotations import quats_to_rotations
from flowsplat.splatting import Projected
from flowsplat.splatting.rules import FOOTPRINT_NEAR_PLANE


def image_slopes(sliced: Slice, projected: Projected, camera: Camera) -> Tensor:
    """See ``api.image_slopes``.

    Raises:
        ValueError: the Gaussians have general covariances, which have no axes of their own.
    """
    if sliced.quats is None or sliced.scales is None or sliced.slopes is None:
        raise ValueError("only Gaussians with quats, scales and slopes have slopes in the image")
    view = camera.tensors(sliced.means.dtype, sliced.means.device)
    shape = sliced.means.detach(), sliced.quats.detach(), sliced.scales.detach()
    constant = replace(projected, conics=projected.conics.detach())
    return project_slopes(sliced.slopes, constant, *shape, *view, camera.width, camera.height)


def project_slopes(
    slopes: Tensor, projected: Projected, means: Tensor, quats: Tensor, scales: Tensor, viewmat: Tensor, K: Tensor, width: int,
    height: int,
) -> Tensor:  # fmt: skip
    """Return the same with the camera as tensors: viewmat [4, 4] and K [3, 3].

    An offset d in the image is most likely the offset u = (J R S)^T C d in units of the Gaussian's standard deviations, with C the
    conic, blur included. A slope a along the first two axes is then C (J R S)_12 a in the image.
    """
    J = world_jacobian(means, viewmat, K, width, height, FOOTPRINT_NEAR_PLANE)
    footprint = J @ (quats_to_rotations(quats) * scales[:, None])
    along = (footprint[:, :, :2] * slopes[:, None]).sum(-1)
    a, b, c = projected.conics.unbind(-1)
    found = torch.stack([a * along[:, 0] + b * along[:, 1], b * along[:, 0] + c * along[:, 1]], -1)
    return torch.where(projected.visible[:, None], found, torch.zeros_like(found))
