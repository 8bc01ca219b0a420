"""The colour loss and its gradient in three sweeps over rows. Oracle: ``reference``.

Pictures stay [H, W, 3]: a row is 3 W numbers and a horizontal tap is three numbers wide, so no plane is ever rearranged.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import float32, njit, prange
from torch import Tensor

from flowsplat.splatting.cpu.workspace import Workspace
from flowsplat.training.ssim.reference import C1, C2, RADIUS, window

OPTIONS = {"fastmath": True, "cache": True, "error_model": "numpy"}
CHANNELS = 3
PAD = RADIUS * CHANNELS
W0, W1, W2, W3, W4, W5 = window()[: RADIUS + 1].astype(np.float32)
K1, K2 = np.float32(C1), np.float32(C2)
ONE, TWO, ZERO = np.float32(1), np.float32(2), np.float32(0)


@njit(**OPTIONS)
def _blur_along(source, out, count):
    """out[i] from a row with PAD zeros on both sides."""
    for i in range(count):
        out[i] = (
            W0 * (source[i] + source[i + 30])
            + W1 * (source[i + 3] + source[i + 27])
            + W2 * (source[i + 6] + source[i + 24])
            + W3 * (source[i + 9] + source[i + 21])
            + W4 * (source[i + 12] + source[i + 18])
            + W5 * source[i + 15]
        )


@njit(**OPTIONS)
def _blur_down(rows, y, out, count):
    """out from rows y .. y + 10 of a plane with RADIUS zero rows above and below."""
    for i in range(count):
        out[i] = (
            W0 * (rows[y, i] + rows[y + 10, i])
            + W1 * (rows[y + 1, i] + rows[y + 9, i])
            + W2 * (rows[y + 2, i] + rows[y + 8, i])
            + W3 * (rows[y + 3, i] + rows[y + 7, i])
            + W4 * (rows[y + 4, i] + rows[y + 6, i])
            + W5 * rows[y + 5, i]
        )


@njit(parallel=True, **OPTIONS)
def _loss_and_gradient(x, y, ssim_weight, blurred, derivatives, row_sums, gradient):
    height, count = x.shape
    share = ONE / float32(height * count)
    for h in prange(height):
        padded = np.zeros(count + 2 * PAD, np.float32)
        for i in range(count):
            padded[PAD + i] = x[h, i]
        _blur_along(padded, blurred[0, h + RADIUS], count)
        for i in range(count):
            padded[PAD + i] = y[h, i]
        _blur_along(padded, blurred[1, h + RADIUS], count)
        for i in range(count):
            padded[PAD + i] = x[h, i] * x[h, i] + y[h, i] * y[h, i]
        _blur_along(padded, blurred[2, h + RADIUS], count)
        for i in range(count):
            padded[PAD + i] = x[h, i] * y[h, i]
        _blur_along(padded, blurred[3, h + RADIUS], count)
    for h in prange(height):
        mx, my = np.empty(count, np.float32), np.empty(count, np.float32)
        squares, product = np.empty(count, np.float32), np.empty(count, np.float32)
        padded = np.zeros((3, count + 2 * PAD), np.float32)
        _blur_down(blurred[0], h, mx, count)
        _blur_down(blurred[1], h, my, count)
        _blur_down(blurred[2], h, squares, count)
        _blur_down(blurred[3], h, product, count)
        total = ZERO
        for i in range(count):
            a, b = mx[i], my[i]
            means = a * a + b * b
            numerator1, numerator2 = TWO * a * b + K1, TWO * (product[i] - a * b) + K2
            denominator1, denominator2 = means + K1, squares[i] - means + K2
            inverse = ONE / (denominator1 * denominator2)
            ssim = numerator1 * numerator2 * inverse
            total += ssim
            # Derivatives with respect to the three blurred fields that contain x: mean, x^2 + y^2 and x y.
            padded[0, PAD + i] = (
                TWO * b * (numerator2 - numerator1) * inverse - ssim * TWO * a * (denominator2 - denominator1) * inverse
            )
            padded[1, PAD + i] = -ssim * inverse * denominator1
            padded[2, PAD + i] = TWO * numerator1 * inverse
        row_sums[h] = total
        for k in range(3):
            _blur_along(padded[k], derivatives[k, h + RADIUS], count)
    for h in prange(height):
        d_mean, d_square, d_product = np.empty(count, np.float32), np.empty(count, np.float32), np.empty(count, np.float32)
        _blur_down(derivatives[0], h, d_mean, count)
        _blur_down(derivatives[1], h, d_square, count)
        _blur_down(derivatives[2], h, d_product, count)
        absolute = ZERO
        l1_share, ssim_share = (ONE - ssim_weight) * share, ssim_weight * share
        for i in range(count):
            difference = x[h, i] - y[h, i]
            absolute += abs(difference)
            sign = l1_share if difference > ZERO else (-l1_share if difference < ZERO else ZERO)
            gradient[h, i] = sign - ssim_share * (d_mean[i] + TWO * x[h, i] * d_square[i] + y[h, i] * d_product[i])
        row_sums[h] = (ONE - ssim_weight) * absolute - ssim_weight * row_sums[h]


class _ColourLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, ssim_weight: float) -> Tensor:
        height, count = image.shape[0], image.shape[1] * CHANNELS
        x = image.detach().contiguous().view(height, count).numpy()
        y = target.contiguous().view(height, count).numpy()
        space = Workspace.acquire()
        padded = height + 2 * RADIUS
        blurred = space.array("blurred", 4 * padded * count, np.float32).reshape(4, padded, count)
        derivatives = space.array("derivatives", 3 * padded * count, np.float32).reshape(3, padded, count)
        for planes in (blurred, derivatives):
            planes[:, :RADIUS] = 0
            planes[:, -RADIUS:] = 0
        gradient, row_sums = torch.empty(image.shape), np.empty(height)
        weight = np.float32(ssim_weight)
        _loss_and_gradient(x, y, weight, blurred, derivatives, row_sums, gradient.view(height, count).numpy())
        space.release()
        ctx.save_for_backward(gradient)
        return image.new_tensor(row_sums.sum() / (height * count) + ssim_weight)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        return grad * ctx.saved_tensors[0], None, None


def colour_loss(image: Tensor, target: Tensor, ssim_weight: float) -> Tensor:
    """See ``api.colour_loss``."""
    result: Tensor = _ColourLoss.apply(image, target, ssim_weight)
    return result
