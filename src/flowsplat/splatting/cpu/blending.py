"""Blend the Gaussians of every tile front to back, and the gradient. Oracle: ``reference.blend``.

A tile is 16 x 16 pixels; a row of it is one vector. The state of a row lies together (transmittance, then the channels), so
that a row touches consecutive cache lines. The transmittance of a pixel that has stopped is stored negative: its magnitude
is the final value, and max(T, 0) makes every later weight zero without a branch.

The exponent is e = log2(alpha) / 8: alpha = p(e)^8 with p a polynomial for 2^e on [-1, 0], since alpha >= 1/255 means
e >= -0.9993. Relative error 1e-6.
"""

from __future__ import annotations

import math

import numpy as np
from numba import float32, int64, njit, prange

from flowsplat.splatting.cpu.projection import HALF, ONE, OPTIONS, ZERO
from flowsplat.splatting.cpu.simd import (
    add_features,
    align_stack,
    broadcast,
    dot_features,
    largest_lane,
    load,
    maximum,
    minus_magnitude,
    pixel_centers,
    prefetch,
    reciprocal,
    store,
    store_sums,
    where_above,
    where_at_least,
)
from flowsplat.splatting.cpu.tiles import GEOMETRY, TILE_HEIGHT, TILE_WIDTH
from flowsplat.splatting.rules import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN

CUT = np.float32(math.log2(ALPHA_MIN) / 8)
LIMIT = np.float32(ALPHA_MAX)
STOP = np.float32(TRANSMITTANCE_MIN)
CHECK_EVERY = 32


def _fit_exp2(degree: int) -> np.ndarray:
    """Coefficients of 2^x on [-1, 0], nearly minimax in relative error (iteratively reweighted least squares)."""
    x = np.cos(np.linspace(0, np.pi, 4001)) / 2 - 0.5
    basis = np.stack([x**k for k in range(degree + 1)], 1) / 2.0 ** x[:, None]
    weights = np.ones_like(x)
    for _ in range(200):
        coefficients = np.linalg.lstsq(basis * weights[:, None], weights, rcond=None)[0]
        error = np.abs(basis @ coefficients - 1)
        weights *= (error / error.max() + 1e-3) ** 0.5
        weights /= weights.max()
    return coefficients.astype(np.float32)


E0, E1, E2, E3, E4, E5 = _fit_exp2(5)


@njit(inline="always", **OPTIONS)
def _alpha(exponent):
    """Unclamped alpha, zero below the cut."""
    value = ((((exponent * E5 + E4) * exponent + E3) * exponent + E2) * exponent + E1) * exponent + E0
    value = value * value
    value = value * value
    value = value * value
    return where_at_least(exponent, CUT, value, broadcast(ZERO))


@njit(**OPTIONS)
def _blend_tile(pixels, left, top, records, stride, instances, begin, end, channels):
    """Blend instances begin..end over one tile. Returns where it stopped."""
    align_stack()
    row_size = TILE_WIDTH * (len(channels) + 1)
    lanes, zero, limit = pixel_centers(), broadcast(ZERO), broadcast(LIMIT)
    p = begin
    while p < end:
        group_end = min(p + CHECK_EVERY, end)
        while p < group_end:
            o = int64(instances[p, 0]) * stride
            rows = instances[p, 1]
            prefetch(records, int64(instances[min(p + 4, end - 1), 0]) * stride)
            first, last = int64(rows & 255), int64(rows >> 8)
            a, b, c, log_opacity = records[o + 2], records[o + 3], records[o + 4], records[o + 5]
            dx = lanes + (left - records[o])
            adx = dx * a
            dy = top + float32(first) - records[o + 1]
            for row in range(first * row_size, last * row_size + 1, row_size):
                raw = _alpha((adx + b * dy) * dx + (c * dy * dy + log_opacity))
                alpha = where_above(raw, LIMIT, limit, raw)
                stored = load(pixels, row)
                before = maximum(stored, zero)
                after = before - alpha * before
                store(pixels, row, where_above(after, STOP, after, minus_magnitude(stored)))
                weight = where_above(after, STOP, before - after, zero)
                add_features(pixels, row + TILE_WIDTH, weight, records, o + GEOMETRY, channels)
                dy += ONE
            p += 1
        highest = load(pixels, 0)
        for row in range(row_size, TILE_HEIGHT * row_size, row_size):
            highest = maximum(highest, load(pixels, row))
        if largest_lane(highest) <= ZERO:
            break
    return p


@njit(parallel=True, **OPTIONS)
def blend_forward(
    width, height, records, stride, instances, tile_offsets, image, transmittance, tile_stops, channels
):
    """Fill image [H, W, C] and transmittance [H, W]; tile_stops[t] is where backward may stop."""
    tile_columns = (width + TILE_WIDTH - 1) // TILE_WIDTH
    row_size = TILE_WIDTH * (len(channels) + 1)
    for tile in prange(tile_stops.shape[0]):
        tile_y, tile_x = tile // tile_columns, tile % tile_columns
        y0, x0 = tile_y * TILE_HEIGHT, tile_x * TILE_WIDTH
        # One line of padding on both sides keeps the vector loads of the last row inside the array.
        pixels = np.zeros(TILE_HEIGHT * row_size + TILE_WIDTH, np.float32)
        rows, columns = min(TILE_HEIGHT, height - y0), min(TILE_WIDTH, width - x0)
        for y in range(rows):
            for x in range(columns):
                pixels[y * row_size + x] = ONE
        tile_stops[tile] = _blend_tile(
            pixels, float32(x0), float32(y0) + HALF, records, stride, instances,
            int64(tile_offsets[tile]), int64(tile_offsets[tile + 1]), channels,
        )  # fmt: skip
        for y in range(rows):
            base = y * row_size
            for x in range(columns):
                transmittance[y0 + y, x0 + x] = abs(pixels[base + x])
                for c in range(len(channels)):
                    image[y0 + y, x0 + x, c] = pixels[base + TILE_WIDTH * (c + 1) + x]


@njit(**OPTIONS)
def _tile_gradient(pixels, left, top, records, stride, instances, begin, stop, end, sums, out, geometry, channels):
    """Replay one tile front to back; every instance writes one record of sums to its slot.

    A row holds the transmittance, then R = the gradient times everything that is still to be drawn behind, then the
    gradient of every channel.
    """
    align_stack()
    row_size = TILE_WIDTH * (len(channels) + 2)
    lanes, zero, one, limit = pixel_centers(), broadcast(ZERO), broadcast(ONE), broadcast(LIMIT)
    for p in range(begin, stop):
        o = int64(instances[p, 0]) * stride
        rows = instances[p, 1]
        prefetch(records, int64(instances[min(p + 4, end - 1), 0]) * stride)
        first, last = int64(rows & 255), int64(rows >> 8)
        a, b, c, log_opacity = records[o + 2], records[o + 3], records[o + 4], records[o + 5]
        dx = lanes + (left - records[o])
        adx = dx * a
        dy = top + float32(first) - records[o + 1]
        for k in range(len(channels)):
            store(sums, TILE_WIDTH * (GEOMETRY + k), zero)
        g0, g1, g2 = zero, zero, zero
        for row in range(first * row_size, last * row_size + 1, row_size):
            raw = _alpha((adx + b * dy) * dx + (c * dy * dy + log_opacity))
            alpha = where_above(raw, LIMIT, limit, raw)
            stored = load(pixels, row)
            before = maximum(stored, zero)
            after = before - alpha * before
            store(pixels, row, where_above(after, STOP, after, minus_magnitude(stored)))
            weight = where_above(after, STOP, before - after, zero)
            toward = weight * dot_features(
                pixels, row + 2 * TILE_WIDTH, weight, records, o + GEOMETRY, sums, TILE_WIDTH * GEOMETRY, channels
            )
            behind = load(pixels, row + TILE_WIDTH) - toward
            store(pixels, row + TILE_WIDTH, behind)
            gradient = toward - behind * (alpha * reciprocal(one - alpha))
            # No gradient where alpha is clamped, and none where the Gaussian was not drawn.
            gradient = where_above(raw, LIMIT, zero, where_above(weight, ZERO, gradient, zero))
            g0 = g0 + gradient
            gradient_y = gradient * dy
            g1 = g1 + gradient_y
            g2 = g2 + gradient_y * dy
            dy += ONE
        gx = g0 * dx
        store(sums, 0, g0)
        store(sums, TILE_WIDTH, gx)
        store(sums, 2 * TILE_WIDTH, gx * dx)
        store(sums, 3 * TILE_WIDTH, g1)
        store(sums, 4 * TILE_WIDTH, g1 * dx)
        store(sums, 5 * TILE_WIDTH, g2)
        store_sums(sums, out, int64(instances[p, 2]) * stride, geometry, channels)
    for p in range(stop, end):
        o = int64(instances[p, 2]) * stride
        for k in range(stride):
            out[o + k] = ZERO


@njit(parallel=True, **OPTIONS)
def blend_backward(
    width, height, records, stride, instances, tile_offsets, tile_stops, image, transmittance, grad_image, grad_alphas, out,
    geometry, channels,
):  # fmt: skip
    """Fill out [I, stride]: what every instance contributes to the gradient of its Gaussian."""
    tile_columns = (width + TILE_WIDTH - 1) // TILE_WIDTH
    row_size = TILE_WIDTH * (len(channels) + 2)
    for tile in prange(tile_stops.shape[0]):
        tile_y, tile_x = tile // tile_columns, tile % tile_columns
        y0, x0 = tile_y * TILE_HEIGHT, tile_x * TILE_WIDTH
        pixels = np.zeros(TILE_HEIGHT * row_size + TILE_WIDTH, np.float32)
        sums = np.empty(TILE_WIDTH * (GEOMETRY + len(channels)), np.float32)
        for y in range(min(TILE_HEIGHT, height - y0)):
            base = y * row_size
            for x in range(min(TILE_WIDTH, width - x0)):
                pixels[base + x] = ONE
                behind = -transmittance[y0 + y, x0 + x] * grad_alphas[y0 + y, x0 + x]
                for c in range(len(channels)):
                    gradient = grad_image[y0 + y, x0 + x, c]
                    pixels[base + TILE_WIDTH * (c + 2) + x] = gradient
                    behind += gradient * image[y0 + y, x0 + x, c]
                pixels[base + TILE_WIDTH + x] = behind
        _tile_gradient(
            pixels, float32(x0), float32(y0) + HALF, records, stride, instances, int64(tile_offsets[tile]),
            int64(tile_stops[tile]), int64(tile_offsets[tile + 1]), sums, out, geometry, channels,
        )  # fmt: skip


@njit(parallel=True, **OPTIONS)
def gather_gradients(
    visible, order, instance_offsets, out, stride, conics, opacities, grad_means2d, grad_conics,
    grad_opacities, grad_features,
):  # fmt: skip
    """Sum the slots of every Gaussian, in order: no atomics, the same bits with any number of threads."""
    channels = grad_features.shape[1]
    for s in prange(visible):
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
                grad_features[i, c] += out[o + GEOMETRY + c]
        a, b, c = conics[i, 0], conics[i, 1], conics[i, 2]
        grad_means2d[i, 0] = a * gx + b * gy
        grad_means2d[i, 1] = b * gx + c * gy
        grad_conics[i, 0] = -HALF * gxx
        grad_conics[i, 1] = -gxy
        grad_conics[i, 2] = -HALF * gyy
        grad_opacities[i] = g / opacities[i]
