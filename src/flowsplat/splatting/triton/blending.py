"""Blend the Gaussians of every tile front to back, and the gradient. Oracle: ``reference.blend``.

One program a tile of 16 x 16 pixels, all of them one tensor; channels are the *first* axis of the tensors that have them, so
that every thread holds all channels of its pixels, and sums over channels stay within it. The transmittance of a pixel that
has stopped is stored negative: its magnitude is the final value, and max(T, 0) makes every later weight zero.

Backward replays forward, front to back: one number a pixel, the gradient times everything that is still to be drawn behind,
is all it needs besides the transmittance.
"""

from __future__ import annotations

import math

import triton
import triton.language as tl

from flowsplat.splatting.rules import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from flowsplat.splatting.triton.tiles import RECORD, TILE

FORWARD_WARPS, BACKWARD_WARPS = 2, 1
"""With one warp, the sums of a tile need no shared memory and no barriers. Measured (docs/gpu.md)."""
CHECK_EVERY = 32
"""Gaussians after which a tile looks whether all its pixels have stopped. Measured (docs/gpu.md)."""
GAUSSIANS_PER_STEP = 4
"""Gaussians of which forward loads everything before it uses it. Measured (docs/gpu.md)."""
GEOMETRY = 8
"""Leading columns of a row of sums: two of the mean, three of the conic, opacity, two of the absolute gradient."""
SUMMED_ROWS = 8
"""Rows that are summed at once."""

_TILE, _RECORD, _GEOMETRY = tl.constexpr(TILE), tl.constexpr(RECORD), tl.constexpr(GEOMETRY)
_LIMIT, _STOP = tl.constexpr(ALPHA_MAX), tl.constexpr(TRANSMITTANCE_MIN)
_CUT = tl.constexpr(math.log2(ALPHA_MIN))
_LN2 = tl.constexpr(math.log(2))


@triton.jit
def _pixels(tile_columns, width, height):
    """The pixels of this program's tile: column, row, whether they are in the image."""
    tile = tl.program_id(0)
    p = tl.arange(0, _TILE * _TILE)
    column = (tile % tile_columns) * _TILE + p % _TILE
    row = (tile // tile_columns) * _TILE + p // _TILE
    return column, row, (column < width) & (row < height)


@triton.jit
def _alpha(a, b, c, level, dx, dy):
    """Unclamped alpha, zero below the cut."""
    exponent = (a * dx + b * dy) * dx + (c * dy * dy + level)
    return tl.where(exponent >= _CUT, tl.exp2(exponent), 0.0)


@triton.jit(do_not_specialize=["width", "height", "tile_columns"])
def blend_forward(
    records, features, gaussians, offsets, image, alphas, transmittance, stops, width, height, tile_columns,
    CHANNELS: tl.constexpr, PADDED: tl.constexpr, SAVE: tl.constexpr, CHECK_EVERY: tl.constexpr, TOGETHER: tl.constexpr,
):  # fmt: skip
    """Fill image [H, W, C] and alphas [H, W]; for backward (SAVE) transmittance [H, W], and stops [tiles], where it may stop."""
    tile = tl.program_id(0)
    column, row, inside = _pixels(tile_columns, width, height)
    x, y = column.to(tl.float32) + 0.5, row.to(tl.float32) + 0.5
    channel = tl.arange(0, PADDED)
    T = tl.where(inside, 1.0, -1.0)
    total = tl.zeros([PADDED, _TILE * _TILE], tl.float32)
    p, end = tl.load(offsets + tile), tl.load(offsets + tile + 1)
    highest = tl.max(T, axis=0)
    while (p < end) & (highest > 0):
        stop = tl.minimum(p + CHECK_EVERY, end)
        while p < stop:
            for k in tl.static_range(TOGETHER):
                there = p + k < stop
                i = tl.load(gaussians + p + k, mask=there, other=0).to(tl.int64)
                o = records + i * _RECORD
                # Of a culled Gaussian, as number 0 may be, there is only rubbish.
                a, b = tl.load(o + 2, mask=there, other=0.0), tl.load(o + 3, mask=there, other=0.0)
                c, level = tl.load(o + 4, mask=there, other=0.0), tl.load(o + 5, mask=there, other=-1e30)
                feature = tl.load(features + i * CHANNELS + channel, mask=(channel < CHANNELS) & there, other=0.0)
                alpha = tl.minimum(_alpha(a, b, c, level, x - tl.load(o), y - tl.load(o + 1)), _LIMIT)
                before = tl.maximum(T, 0.0)
                weight = alpha * before
                after = before - weight
                goes_on = after > _STOP
                T = tl.where(goes_on, after, -tl.abs(T))
                drawn = total + feature[:, None] * tl.where(goes_on, weight, 0.0)[None, :]
                total = tl.where((channel < CHANNELS)[:, None], drawn, 0.0)  # the compiler leaves out channels that are not there
            p += TOGETHER
        highest = tl.max(T, axis=0)
    pixel = row * width + column
    T = tl.abs(T)
    tl.store(alphas + pixel, 1 - T, mask=inside)
    if SAVE:
        tl.store(transmittance + pixel, T, mask=inside)
        tl.store(stops + tile, tl.minimum(p, end))
    in_image = image + pixel.to(tl.int64)[None, :] * CHANNELS + channel[:, None]
    tl.store(in_image, total, mask=inside[None, :] & (channel < CHANNELS)[:, None])


@triton.jit(do_not_specialize=["width", "height", "tile_columns"])
def blend_backward(
    records, features, gaussians, slots, offsets, stops, image, transmittance, grad_image, grad_alphas, out,
    width, height, tile_columns, CHANNELS: tl.constexpr, PADDED: tl.constexpr, STRIDE: tl.constexpr, ABSOLUTE: tl.constexpr,
):  # fmt: skip
    """Fill the rows of out [slots, STRIDE], zeros before, with what every slot contributes to the gradient of its Gaussian.

    ABSOLUTE: the absolute gradient of the 2D mean, summed over pixels (AbsGS), is wanted too.
    """
    tile = tl.program_id(0)
    column, row, inside = _pixels(tile_columns, width, height)
    x, y = column.to(tl.float32) + 0.5, row.to(tl.float32) + 0.5
    channel = tl.arange(0, PADDED)
    pixel = row * width + column
    in_image = pixel.to(tl.int64) * CHANNELS
    last = tl.load(transmittance + pixel, mask=inside, other=0.0)
    behind = -last * tl.load(grad_alphas + pixel, mask=inside, other=0.0)
    # One channel after the other: loaded all at once, neighboring threads would hold neighboring channels, not pixels, from
    # here to the end, and every sum over channels would go from thread to thread.
    gradient = tl.zeros([PADDED, _TILE * _TILE], tl.float32)
    for n in tl.static_range(CHANNELS):
        of_channel = tl.load(grad_image + in_image + n, mask=inside, other=0.0)
        behind += of_channel * tl.load(image + in_image + n, mask=inside, other=0.0)
        gradient = tl.where((channel == n)[:, None], of_channel[None, :], gradient)
    T = tl.where(inside, 1.0, -1.0)
    p, end = tl.load(offsets + tile), tl.load(stops + tile)
    while p < end:
        i = tl.load(gaussians + p).to(tl.int64)
        o = records + i * _RECORD
        a, b, c, level = tl.load(o + 2), tl.load(o + 3), tl.load(o + 4), tl.load(o + 5)
        feature = tl.load(features + i * CHANNELS + channel, mask=channel < CHANNELS, other=0.0)
        dx, dy = x - tl.load(o), y - tl.load(o + 1)
        raw = _alpha(a, b, c, level, dx, dy)
        before = tl.maximum(T, 0.0)
        weight = tl.minimum(raw, _LIMIT) * before
        after = before - weight
        goes_on = after > _STOP
        T = tl.where(goes_on, after, -tl.abs(T))
        weight = tl.where(goes_on, weight, 0.0)
        toward = weight * tl.sum(gradient * feature[:, None], axis=0)
        behind -= toward
        # alpha / (1 - alpha) is weight / after where the Gaussian was drawn, and 0 elsewhere. No gradient where alpha is
        # clamped.
        g = tl.where(raw > _LIMIT, 0.0, toward - behind * (weight / tl.maximum(after, _STOP)))
        gx, gy = g * dx, g * dy
        sum_x, sum_y = tl.sum(gx, axis=0), tl.sum(gy, axis=0)
        target = out + tl.load(slots + p) * STRIDE
        # The exponent is in base 2, and so are a, b and c: -ln2 (2 a, b, 2 c) is the conic.
        tl.store(target, (2 * a * sum_x + b * sum_y) * -_LN2)
        tl.store(target + 1, (b * sum_x + 2 * c * sum_y) * -_LN2)
        tl.store(target + 2, -0.5 * tl.sum(gx * dx, axis=0))
        tl.store(target + 3, -tl.sum(gx * dy, axis=0))
        tl.store(target + 4, -0.5 * tl.sum(gy * dy, axis=0))
        tl.store(target + 5, tl.sum(g, axis=0))
        if ABSOLUTE:
            tl.store(target + 6, tl.sum(tl.abs(2 * a * gx + b * gy), axis=0) * _LN2)
            tl.store(target + 7, tl.sum(tl.abs(b * gx + 2 * c * gy), axis=0) * _LN2)
        tl.store(target + _GEOMETRY + channel, tl.sum(gradient * weight[None, :], axis=1), mask=channel < CHANNELS)
        p += 1


@triton.jit(do_not_specialize=["capacity"])
def gather_gradients(
    order, counts, ends, out, opacities, grad_means2d, grad_conics, grad_opacities, grad_features, absolute, capacity,
    CHANNELS: tl.constexpr, COLUMNS: tl.constexpr, STRIDE: tl.constexpr, ROWS: tl.constexpr, ABSOLUTE: tl.constexpr,
):  # fmt: skip
    """Sum the rows of one Gaussian, in order; zeros where it has none. absolute [N, 2] is added to."""
    s = tl.program_id(0)
    i = tl.load(order + s)
    end = tl.load(ends + s)
    begin = end - tl.load(counts + s)
    end = tl.minimum(end, capacity)
    column = tl.arange(0, COLUMNS)
    sums = tl.zeros([ROWS, COLUMNS], tl.float32)
    while begin < end:
        slot = begin + tl.arange(0, ROWS)
        there = (slot < end)[:, None] & (column < _GEOMETRY + CHANNELS)[None, :]
        sums += tl.load(out + slot[:, None] * STRIDE + column[None, :], mask=there, other=0.0)
        begin += ROWS
    total = tl.sum(sums, axis=0)
    tl.store(grad_means2d + i * 2 + column, total, mask=column < 2)
    tl.store(grad_conics + i * 3 + column - 2, total, mask=(column >= 2) & (column < 5))
    # What was summed is the gradient of log(opacity); that of an undrawn Gaussian is 0, whatever its opacity.
    opacity = tl.load(opacities + i)
    tl.store(grad_opacities + i + column - 5, total / tl.where(opacity > 0, opacity, 1.0), mask=column == 5)
    if ABSOLUTE:
        wanted = (column >= 6) & (column < 8)
        sofar = tl.load(absolute + i * 2 + column - 6, mask=wanted, other=0.0)
        tl.store(absolute + i * 2 + column - 6, sofar + total, mask=wanted)
    tl.store(grad_features + i * CHANNELS + column - _GEOMETRY, total, mask=(column >= _GEOMETRY) & (column < _GEOMETRY + CHANNELS))
