"""Slopes in the image of slopes along the Gaussians' axes; the one place that picks the backend."""

from __future__ import annotations

from torch import Tensor

from flowsplat.common import devices
from flowsplat.gaussians.slicing import Slice
from flowsplat.gaussians.slopes import reference
from flowsplat.geometry import Camera
from flowsplat.splatting import Projected


def image_slopes(sliced: Slice, projected: Projected, camera: Camera) -> Tensor | None:
    """Return [A, 2] by how much the Gaussians get brighter a pixel to the right and a pixel down of their centers; None where they
    have no slopes (docs/method/representation.md, "Brightness slopes", ours).

    Differentiable in the slopes alone: what turns them into those of the image counts as constant. With its gradients training is
    slower and no better.

    Args:
        sliced: the Gaussians.
        projected: their projection into ``camera``.
        camera: in the coordinates of the Gaussians.
    """
    if sliced.slopes is None:
        return None
    kernels = devices.kernels_for(sliced.means) if sliced.covars is None else "reference"
    if kernels == "cpu":
        from flowsplat.gaussians.slopes import cpu

        return cpu.image_slopes(sliced, projected, camera)
    if kernels == "triton":
        from flowsplat.gaussians.slopes import triton

        return triton.image_slopes(sliced, projected, camera)
    return reference.image_slopes(sliced, projected, camera)
