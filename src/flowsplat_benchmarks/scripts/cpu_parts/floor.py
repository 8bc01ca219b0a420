"""The floor: what blending must compute at least, counted in pixel-Gaussian pairs.

A pair is a pixel center inside the alpha >= 1/255 ellipse of a Gaussian (docs/method/flow.md, "Compositing"). All of them count,
also
those that lie
behind a pixel that has stopped. A pair costs these floating-point operations (an FMA counts two; comparisons, selections,
conversions, loads and stores count nothing, and neither do projecting, sorting and tiling):

======================================================================================================  ============  ============
what                                                                                                    forward       backward
======================================================================================================  ============  ============
exponent (a dx + b dy) dx + (c dy^2 + log o); the terms in dy alone are shared by a row of pixels       5             5
2^x: a polynomial of degree 5 and three squarings                                                       13            13
compositing: weight = alpha T, T -= weight                                                              2             2
features: image += weight f; backward: gradient . f, and the gradient of f                              2 C           4 C
what is still behind: toward = weight (gradient . f), behind -= toward                                                2
gradient of alpha: toward - behind alpha / (1 - alpha), the reciprocal an estimate and a Newton step                  7
its sums: g, g dy, g dy^2; the moments in dx are made from them once a column                                         5
total                                                                                                   20 + 2 C      34 + 4 C
======================================================================================================  ============  ============

The floor in seconds is pairs x operations / the FMA peak measured on the machine at hand.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

import numpy as np

from flowsplat.common.kernels import kernel
from flowsplat.common.threads import parallel_for
from flowsplat.splatting import Projected

TILE = 16
_CHUNKS = 64


def forward_flops(channels: int) -> int:
    """Operations of one pair in the forward pass with C feature channels."""
    return 20 + 2 * channels


def backward_flops(channels: int) -> int:
    """Operations of one pair in the backward pass (which computes alpha and the compositing again)."""
    return 34 + 4 * channels


@dataclass(frozen=True)
class Counts:
    """How much there is to blend in an image.

    Attributes:
        pixels: of the image.
        visible: Gaussians with at least one pair.
        pairs: pixel centers inside the support of a Gaussian, summed over the Gaussians.
        instances: pairs of a Gaussian and a tile of 16 x 16 pixels in which it has a pair.
    """

    pixels: int
    visible: int
    pairs: int
    instances: int

    def to_json(self) -> dict[str, float]:
        """Plain numbers, with the pairs of a pixel."""
        return {**asdict(self), "pairs_per_pixel": self.pairs / self.pixels}


@kernel
def _count(begin, end, means2d, conics, extents, width, height, totals):
    """totals [chunks, 3]: visible, pairs, instances."""
    count, chunks = len(means2d), len(totals)
    for chunk in range(begin, end):
        visible, pairs, instances = 0, 0, 0
        for i in range(count * chunk // chunks, count * (chunk + 1) // chunks):
            if not extents[i] > 0:
                continue
            x, y, a, b, c = means2d[i, 0], means2d[i, 1], conics[i, 0], conics[i, 1], conics[i, 2]
            determinant = a * c - b * b
            half = math.sqrt(extents[i] * a / determinant)
            first, last = max(math.ceil(y - half - 0.5), 0), min(math.floor(y + half - 0.5), height - 1)
            own, tile_row, low, high = 0, -1, 0, -1
            for row in range(first, last + 1):
                # a dx^2 + 2 b dx dy + c dy^2 <= extent
                dy = row + 0.5 - y
                root = math.sqrt(max(extents[i] * a - determinant * dy * dy, 0.0))
                left = max(math.ceil(x + (-b * dy - root) / a - 0.5), 0)
                right = min(math.floor(x + (-b * dy + root) / a - 0.5), width - 1)
                if left > right:
                    continue
                own += right - left + 1
                left, right = left // TILE, right // TILE
                if row // TILE != tile_row:
                    instances += high - low + 1
                    tile_row, low, high = row // TILE, left, right
                else:
                    low, high = min(low, left), max(high, right)
            instances += high - low + 1
            pairs += own
            visible += own > 0
        totals[chunk, 0] = visible
        totals[chunk, 1] = pairs
        totals[chunk, 2] = instances


def count_pairs(projected: Projected, opacities: np.ndarray, width: int, height: int) -> Counts:
    """Count exactly, in double precision, what projected Gaussians with opacities [N] have to blend."""
    extents = 2 * np.log(np.maximum(opacities.astype(np.float64), 1e-12) * 255)
    extents[~projected.visible.numpy()] = 0
    totals = np.zeros((_CHUNKS, 3), np.int64)
    means2d, conics = (tensor.detach().numpy().astype(np.float64) for tensor in (projected.means2d, projected.conics))
    parallel_for(_count, _CHUNKS, means2d, conics, extents, width, height, totals)
    visible, pairs, instances = map(int, totals.sum(0))
    return Counts(width * height, visible, pairs, instances)


def floor_seconds(pairs: int, flops: int, peak: float) -> float:
    """Return the floor at ``peak`` floating-point operations a second."""
    return pairs * flops / peak
