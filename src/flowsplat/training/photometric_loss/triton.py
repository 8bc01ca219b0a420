"""The photometric loss and its gradient as Triton kernels, a lane a number of the image. Oracle: ``reference``.

Colors stay interleaved, as in ``cpu``: a row is 3 W numbers and a horizontal tap is three numbers wide. Nothing is read back: the
loss and its parts are tensors of the device.
"""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from flowsplat.common.triton import device_of, rows_per_program
from flowsplat.training.photometric_loss import reference
from flowsplat.training.photometric_loss.api import ImageFigures, PhotometricTargets, PhotometricWeights

RADIUS, K1, K2 = tl.constexpr(reference.RADIUS), tl.constexpr(reference.C1), tl.constexpr(reference.C2)
FLOW_ALPHA, MAX_UNSEEN_SHARE = tl.constexpr(reference.MIN_FLOW_ALPHA), tl.constexpr(reference.MAX_UNSEEN_SHARE)
W0, W1, W2, W3, W4, W5 = (tl.constexpr(float(tap)) for tap in reference.window()[: reference.RADIUS + 1])


@triton.jit
def _tap(k: tl.constexpr):
    """Tap k of the window, 0 to 10."""
    if k == 0 or k == 10:
        tap = W0
    elif k == 1 or k == 9:
        tap = W1
    elif k == 2 or k == 8:
        tap = W2
    elif k == 3 or k == 7:
        tap = W3
    elif k == 4 or k == 6:
        tap = W4
    else:
        tap = W5
    return tap


@triton.jit
def _colors(image, target, h, j, width, channels, mask):
    """Number j of row h of the image and of what it should be, between 0 and 1; 0 where masked."""
    pixel = h * width + j // 3
    x = tl.load(image + pixel * channels + j % 3, mask=mask, other=0.0)
    y = tl.load(target + pixel * 3 + j % 3, mask=mask, other=0).to(tl.float32) * (1.0 / 255.0)
    return x, y


@triton.jit
def _sign(x):
    """-1, 0 or 1."""
    return tl.where(x > 0.0, 1.0, 0.0) - tl.where(x < 0.0, 1.0, 0.0)


@triton.jit
def _blur_products(image, target, blurred, width, height, channels, BLOCK: tl.constexpr):
    """blurred [4, H, 3 W]: x, y, x^2 + y^2 and x y, blurred along the rows."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    row, size = width * 3, width * 3 * height
    h, j = at // row, at % row
    a, b = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
    squares, product = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
    for k in tl.static_range(2 * RADIUS + 1):
        there = j + 3 * (k - RADIUS)
        x, y = _colors(image, target, h, there, width, channels, (at < size) & (there >= 0) & (there < row))
        tap = _tap(k)
        a += tap * x
        b += tap * y
        squares += tap * (x * x + y * y)
        product += tap * (x * y)
    tl.store(blurred + at, a, mask=at < size)
    tl.store(blurred + size + at, b, mask=at < size)
    tl.store(blurred + 2 * size + at, squares, mask=at < size)
    tl.store(blurred + 3 * size + at, product, mask=at < size)


@triton.jit
def _derivatives(blurred, derivatives, sums, width, height, BLOCK: tl.constexpr):
    """Finish the blur; SSIM's derivatives [3, H, 3 W] with respect to the blurred x, x^2 + y^2 and x y, and its sums."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    row, size = width * 3, width * 3 * height
    a, b = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
    squares, product = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
    for k in tl.static_range(2 * RADIUS + 1):
        there = at + row * (k - RADIUS)
        mask = (at < size) & (there >= 0) & (there < size)
        tap = _tap(k)
        a += tap * tl.load(blurred + there, mask=mask, other=0.0)
        b += tap * tl.load(blurred + size + there, mask=mask, other=0.0)
        squares += tap * tl.load(blurred + 2 * size + there, mask=mask, other=0.0)
        product += tap * tl.load(blurred + 3 * size + there, mask=mask, other=0.0)
    means = a * a + b * b
    numerator1, numerator2 = 2.0 * a * b + K1, 2.0 * (product - a * b) + K2
    denominator1, denominator2 = means + K1, squares - means + K2
    inverse = 1.0 / (denominator1 * denominator2)
    ssim = numerator1 * numerator2 * inverse
    d_mean = 2.0 * b * (numerator2 - numerator1) * inverse - ssim * 2.0 * a * (denominator2 - denominator1) * inverse
    tl.store(derivatives + at, d_mean, mask=at < size)
    tl.store(derivatives + size + at, -ssim * inverse * denominator1, mask=at < size)
    tl.store(derivatives + 2 * size + at, 2.0 * numerator1 * inverse, mask=at < size)
    tl.store(sums + tl.program_id(0), tl.sum(tl.where(at < size, ssim, 0.0), 0))


@triton.jit
def _blur_derivatives(derivatives, blurred, width, height, BLOCK: tl.constexpr):
    """Derivatives [3, H, 3 W] blurred along the rows."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    row, size = width * 3, width * 3 * height
    j = at % row
    first, second = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
    third = tl.zeros((BLOCK,), tl.float32)
    for k in tl.static_range(2 * RADIUS + 1):
        offset = 3 * (k - RADIUS)
        mask = (at < size) & (j + offset >= 0) & (j + offset < row)
        tap = _tap(k)
        first += tap * tl.load(derivatives + at + offset, mask=mask, other=0.0)
        second += tap * tl.load(derivatives + size + at + offset, mask=mask, other=0.0)
        third += tap * tl.load(derivatives + 2 * size + at + offset, mask=mask, other=0.0)
    tl.store(blurred + at, first, mask=at < size)
    tl.store(blurred + size + at, second, mask=at < size)
    tl.store(blurred + 2 * size + at, third, mask=at < size)


@triton.jit
def _color_gradient(image, target, blurred, gradient, sums, ssim_weight, width, height, channels, BLOCK: tl.constexpr):
    """Finish the blur; the gradient of the colors, and sums [2, programs] of |x - y| and of the squared error."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    row, size = width * 3, width * 3 * height
    h, j = at // row, at % row
    d_mean, d_square = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
    d_product = tl.zeros((BLOCK,), tl.float32)
    for k in tl.static_range(2 * RADIUS + 1):
        there = at + row * (k - RADIUS)
        mask = (at < size) & (there >= 0) & (there < size)
        tap = _tap(k)
        d_mean += tap * tl.load(blurred + there, mask=mask, other=0.0)
        d_square += tap * tl.load(blurred + size + there, mask=mask, other=0.0)
        d_product += tap * tl.load(blurred + 2 * size + there, mask=mask, other=0.0)
    x, y = _colors(image, target, h, j, width, channels, at < size)
    share = 1.0 / (size * 1.0)
    toward = (1.0 - ssim_weight) * _sign(x - y) - ssim_weight * (d_mean + 2.0 * x * d_square + y * d_product)
    tl.store(gradient + (h * width + j // 3) * channels + j % 3, share * toward, mask=at < size)
    clamped = tl.minimum(tl.maximum(x, 0.0), 1.0) - y
    tl.store(sums + tl.program_id(0), tl.sum(tl.abs(x - y), 0))
    tl.store(sums + tl.num_programs(0) + tl.program_id(0), tl.sum(clamped * clamped, 0))


@triton.jit
def _flow_counts(image, alpha, trusted, pixel, inside, channels, FLOW: tl.constexpr, HELD: tl.constexpr, BY_ALPHA: tl.constexpr):
    """Where flow is compared, and alpha."""
    a = tl.load(alpha + pixel, mask=inside, other=0.0)
    counts = inside & (tl.load(trusted + pixel, mask=inside, other=0) != 0)
    if HELD:
        counts &= tl.load(image + pixel * channels + (4 + FLOW), mask=inside, other=0.0) <= a * MAX_UNSEEN_SHARE
    if BY_ALPHA:
        counts &= a >= FLOW_ALPHA
    return counts, a


@triton.jit
def _count_flow(
    image, alpha, trusted, counted, pixels, channels, FLOW: tl.constexpr, HELD: tl.constexpr, BY_ALPHA: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    counts, _ = _flow_counts(image, alpha, trusted, pixel, pixel < pixels, channels, FLOW, HELD, BY_ALPHA)
    tl.store(counted + tl.program_id(0), tl.sum(tl.where(counts, 1, 0), 0))


@triton.jit
def _other_gradients(
    image, alpha, flow, flow_trusted, counted, depth, depth_trusted, gradient, alpha_gradient, sums, flow_weight, depth_weight,
    width, height, channels, CHANNELS: tl.constexpr, FLOW: tl.constexpr, HELD: tl.constexpr, BY_ALPHA: tl.constexpr,
    HAS_FLOW: tl.constexpr, HAS_DEPTH: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """The gradient of every channel but color and of alpha, and sums [2, programs] of the errors of flow and depth."""
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = pixel < width * height
    at = pixel * channels
    toward_alpha, nothing = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
    flow_error, depth_error, toward_depth = nothing, nothing, nothing
    gu, gv = nothing, nothing
    x = (pixel % width).to(tl.float32) + 0.5 - 0.5 * width
    y = (pixel // width).to(tl.float32) + 0.5 - 0.5 * height
    if HAS_DEPTH:
        mask = inside & (tl.load(depth_trusted + pixel, mask=inside, other=0) != 0)
        a = tl.load(alpha + pixel, mask=mask, other=0.0)
        wanted = tl.load(depth + pixel, mask=mask, other=1.0)
        difference = tl.load(image + at + 3, mask=mask, other=0.0) - a * wanted
        sign = _sign(difference) * (depth_weight / (width * height))
        depth_error = tl.abs(difference) / wanted
        toward_depth = sign / wanted
        toward_alpha -= sign
    if HAS_FLOW:
        mask, a = _flow_counts(image, alpha, flow_trusted, pixel, inside, channels, FLOW, HELD, BY_ALPHA)
        u, v = tl.load(image + at + 4, mask=mask, other=0.0), tl.load(image + at + 5, mask=mask, other=0.0)
        if FLOW == 6:
            u += tl.load(image + at + 6, mask=mask, other=0.0) * x + tl.load(image + at + 7, mask=mask, other=0.0) * y
            v += tl.load(image + at + 8, mask=mask, other=0.0) * x + tl.load(image + at + 9, mask=mask, other=0.0) * y
        wanted_u = tl.load(flow + pixel * 2, mask=mask, other=0.0)
        wanted_v = tl.load(flow + pixel * 2 + 1, mask=mask, other=0.0)
        share = flow_weight / (2.0 * tl.maximum(tl.load(counted), 1).to(tl.float32))
        if BY_ALPHA:
            du, dv = u - a * wanted_u, v - a * wanted_v
        else:
            du, dv = u - wanted_u, v - wanted_v
        flow_error = tl.where(mask, tl.abs(du) + tl.abs(dv), 0.0)
        gu, gv = tl.where(mask, share * _sign(du), 0.0), tl.where(mask, share * _sign(dv), 0.0)
        if BY_ALPHA:
            toward_alpha -= gu * wanted_u + gv * wanted_v
    for c in tl.static_range(3, CHANNELS):
        value = nothing
        if c == 3:
            value = toward_depth
        elif c == 4 and FLOW > 0:
            value = gu
        elif c == 5 and FLOW > 0:
            value = gv
        elif c == 6 and FLOW == 6:
            value = gu * x
        elif c == 7 and FLOW == 6:
            value = gu * y
        elif c == 8 and FLOW == 6:
            value = gv * x
        elif c == 9 and FLOW == 6:
            value = gv * y
        tl.store(gradient + at + c, value, mask=inside)
    tl.store(alpha_gradient + pixel, toward_alpha, mask=inside)
    tl.store(sums + tl.program_id(0), tl.sum(flow_error, 0))
    tl.store(sums + tl.num_programs(0) + tl.program_id(0), tl.sum(depth_error, 0))


class _PhotometricLoss(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, image: Tensor, alpha: Tensor, flow_channels: int, targets: PhotometricTargets, weights: PhotometricWeights
    ) -> tuple[Tensor, ImageFigures]:
        targets = targets.to(image.device)
        image, alpha = image.detach().contiguous(), alpha.detach().contiguous()
        height, width, channels = image.shape
        colors, pixels, device = height * width * 3, height * width, image.device
        gradient, alpha_gradient = torch.empty_like(image), torch.empty_like(alpha)
        block, pixel_block = rows_per_program(colors), rows_per_program(pixels)
        programs, pixel_programs = triton.cdiv(colors, block), triton.cdiv(pixels, pixel_block)
        blurred, derivatives = torch.empty(4, colors, device=device), torch.empty(3, colors, device=device)
        similarity, color_sums = torch.empty(programs, device=device), torch.empty(2, programs, device=device)
        with device_of(image):
            grid = (programs,)
            _blur_products[grid](image, targets.color, blurred, width, height, channels, BLOCK=block)
            _derivatives[grid](blurred, derivatives, similarity, width, height, BLOCK=block)
            _blur_derivatives[grid](derivatives, blurred, width, height, BLOCK=block)
            _color_gradient[grid](
                image, targets.color, blurred, gradient, color_sums, float(weights.ssim), width, height, channels, BLOCK=block
            )
        has_flow = targets.flow is not None and weights.flow > 0
        has_depth = targets.depth is not None and weights.depth > 0
        flow_weight, depth_weight = float(weights.flow) if has_flow else 0.0, float(weights.depth) if has_depth else 0.0
        kind = {"FLOW": flow_channels, "HELD": channels > 4 + flow_channels, "BY_ALPHA": weights.flow_by_alpha}
        counted, others = torch.zeros((), dtype=torch.int64, device=device), torch.empty(2, pixel_programs, device=device)
        with device_of(image):
            grid = (pixel_programs,)
            if has_flow:
                counts = torch.empty(pixel_programs, dtype=torch.int32, device=device)
                _count_flow[grid](image, alpha, _bytes(targets.flow_trusted), counts, pixels, channels, **kind, BLOCK=pixel_block)
                counted = counts.sum()
            _other_gradients[grid](
                image, alpha, targets.flow if has_flow else image, _bytes(targets.flow_trusted if has_flow else None), counted,
                targets.depth if has_depth else image, _bytes(targets.depth_trusted if has_depth else None), gradient,
                alpha_gradient, others, flow_weight, depth_weight, width, height, channels, CHANNELS=channels, **kind,
                HAS_FLOW=has_flow, HAS_DEPTH=has_depth, BLOCK=pixel_block,
            )  # fmt: skip
        ctx.save_for_backward(gradient, alpha_gradient)
        ssim = similarity.sum(dtype=torch.float64) / colors
        absolute, squared = color_sums.sum(1, dtype=torch.float64) / colors
        flow_sum, depth_sum = others.sum(1, dtype=torch.float64)
        figures = ImageFigures(
            color=(1 - weights.ssim) * absolute + weights.ssim * (1 - ssim),
            flow=flow_sum / (2 * counted.clamp(min=1)),
            depth=depth_sum / pixels,
            squared_error=squared,
        )
        total = figures.color + flow_weight * figures.flow + depth_weight * figures.depth
        assert isinstance(total, Tensor)
        return total.to(image.dtype), figures

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor, _: Any) -> tuple[Tensor, Tensor, None, None, None]:
        gradient, alpha_gradient = ctx.saved_tensors
        return grad * gradient, grad * alpha_gradient, None, None, None


def _bytes(trusted: Any) -> Any:
    """Return a mask as kernels read it."""
    return None if trusted is None else trusted.view(torch.uint8)


def photometric_loss(
    image: Tensor, alpha: Tensor, flow_channels: int, targets: PhotometricTargets, weights: PhotometricWeights
) -> tuple[Tensor, ImageFigures]:
    """See ``api.photometric_loss``; the figures are tensors."""
    result: tuple[Tensor, ImageFigures] = _PhotometricLoss.apply(image, alpha, flow_channels, targets, weights)
    return result
