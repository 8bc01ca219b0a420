"""Residuals of all Gaussians in one sweep, of which most end at the first question. Oracle: ``reference``."""

from __future__ import annotations

import math

import numpy as np
from numba import float32
from torch import Tensor

from flowsplat.common.kernels import kernel
from flowsplat.common.threads import parallel_for
from flowsplat.gaussians.density import DensityStatistics
from flowsplat.gaussians.gaussians4d import Active
from flowsplat.gaussians.render import RenderedFrame
from flowsplat.training.dynamic_evidence import reference
from flowsplat.training.photometric_loss import PhotometricTargets
from flowsplat.training.photometric_loss.cpu import BYTE, HALF, ONE, ZERO, flow_at

SURFACE, TOLERANCE, THIRD = np.float32(reference.SURFACE_ALPHA), np.float32(reference.SURFACE_TOLERANCE), np.float32(1 / 3)


@kernel
def _add(
    begin, end, rows, visible, means2d, depths, image, alpha, flow_channels, color, flow, trusted, flow_residual,
    color_residual, visits,
):  # fmt: skip
    height, width = alpha.shape
    half_width, half_height = HALF * float32(width), HALF * float32(height)
    for a in range(begin, end):
        u, v = means2d[a, 0], means2d[a, 1]
        if visible[a] and u >= ZERO and v >= ZERO and u < float32(width) and v < float32(height):
            w, h = int(u), int(v)
            if trusted[h, w] and alpha[h, w] > SURFACE:
                share = ONE / alpha[h, w]
                surface = image[h, w, 3] * share
                if abs(depths[a] - surface) < TOLERANCE * surface:
                    du, dv, _, _ = flow_at(image, h, w, flow_channels, half_width, half_height)
                    du, dv = du * share - flow[h, w, 0], dv * share - flow[h, w, 1]
                    wrong = ZERO
                    for c in range(3):
                        wrong += abs(image[h, w, c] - BYTE * float32(color[h, w, c]))
                    i = rows[a]
                    flow_residual[i] += math.sqrt(du * du + dv * dv)
                    color_residual[i] += THIRD * wrong
                    visits[i] += ONE


def add_residuals(
    statistics: DensityStatistics, active: Active, visible: Tensor, rendered: RenderedFrame, targets: PhotometricTargets
) -> None:
    """See ``api.add_residuals``."""
    projected = rendered.projected
    shown = (active.rows, visible, projected.means2d, projected.depths, rendered.image, rendered.alpha)
    sums = statistics.flow_residual, statistics.color_residual, statistics.flow_visits
    parallel_for(
        _add, len(active.rows), *(tensor.detach().contiguous().numpy() for tensor in shown), rendered.flow_channels,
        targets.color, targets.flow,
        targets.flow_trusted, *(tensor.numpy() for tensor in sums),
    )  # fmt: skip
