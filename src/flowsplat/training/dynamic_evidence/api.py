"""The one place that picks who computes residuals."""

from __future__ import annotations

from torch import Tensor

from flowsplat.common import devices
from flowsplat.gaussians.density import DensityStatistics
from flowsplat.gaussians.gaussians4d import Active
from flowsplat.gaussians.render import RenderedFrame
from flowsplat.training.dynamic_evidence import reference
from flowsplat.training.photometric_loss import PhotometricTargets


def add_residuals(
    statistics: DensityStatistics, active: Active, visible: Tensor, rendered: RenderedFrame, targets: PhotometricTargets
) -> None:
    """Add what an image says about the Gaussians on its visible surface, where flow is trusted.

    Those are the ones whose center lies in the image, on a pixel of alpha above ``reference.SURFACE_ALPHA``, at the depth that is
    rendered there to within ``reference.SURFACE_TOLERANCE`` of it.

    Args:
        statistics: ``flow_residual`` (pixels), ``color_residual`` (0 to 1) and ``flow_visits`` [N] are added to, in place.
        active: who was rendered.
        visible: [A] bool, who of them was drawn.
        rendered: the image, with flow.
        targets: what it should show, with flow.
    """
    if devices.kernels_for(rendered.image) == "cpu":
        from flowsplat.training.dynamic_evidence.cpu import add_residuals as add

        add(statistics, active, visible, rendered, targets)
    else:
        reference.add_residuals(statistics, active, visible, rendered, targets)
