"""Blend the Gaussians of every tile front to back, and the gradient. Oracle: ``reference.blend``.

A tile is 8 x 64 pixels, cut into blocks of 8 x 2 (8 x 1 with narrower vectors) that are one vector each. The state of a block
lies together (transmittance, then the channels, then what slopes add to the first three of them), so that a block touches
consecutive cache lines. The transmittance of a pixel that has stopped is stored negative: its magnitude is the final value, and
max(T, 0) makes every later weight zero without a branch.

The exponent is e = log2(alpha) / 8: alpha = p(e)^8 with p a polynomial for 2^e on [-1, 0], since alpha >= 1/255 means
e >= -0.9993. Relative error 1e-6. Within a block it is e = P + Q dy + c dy^2 with dy the offset of the block's first row.
"""

from __future__ import annotations

import numpy as np
from numba import float32, int64

from flowsplat.common.kernels import helper, inline, kernel
from flowsplat.common.simd import (
    LANES,
    broadcast,
    largest_lane,
    load,
    maximum,
    minimum,
    minus_magnitude,
    store,
    where_above,
    where_at_least,
)
from flowsplat.splatting.cpu.projection import HALF, ONE, ZERO
from flowsplat.splatting.cpu.simd import (
    BLOCK_HEIGHT,
    BLOCK_WIDTH,
    add_features,
    add_weighted,
    align_stack,
    block_columns,
    block_rows,
    dot_features,
    load_features,
    no_sums,
    prefetch,
    store_sums,
)
from flowsplat.splatting.cpu.tiles import CUT, EXPONENT, GEOMETRY, TILE_HEIGHT, TILE_WIDTH
from flowsplat.splatting.rules import ALPHA_MAX, SLOPED_FEATURES, TRANSMITTANCE_MIN

BLOCKS = TILE_HEIGHT // BLOCK_HEIGHT
STEP = np.float32(BLOCK_HEIGHT)
LIMIT = np.float32(ALPHA_MAX)
STOP = np.float32(TRANSMITTANCE_MIN)
CHECK_EVERY = 32
"""Gaussians after which a block looks whether all its pixels have stopped. Chosen by eye."""
ABSOLUTE = 2
"""More sums for an instance where absolute gradients are asked for."""
SLOPES = 2
"""More of them, and more entries of a record, where Gaussians have slopes."""


# Coefficients of 2^x on [-1, 0], nearly minimax in relative error (least squares, reweighted until the errors were alike).
E0, E1, E2 = np.float32(0.99999994), np.float32(0.69314224), np.float32(0.24017219)
E3, E4, E5 = np.float32(0.055279724), np.float32(0.009188612), np.float32(0.00093878835)


@inline
def _alpha(exponent):
    """Unclamped alpha, zero below the cut."""
    value = ((((exponent * E5 + E4) * exponent + E3) * exponent + E2) * exponent + E1) * exponent + E0
    value = value * value
    value = value * value
    value = value * value
    return where_at_least(exponent, CUT, value, broadcast(ZERO))


@inline
def _lane(x, y):
    """Where pixel (x, y) of a tile lies: number of its block, lane in it."""
    return y // BLOCK_HEIGHT, y % BLOCK_HEIGHT * BLOCK_WIDTH + x


@helper
def _blend_tile(pixels, left, top, records, stride, instances, begin, end, sloped, channels):
    """Blend instances begin..end over one tile. Returns where it stopped. ``sloped`` has an entry where Gaussians have slopes."""
    align_stack()
    size = LANES * (len(channels) + 1 + len(sloped))
    columns, rows = block_columns(), block_rows()
    zero, limit = broadcast(ZERO), broadcast(LIMIT)
    p = begin
    while p < end:
        group_end = min(p + CHECK_EVERY, end)
        while p < group_end:
            o = int64(instances[p, 0]) * stride
            blocks = instances[p, 1]
            prefetch(records, int64(instances[min(p + 4, end - 1), 0]) * stride)
            first, last = int64(blocks & 255), int64(blocks >> 8)
            a, b, c = records[o + 2], records[o + 3], records[o + 4]
            dx = columns + (left - records[o])
            slope = b * dx + (c + c) * rows
            middle = (a * dx + b * rows) * dx + (c * rows * rows + records[o + 5])
            features = load_features(records, o + GEOMETRY, channels)
            slope_y, shade = ZERO, zero
            if len(sloped) > 0:
                slope_y = records[o + GEOMETRY + len(channels) + 1]
                shade = records[o + GEOMETRY + len(channels)] * dx + slope_y * rows
            dy = top + STEP * float32(first) - records[o + 1]
            for block in range(first * size, last * size + 1, size):
                alpha = minimum(_alpha((slope + c * dy) * dy + middle), limit)
                stored = load(pixels, block)
                before = maximum(stored, zero)
                weight = alpha * before
                after = before - weight
                store(pixels, block, where_above(after, STOP, after, minus_magnitude(stored)))
                weight = where_above(after, STOP, weight, zero)
                add_features(pixels, block + LANES, weight, features)
                if len(sloped) > 0:
                    added = block + LANES * (len(channels) + 1)
                    store(pixels, added, load(pixels, added) + weight * (shade + slope_y * dy))
                dy += STEP
            p += 1
        highest = load(pixels, 0)
        for block in range(size, BLOCKS * size, size):
            highest = maximum(highest, load(pixels, block))
        if largest_lane(highest) <= ZERO:
            break
    return p


@kernel
def blend_forward(
    begin, end, width, height, records, stride, instances, tile_offsets, image, transmittance, tile_stops, sloped, channels
):
    """Fill image [H, W, C] and transmittance [H, W]; tile_stops[t] is where backward may stop."""
    tile_columns = (width + TILE_WIDTH - 1) // TILE_WIDTH
    size = LANES * (len(channels) + 1 + len(sloped))
    for tile in range(begin, end):
        tile_y, tile_x = tile // tile_columns, tile % tile_columns
        y0, x0 = tile_y * TILE_HEIGHT, tile_x * TILE_WIDTH
        pixels = np.zeros(BLOCKS * size, np.float32)
        rows, columns = min(TILE_HEIGHT, height - y0), min(TILE_WIDTH, width - x0)
        for y in range(rows):
            for x in range(columns):
                block, lane = _lane(x, y)
                pixels[block * size + lane] = ONE
        tile_stops[tile] = _blend_tile(
            pixels, float32(x0), float32(y0) + HALF, records, stride, instances,
            int64(tile_offsets[tile]), int64(tile_offsets[tile + 1]), sloped, channels,
        )  # fmt: skip
        for y in range(rows):
            for x in range(columns):
                block, lane = _lane(x, y)
                base = block * size + lane
                transmittance[y0 + y, x0 + x] = abs(pixels[base])
                for c in range(len(channels)):
                    image[y0 + y, x0 + x, c] = pixels[base + LANES * (c + 1)]
                if len(sloped) > 0:
                    for c in range(SLOPED_FEATURES):
                        image[y0 + y, x0 + x, c] += pixels[base + LANES * (len(channels) + 1)]


@helper
def _tile_gradient(pixels, left, top, records, stride, instances, begin, stop, end, out, absolute, sloped, channels):
    """Replay one tile front to back; every instance writes one record of sums to its slot.

    A block holds the transmittance, then R = the gradient times everything that is still to be drawn behind, then the
    gradient of every channel, then of what slopes add. ``sloped`` has an entry where Gaussians have slopes. ``absolute`` has
    two entries where the absolute gradient of the 2D mean, summed over pixels (AbsGS), is wanted too, and none elsewhere.
    """
    align_stack()
    size = LANES * (len(channels) + 2 + len(sloped))
    columns, rows = block_columns(), block_rows()
    zero, limit, least = broadcast(ZERO), broadcast(LIMIT), broadcast(STOP)
    for p in range(begin, stop):
        o = int64(instances[p, 0]) * stride
        blocks = instances[p, 1]
        ahead = min(p + 4, end - 1)
        prefetch(records, int64(instances[ahead, 0]) * stride)
        prefetch(out, int64(instances[ahead, 2]) * stride)
        first, last = int64(blocks & 255), int64(blocks >> 8)
        a, b, c = records[o + 2], records[o + 3], records[o + 4]
        dx = columns + (left - records[o])
        slope = b * dx + (c + c) * rows
        middle = (a * dx + b * rows) * dx + (c * rows * rows + records[o + 5])
        features = load_features(records, o + GEOMETRY, channels)
        sums = no_sums(channels)
        slope_y, shade, tilted, tilted_y = ZERO, zero, zero, zero
        if len(sloped) > 0:
            slope_y = records[o + GEOMETRY + len(channels) + 1]
            shade = records[o + GEOMETRY + len(channels)] * dx + slope_y * rows
        dy = top + STEP * float32(first) - records[o + 1]
        g0, g1, g2, absolute_x, absolute_y = zero, zero, zero, zero, zero
        for block in range(first * size, last * size + 1, size):
            raw = _alpha((slope + c * dy) * dy + middle)
            alpha = minimum(raw, limit)
            stored = load(pixels, block)
            before = maximum(stored, zero)
            weight = alpha * before
            after = before - weight
            store(pixels, block, where_above(after, STOP, after, minus_magnitude(stored)))
            weight = where_above(after, STOP, weight, zero)
            toward = weight * dot_features(pixels, block + 2 * LANES, features)
            if len(sloped) > 0:
                added = weight * load(pixels, block + LANES * (len(channels) + 2))
                toward = toward + added * (shade + slope_y * dy)
                tilted = tilted + added
                tilted_y = tilted_y + added * dy
            sums = add_weighted(sums, pixels, block + 2 * LANES, weight)
            behind = load(pixels, block + LANES) - toward
            store(pixels, block + LANES, behind)
            # alpha / (1 - alpha) is weight / after where the Gaussian was drawn, and 0 elsewhere. No gradient where alpha
            # is clamped.
            gradient = where_above(raw, LIMIT, zero, toward - behind * (weight / maximum(after, least)))
            g0 = g0 + gradient
            gradient_y = gradient * dy
            g1 = g1 + gradient_y
            g2 = g2 + gradient_y * dy
            if len(absolute) > 0:
                absolute_x = absolute_x - minus_magnitude(gradient * ((a + a) * dx + b * (rows + dy)))
                absolute_y = absolute_y - minus_magnitude(gradient * (b * dx + (c + c) * (rows + dy)))
            dy += STEP
        # From offsets of the block to offsets of the pixel: y = dy + row.
        gy = g1 + rows * g0
        gyy = g2 + rows * (g1 + gy)
        gx = g0 * dx
        o = int64(instances[p, 2]) * stride
        if len(absolute) > 0:
            store_sums((g0, gx, gx * dx, gy, gy * dx, gyy, absolute_x, absolute_y), sums, out, o)
        elif len(sloped) > 0:
            store_sums((g0, gx, gx * dx, gy, gy * dx, gyy, tilted * dx, tilted_y + rows * tilted), sums, out, o)
        else:
            store_sums((g0, gx, gx * dx, gy, gy * dx, gyy), sums, out, o)
    for p in range(stop, end):
        o = int64(instances[p, 2]) * stride
        for k in range(stride):
            out[o + k] = ZERO


@kernel
def blend_backward(
    begin, end, width, height, records, stride, instances, tile_offsets, tile_stops, image, transmittance, grad_image, grad_alphas,
    out,
    absolute, sloped, channels,
):  # fmt: skip
    """Fill out [I, stride]: what every instance contributes to the gradient of its Gaussian."""
    tile_columns = (width + TILE_WIDTH - 1) // TILE_WIDTH
    size = LANES * (len(channels) + 2 + len(sloped))
    for tile in range(begin, end):
        tile_y, tile_x = tile // tile_columns, tile % tile_columns
        y0, x0 = tile_y * TILE_HEIGHT, tile_x * TILE_WIDTH
        pixels = np.zeros(BLOCKS * size, np.float32)
        for y in range(min(TILE_HEIGHT, height - y0)):
            for x in range(min(TILE_WIDTH, width - x0)):
                block, lane = _lane(x, y)
                base = block * size + lane
                pixels[base] = ONE
                behind = -transmittance[y0 + y, x0 + x] * grad_alphas[y0 + y, x0 + x]
                for c in range(len(channels)):
                    gradient = grad_image[y0 + y, x0 + x, c]
                    pixels[base + LANES * (c + 2)] = gradient
                    behind += gradient * image[y0 + y, x0 + x, c]
                pixels[base + LANES] = behind
                if len(sloped) > 0:
                    added = base + LANES * (len(channels) + 2)
                    for c in range(SLOPED_FEATURES):
                        pixels[added] += grad_image[y0 + y, x0 + x, c]
        _tile_gradient(
            pixels, float32(x0), float32(y0) + HALF, records, stride, instances, int64(tile_offsets[tile]),
            int64(tile_stops[tile]), int64(tile_offsets[tile + 1]), out, absolute, sloped, channels,
        )  # fmt: skip


@kernel
def gather_gradients(
    begin, end, order, instance_offsets, out, stride, conics, opacities, slopes, grad_means2d, grad_conics,
    grad_opacities, grad_features, grad_slopes, absolute,
):  # fmt: skip
    """Sum the slots of every Gaussian, in order: no atomics, the same bits with any number of threads.

    slopes and grad_slopes are [N, 2], or [0, 2] where there are none; absolute is [N, 2], added to, or [0, 2] where it is not
    asked for.
    """
    channels, with_absolute, with_slopes = grad_features.shape[1], absolute.shape[0] > 0, slopes.shape[0] > 0
    first_channel = GEOMETRY + (ABSOLUTE if with_absolute else 0) + (SLOPES if with_slopes else 0)
    for s in range(begin, end):
        i = int64(order[s])
        g, gx, gxx, gy, gxy, gyy = ZERO, ZERO, ZERO, ZERO, ZERO, ZERO
        for slot in range(instance_offsets[s], instance_offsets[s + 1]):
            o = slot * stride
            g += out[o]
            gx += out[o + 1]
            gxx += out[o + 2]
            gy += out[o + 3]
            gxy += out[o + 4]
            gyy += out[o + 5]
            for c in range(channels):
                grad_features[i, c] += out[o + first_channel + c]
            if with_absolute:
                absolute[i, 0] += out[o + GEOMETRY] / EXPONENT
                absolute[i, 1] += out[o + GEOMETRY + 1] / EXPONENT
            if with_slopes:
                grad_slopes[i, 0] += out[o + GEOMETRY]
                grad_slopes[i, 1] += out[o + GEOMETRY + 1]
        a, b, c = conics[i, 0], conics[i, 1], conics[i, 2]
        grad_means2d[i, 0] = a * gx + b * gy
        grad_means2d[i, 1] = b * gx + c * gy
        if with_slopes:
            brighter = ZERO
            for k in range(SLOPED_FEATURES):
                brighter += grad_features[i, k]
            grad_means2d[i, 0] -= slopes[i, 0] * brighter
            grad_means2d[i, 1] -= slopes[i, 1] * brighter
        grad_conics[i, 0] = -HALF * gxx
        grad_conics[i, 1] = -gxy
        grad_conics[i, 2] = -HALF * gyy
        grad_opacities[i] = g / opacities[i]
