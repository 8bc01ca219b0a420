"""Rasterizers in plain torch: tiles of 16 x 16 pixels under autograd, by the same rules, on the oracle's projection.

Each tile is a handful of vectorized operations on [256 pixels, Gaussians of the tile]; autograd does the rest. There are two: the
one that anyone would write first (every tile looks for its Gaussians among all that are visible and takes them from the whole
scene, as small public implementations do), and one made as fast as plain torch allowed.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

import torch
from torch import Tensor

from flowsplat.splatting import reference
from flowsplat.splatting.rules import ALPHA_MAX, ALPHA_MIN, EPS2D, TRANSMITTANCE_MIN

TILE = 16


def _blend_tile(column: int, row: int, mean: Tensor, conic: Tensor, opacity: Tensor, feature: Tensor) -> Tensor:
    """Return [16, 16, C + 1] features and alpha of a tile, from its Gaussians in depth order."""
    x = torch.arange(TILE) + 0.5
    pixels = torch.stack(torch.meshgrid(x, x, indexing="xy"), -1).reshape(-1, 1, 2)
    corner = torch.tensor([TILE * column, TILE * row])
    dx, dy = (pixels + corner - mean).unbind(-1)
    a, b, c = conic.unbind(-1)
    raw = opacity * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    alpha = torch.where(raw >= ALPHA_MIN, raw.clamp(max=ALPHA_MAX), 0.0)
    alpha = torch.where(torch.cumprod(1 - alpha, 1) > TRANSMITTANCE_MIN, alpha, 0.0)
    after = torch.cat([torch.ones(TILE * TILE, 1), torch.cumprod(1 - alpha, 1)], 1)
    blended = (alpha * after[:, :-1]) @ feature
    return torch.cat([blended, 1 - after[:, -1:]], 1).reshape(TILE, TILE, -1)


def rows_of_tiles(
    means2d: Tensor, conics: Tensor, opacities: Tensor, features: Tensor, depths: Tensor, radii: Tensor, width: int, height: int
) -> Iterator[tuple[Tensor, Tensor]]:
    """Blend the image 16 rows at a time: features [rows, W, C] and alphas [rows, W] of each, differentiable."""
    ids, counts = _lists(means2d.detach(), radii, depths.detach(), width, height)
    columns = -(-width // TILE)
    for row, (row_ids, row_counts) in enumerate(zip(ids, counts.reshape(-1, columns).tolist(), strict=True)):
        # Gathered once a row of tiles: a gather per tile would make a gradient of the size of the whole scene each time.
        parts = [tensor[row_ids].split(row_counts) for tensor in (means2d, conics, opacities, features)]
        tiles = [_blend_tile(column, row, *part) for column, part in enumerate(zip(*parts, strict=True))]
        band = torch.cat(tiles, 1)[: height - TILE * row, :width]
        yield band[..., :-1], band[..., -1]


def _lists(means2d: Tensor, radii: Tensor, depths: Tensor, width: int, height: int) -> tuple[list[Tensor], Tensor]:
    """Gaussians of the tiles of every row, tile by tile in depth order, and how many each tile has [tiles]."""
    columns, rows = -(-width // TILE), -(-height // TILE)
    visible = torch.nonzero(radii[:, 0] > 0).squeeze(1)
    visible = visible[torch.sort(depths[visible], stable=True).indices]
    last = torch.tensor([columns - 1, rows - 1])
    low = ((means2d[visible] - radii[visible]) / TILE).floor().long().clamp(min=0)
    high = torch.minimum(((means2d[visible] + radii[visible]) / TILE).floor().long(), last)
    size = (high - low + 1).clamp(min=0)
    number = size.prod(1)
    owner = torch.repeat_interleave(torch.arange(len(visible)), number)
    within = torch.arange(len(owner)) - (number.cumsum(0) - number)[owner]
    tile = (low[owner, 1] + within // size[owner, 0]) * columns + low[owner, 0] + within % size[owner, 0]
    order = torch.sort(tile, stable=True).indices
    counts = torch.bincount(tile, minlength=columns * rows)
    return list(visible[owner[order]].split(counts.reshape(rows, columns).sum(1).tolist())), counts


def differentiate_by_rows(
    leaves: dict[str, Tensor],
    features: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    grad_image: Tensor,
    grad_alphas: Tensor,
) -> tuple[Tensor, Tensor, dict[str, float]]:
    """Render and differentiate an image; gradients are added to the leaves and the features.

    Every row of tiles is differentiated as soon as it is blended, so that the graph of the whole image, some gigabytes, never
    exists; the work is the same.

    Args:
        leaves: means [N, 3], quats [N, 4], scales [N, 3] and opacities [N].
        features: [N, C]
        viewmat: [4, 4]
        K: [3, 3]
        width: pixels.
        height: pixels.
        grad_image: [H, W, C] gradient of the image.
        grad_alphas: [H, W] gradient of its alphas.

    Returns:
        features [H, W, C], alphas [H, W], and the seconds of ``forward`` and ``backward``.
    """
    began = time.perf_counter()
    projected = reference.project(
        leaves["means"], leaves["quats"], leaves["scales"], None, leaves["opacities"], viewmat, K, width, height, 0.01, 1e10, EPS2D
    )
    means2d, conics = (tensor.detach().requires_grad_() for tensor in projected[:2])
    bands = rows_of_tiles(means2d, conics, leaves["opacities"], features, *projected[2:], width, height)
    images, alphas, backward = [], [], 0.0
    for row, (image, alpha) in enumerate(bands):
        start = time.perf_counter()
        rows = slice(TILE * row, TILE * (row + 1))
        torch.autograd.backward([image, alpha], [grad_image[rows], grad_alphas[rows]])
        images.append(image.detach())
        alphas.append(alpha.detach())
        backward += time.perf_counter() - start
    start = time.perf_counter()
    torch.autograd.backward(projected[:2], [means2d.grad, conics.grad])
    end = time.perf_counter()
    backward += end - start
    return torch.cat(images), torch.cat(alphas), {"forward": end - began - backward, "backward": backward}


def differentiate_simply(
    leaves: dict[str, Tensor],
    features: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    grad_image: Tensor,
    grad_alphas: Tensor,
) -> tuple[Tensor, Tensor, dict[str, float]]:
    """As ``differentiate_by_rows``, tile after tile of the image and then one backward pass through all of them."""
    began = time.perf_counter()
    means2d, conics, depths, radii = reference.project(
        leaves["means"], leaves["quats"], leaves["scales"], None, leaves["opacities"], viewmat, K, width, height, 0.01, 1e10, EPS2D
    )
    visible = torch.nonzero(radii[:, 0] > 0).squeeze(1)
    order = visible[torch.sort(depths[visible], stable=True).indices]
    low, high = means2d.detach()[order] - radii[order], means2d.detach()[order] + radii[order]
    bands = []
    for row in range(-(-height // TILE)):
        tiles = []
        for column in range(-(-width // TILE)):
            corner = TILE * torch.tensor([column, row])
            own = order[((high >= corner) & (low < corner + TILE)).all(1)]
            tiles.append(_blend_tile(column, row, means2d[own], conics[own], leaves["opacities"][own], features[own]))
        bands.append(torch.cat(tiles, 1))
    blended = torch.cat(bands)[:height, :width]
    image, alphas = blended[..., :-1], blended[..., -1]
    middle = time.perf_counter()
    torch.autograd.backward([image, alphas], [grad_image, grad_alphas])
    return image.detach(), alphas.detach(), {"forward": middle - began, "backward": time.perf_counter() - middle}
