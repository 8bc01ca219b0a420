"""The oracle, in plain torch."""

from __future__ import annotations

import torch
from torch import Tensor

from flowsplat.gaussians.density import DensityStatistics
from flowsplat.gaussians.gaussians4d import Active
from flowsplat.gaussians.render import RenderedFrame
from flowsplat.training.photometric_loss import PhotometricTargets

SURFACE_ALPHA = 0.5
"""Alpha above which there is a surface. Chosen by eye."""
SURFACE_TOLERANCE = 0.05
"""How far from it a Gaussian on it may be, as a share of its depth. Chosen by eye."""


def add_residuals(
    statistics: DensityStatistics, active: Active, visible: Tensor, rendered: RenderedFrame, targets: PhotometricTargets
) -> None:
    """See ``api.add_residuals``."""
    seen, flow, color = residuals(rendered, targets)
    seen &= visible
    rows = active.valid(active.rows)
    statistics.flow_residual[rows] += active.valid(torch.where(seen, flow, 0))
    statistics.color_residual[rows] += active.valid(torch.where(seen, color, 0))
    statistics.flow_visits[rows] += active.valid(seen)


def residuals(rendered: RenderedFrame, targets: PhotometricTargets) -> tuple[Tensor, Tensor, Tensor]:
    """Return which Gaussians, if drawn, lie on the visible surface where flow is trusted; errors of flow and color there, [A]
    each."""
    assert rendered.flow is not None
    height, width = rendered.alpha.shape
    uv = rendered.projected.means2d.detach()
    x, y = uv[:, 0].long().clamp(0, width - 1), uv[:, 1].long().clamp(0, height - 1)
    inside = (uv[:, 0] >= 0) & (uv[:, 1] >= 0) & (uv[:, 0] < width) & (uv[:, 1] < height)
    alpha = rendered.alpha.detach()[y, x]
    surface = rendered.depth.detach()[y, x] / alpha.clamp(min=1e-6)
    depths = rendered.projected.depths.detach()
    trusted = torch.as_tensor(targets.flow_trusted, device=uv.device)[y, x]
    seen = inside & trusted & (alpha > SURFACE_ALPHA) & ((depths - surface).abs() < SURFACE_TOLERANCE * surface)
    flow = rendered.flow.detach()[y, x] / alpha.clamp(min=1e-6)[:, None]
    wrong = (flow - torch.as_tensor(targets.flow, device=uv.device)[y, x]).norm(dim=1)
    true = torch.as_tensor(targets.color, device=uv.device)[y, x].float() / 255
    return seen, wrong, (rendered.image.detach()[y, x, :3] - true).abs().mean(1)
