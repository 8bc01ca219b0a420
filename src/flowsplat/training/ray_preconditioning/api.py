"""The one place that picks who computes steps along rays."""

from __future__ import annotations

from torch import Tensor

from flowsplat.common import devices
from flowsplat.training.adam import RowAdam
from flowsplat.training.ray_preconditioning import reference
from flowsplat.training.ray_preconditioning.reference import PathSpread


def step_along_rays(
    adam: RowAdam, name: str, value: Tensor, rows: Tensor, stepped: Tensor, gradient: Tensor, rates: Tensor,
    path: PathSpread, focal: float, most: float,
) -> None:  # fmt: skip
    """``RowAdam.step`` of positions, in the axes of their rays, in which moments are kept; steps along the ray are longer.

    Args:
        adam: the optimizer.
        name: of the parameter.
        value: [N, 3] positions, stepped in place.
        rows: [A] int64; where not ``stepped`` -1 may be among them, padding.
        stepped: [A] bool.
        gradient: [A, 3] in world axes.
        rates: [3].
        path: of the cameras.
        focal: pixels.
        most: upper bound of how many times as long, at least 1 (``reference.ray_axes``).
    """
    if len(rows) == 0:
        return
    kernels = devices.kernels_for(value)
    if kernels == "reference":
        reference.step_along_rays(adam, name, value, rows, stepped, gradient, rates, path, focal, most)
        return
    mean, square, counts = adam.moments(name)
    if kernels == "cpu":
        from flowsplat.training.ray_preconditioning import cpu

        cpu.step_rows(value, mean, square, counts, rows, stepped, gradient, rates, path, focal, most)
    else:
        from flowsplat.training.ray_preconditioning import triton

        triton.step_rows(value, mean, square, counts, rows, stepped, gradient, rates, path, focal, most)
