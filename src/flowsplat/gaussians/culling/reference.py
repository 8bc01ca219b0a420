"""The oracle of the cull, in plain torch."""

from __future__ import annotations

import torch
from torch import Tensor

from flowsplat.gaussians.motion import presence
from flowsplat.geometry import Camera
from flowsplat.splatting.rules import TANGENT_MARGIN

CULL_SIGMAS = 3.34
"""More sigmas than the rasterizer ever draws: sqrt(-2 ln ``ALPHA_MIN``) = 3.33."""
BLUR_SIGMA = 0.55
"""More than the standard deviation of the rasterizer's blur in pixels, sqrt(``EPS2D``) = 0.548."""


def active_rows(
    at_rest: Tensor, means: Tensor, log_scales: Tensor | None, times: Tensor, log_lambdas: Tensor, t: float, p_min: float,
    camera: Camera | None, near: float,
) -> tuple[Tensor, int]:  # fmt: skip
    """See ``api.active_rows``."""
    resting = at_rest
    if camera is not None and log_scales is not None:
        resting = resting & _may_be_seen(means, torch.exp(log_scales.amax(1)), camera, near)
    moving = ~at_rest & (presence(times, log_lambdas, t) >= p_min)
    first, last = torch.nonzero(resting).squeeze(1), torch.nonzero(moving).squeeze(1)
    return torch.cat([first, last]), len(first)


def _may_be_seen(means: Tensor, sizes: Tensor, camera: Camera, near: float) -> Tensor:
    """Return [N] bool, from the largest standard deviation [N] of each."""
    viewmat, K = camera.tensors(means.dtype, means.device)
    points = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    depth = points[:, 2]
    seen = depth > near
    for axis, image in ((0, camera.width), (1, camera.height)):
        focal, center = K[axis, axis], K[axis, 2]
        limit = torch.maximum(image - center, center) / focal + TANGENT_MARGIN * image / focal
        tangent = points[:, axis] / depth
        held = torch.minimum(torch.maximum(tangent, -limit), limit)
        reach = CULL_SIGMAS * (focal / depth * sizes * torch.sqrt(1 + held * held) + BLUR_SIGMA)
        pixel = focal * tangent + center
        seen = seen & (pixel + reach >= 0) & (pixel - reach <= image)
    return seen
