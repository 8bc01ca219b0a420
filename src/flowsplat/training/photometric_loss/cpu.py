"""The photometric loss and its gradient in three sweeps over rows. Oracle: ``reference``.

Colors stay interleaved: a row is 3 W numbers and a horizontal tap is three numbers wide, so no plane is ever rearranged.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import float32
from torch import Tensor
from torch.autograd.function import once_differentiable

from flowsplat.common.kernels import helper, inline, kernel
from flowsplat.common.threads import parallel_for
from flowsplat.splatting.cpu.workspace import Workspace
from flowsplat.training.photometric_loss import reference
from flowsplat.training.photometric_loss.api import ImageFigures, PhotometricTargets, PhotometricWeights
from flowsplat.training.photometric_loss.reference import C1, C2, RADIUS, window

CHANNELS = 3
"""Red, green and blue."""
PAD = RADIUS * CHANNELS
W0, W1, W2, W3, W4, W5 = window()[: RADIUS + 1].astype(np.float32)
K1, K2 = np.float32(C1), np.float32(C2)
ONE, TWO, ZERO, HALF = np.float32(1), np.float32(2), np.float32(0), np.float32(0.5)
BYTE, FLOW_ALPHA, MAX_UNSEEN_SHARE = (
    np.float32(1 / 255),
    np.float32(reference.MIN_FLOW_ALPHA),
    np.float32(reference.MAX_UNSEEN_SHARE),
)


@helper
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


@helper
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


@helper
def _sum(values, count):
    """Sum of the first entries, which are spoilt: halves are added to halves, many at once."""
    while count > 1:
        half = count // 2
        for i in range(half):
            values[i] += values[count - half + i]
        count -= half
    return values[0]


@inline
def _sign(x):
    """-1, 0 or 1, without a branch, which could not be predicted."""
    return float32((x > ZERO) - (x < ZERO))


@inline
def _rows(image, target, h, width, row_x, row_y):
    """Row h of the image and of what it should be, as numbers between 0 and 1."""
    for w in range(width):
        for c in range(CHANNELS):
            row_x[w * CHANNELS + c] = image[h, w, c]
            row_y[w * CHANNELS + c] = BYTE * float32(target[h, w, c])


@inline
def flow_at(image, h, w, flow_channels, half_width, half_height):
    """What ``gaussians.flow.flow_image`` makes of a pixel's features, and the pixel from the center of the image."""
    u, v = image[h, w, 4], image[h, w, 5]
    x, y = float32(w) + HALF - half_width, float32(h) + HALF - half_height
    if flow_channels == 6:
        u += image[h, w, 6] * x + image[h, w, 7] * y
        v += image[h, w, 8] * x + image[h, w, 9] * y
    return u, v, x, y


@inline
def _flow_counts(image, alpha, flow_trusted, h, w, end, by_alpha):
    held = image[h, w, end] if image.shape[2] > end else ZERO
    return flow_trusted[h, w] and held <= MAX_UNSEEN_SHARE * alpha[h, w] and (alpha[h, w] >= FLOW_ALPHA or not by_alpha)


@kernel
def _blur_rows(begin, end, image, alpha, target, flow_trusted, flow_channels, flow_weight, by_alpha, blurred, counts):
    """Along rows blurred [4, H + 2 RADIUS, 3 W]: the image x, its target y, x^2 + y^2 and x y.

    counts [H]: how many pixels have a flow that counts.
    """
    width = image.shape[1]
    count, held = width * CHANNELS, 4 + flow_channels
    for h in range(begin, end):
        row_x, row_y = np.empty(count, np.float32), np.empty(count, np.float32)
        padded = np.zeros(count + 2 * PAD, np.float32)
        _rows(image, target, h, width, row_x, row_y)
        for i in range(count):
            padded[PAD + i] = row_x[i]
        _blur_along(padded, blurred[0, h + RADIUS], count)
        for i in range(count):
            padded[PAD + i] = row_y[i]
        _blur_along(padded, blurred[1, h + RADIUS], count)
        for i in range(count):
            padded[PAD + i] = row_x[i] * row_x[i] + row_y[i] * row_y[i]
        _blur_along(padded, blurred[2, h + RADIUS], count)
        for i in range(count):
            padded[PAD + i] = row_x[i] * row_y[i]
        _blur_along(padded, blurred[3, h + RADIUS], count)
        valid = 0
        if flow_weight > ZERO:
            for w in range(width):
                valid += _flow_counts(image, alpha, flow_trusted, h, w, held, by_alpha)
        counts[h] = valid


@kernel
def _similarity_rows(begin, end, blurred, derivatives, sums):
    """SSIM summed over rows into sums [H, 0], and along rows blurred its derivatives [3, H + 2 RADIUS, 3 W]."""
    count = blurred.shape[2]
    for h in range(begin, end):
        mx, my = np.empty(count, np.float32), np.empty(count, np.float32)
        squares, product = np.empty(count, np.float32), np.empty(count, np.float32)
        padded = np.zeros((3, count + 2 * PAD), np.float32)
        _blur_down(blurred[0], h, mx, count)
        _blur_down(blurred[1], h, my, count)
        _blur_down(blurred[2], h, squares, count)
        _blur_down(blurred[3], h, product, count)
        for i in range(count):
            a, b = mx[i], my[i]
            means = a * a + b * b
            numerator1, numerator2 = TWO * a * b + K1, TWO * (product[i] - a * b) + K2
            denominator1, denominator2 = means + K1, squares[i] - means + K2
            inverse = ONE / (denominator1 * denominator2)
            ssim = numerator1 * numerator2 * inverse
            # Derivatives with respect to the three blurred fields that contain x: mean, x^2 + y^2 and x y.
            padded[0, PAD + i] = (
                TWO * b * (numerator2 - numerator1) * inverse - ssim * TWO * a * (denominator2 - denominator1) * inverse
            )
            padded[1, PAD + i] = -ssim * inverse * denominator1
            padded[2, PAD + i] = TWO * numerator1 * inverse
            product[i] = ssim  # A sum here would have to be taken one number at a time.
        sums[h, 0] = _sum(product, count)
        for k in range(3):
            _blur_along(padded[k], derivatives[k, h + RADIUS], count)


@kernel
def _gradient_rows(
    begin, end, image, alpha, target, flow, flow_trusted, depth, depth_trusted, flow_channels, ssim_weight, flow_weight,
    depth_weight, flow_share, by_alpha, derivatives, sums, gradient, alpha_gradient,
):  # fmt: skip
    """Fill the gradients and, row by row, sums [H, 4] of color, flow, depth and squared error, not yet divided."""
    height, width, channels = image.shape
    count, held = width * CHANNELS, 4 + flow_channels
    half_width, half_height = HALF * float32(width), HALF * float32(height)
    share = ONE / float32(height * count)
    depth_share = depth_weight / float32(height * width)
    for h in range(begin, end):
        d_mean, d_square, d_product = np.empty(count, np.float32), np.empty(count, np.float32), np.empty(count, np.float32)
        _blur_down(derivatives[0], h, d_mean, count)
        _blur_down(derivatives[1], h, d_square, count)
        _blur_down(derivatives[2], h, d_product, count)
        row_x, row_y = np.empty(count, np.float32), np.empty(count, np.float32)
        _rows(image, target, h, width, row_x, row_y)
        l1_share, ssim_share = (ONE - ssim_weight) * share, ssim_weight * share
        for i in range(count):
            x, y = row_x[i], row_y[i]
            difference, clamped = x - y, min(max(x, ZERO), ONE) - y
            row_x[i] = l1_share * _sign(difference) - ssim_share * (d_mean[i] + TWO * x * d_square[i] + y * d_product[i])
            d_mean[i], d_square[i] = abs(difference), clamped * clamped
        absolute, squared = _sum(d_mean, count), _sum(d_square, count)
        flow_sum, depth_sum = ZERO, ZERO
        for w in range(width):
            for c in range(CHANNELS):
                gradient[h, w, c] = row_x[w * CHANNELS + c]
            for c in range(CHANNELS, channels):
                gradient[h, w, c] = ZERO
            toward_alpha = ZERO
            if depth_weight > ZERO and depth_trusted[h, w]:
                difference = image[h, w, 3] - alpha[h, w] * depth[h, w]
                inverse = ONE / depth[h, w]
                depth_sum += abs(difference) * inverse
                sign = depth_share * _sign(difference)
                gradient[h, w, 3] = sign * inverse
                toward_alpha -= sign
            if flow_weight > ZERO and _flow_counts(image, alpha, flow_trusted, h, w, held, by_alpha):
                u, v, x, y = flow_at(image, h, w, flow_channels, half_width, half_height)
                factor = alpha[h, w] if by_alpha else ONE
                du, dv = u - factor * flow[h, w, 0], v - factor * flow[h, w, 1]
                flow_sum += abs(du) + abs(dv)
                gu, gv = flow_share * _sign(du), flow_share * _sign(dv)
                gradient[h, w, 4] = gu
                gradient[h, w, 5] = gv
                if flow_channels == 6:
                    gradient[h, w, 6] = gu * x
                    gradient[h, w, 7] = gu * y
                    gradient[h, w, 8] = gv * x
                    gradient[h, w, 9] = gv * y
                if by_alpha:
                    toward_alpha -= gu * flow[h, w, 0] + gv * flow[h, w, 1]
            alpha_gradient[h, w] = toward_alpha
        sums[h, 0] = (ONE - ssim_weight) * absolute - ssim_weight * sums[h, 0]
        sums[h, 1] = flow_sum
        sums[h, 2] = depth_sum
        sums[h, 3] = squared


_NO_PLANE, _NO_FLOW, _NO_TRUST = np.zeros((0, 0), np.float32), np.zeros((0, 0, 2), np.float32), np.zeros((0, 0), np.bool_)


class _PhotometricLoss(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, image: Tensor, alpha: Tensor, flow_channels: int, targets: PhotometricTargets, weights: PhotometricWeights
    ) -> tuple[Tensor, ImageFigures]:
        height, width = alpha.shape
        count, padded = width * CHANNELS, height + 2 * RADIUS
        has_flow = targets.flow is not None and weights.flow > 0
        has_depth = targets.depth is not None and weights.depth > 0
        flow, flow_trusted = (targets.flow, targets.flow_trusted) if has_flow else (_NO_FLOW, _NO_TRUST)
        depth, depth_trusted = (targets.depth, targets.depth_trusted) if has_depth else (_NO_PLANE, _NO_TRUST)
        flow_weight, depth_weight = weights.flow if has_flow else 0.0, weights.depth if has_depth else 0.0
        space = Workspace.acquire()
        blurred = space.array("blurred", 4 * padded * count, np.float32).reshape(4, padded, count)
        derivatives = space.array("derivatives", 3 * padded * count, np.float32).reshape(3, padded, count)
        for planes in (blurred, derivatives):
            planes[:, :RADIUS] = 0
            planes[:, -RADIUS:] = 0
        gradient, alpha_gradient = torch.empty(image.shape), torch.empty(alpha.shape)
        sums, counts = np.empty((height, 4)), np.empty(height, np.int64)
        shown = image.detach().contiguous().numpy(), alpha.detach().contiguous().numpy(), targets.color
        by_alpha, flow_weight_32 = weights.flow_by_alpha, np.float32(flow_weight)
        parallel_for(
            _blur_rows, height, *shown, flow_trusted, flow_channels, flow_weight_32, by_alpha, blurred, counts,
        )  # fmt: skip
        parallel_for(_similarity_rows, height, blurred, derivatives, sums)
        valid = int(counts.sum())
        parallel_for(
            _gradient_rows, height, *shown, flow, flow_trusted, depth, depth_trusted, flow_channels, np.float32(weights.ssim),
            flow_weight_32, np.float32(depth_weight), flow_weight_32 / np.float32(2 * max(valid, 1)), by_alpha, derivatives, sums,
            gradient.numpy(), alpha_gradient.numpy(),
        )  # fmt: skip
        space.release()
        ctx.save_for_backward(gradient, alpha_gradient)
        color, flow_error, depth_error, squared = sums.sum(0)
        figures = ImageFigures(
            color=float(color) / (height * count) + weights.ssim,
            flow=float(flow_error) / (2 * max(valid, 1)),
            depth=float(depth_error) / (height * width),
            squared_error=float(squared) / (height * count),
        )
        total = figures.color + flow_weight * figures.flow + depth_weight * figures.depth
        return image.new_tensor(total), figures

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor, _: Any) -> tuple[Tensor, Tensor, None, None, None]:
        gradient, alpha_gradient = ctx.saved_tensors
        if float(grad) != 1:
            gradient, alpha_gradient = grad * gradient, grad * alpha_gradient
        return gradient, alpha_gradient, None, None, None


def photometric_loss(
    image: Tensor, alpha: Tensor, flow_channels: int, targets: PhotometricTargets, weights: PhotometricWeights
) -> tuple[Tensor, ImageFigures]:
    """See ``api.photometric_loss``."""
    result: tuple[Tensor, ImageFigures] = _PhotometricLoss.apply(image, alpha, flow_channels, targets, weights)
    return result
