"""From projected Gaussians to the list of Gaussians of every tile, in depth order.

One sort over the visible Gaussians (not over pairs of tile and depth), then a stable counting sort into tiles, which keeps
the depth order for free. Instances are exact: a Gaussian enters only the tiles, and within a tile only the rows, that its
alpha >= 1/255 ellipse touches.
"""

from __future__ import annotations

import math

import numpy as np
from numba import float32, int64, njit, prange, uint32

from flowsplat.common.kernels import OPTIONS
from flowsplat.splatting.cpu.projection import HALF, ONE, ZERO
from flowsplat.splatting.cpu.simd import BLOCK_HEIGHT, BLOCK_WIDTH
from flowsplat.splatting.rules import ALPHA_MIN

TILE_WIDTH = BLOCK_WIDTH  # one block of pixels wide
TILE_HEIGHT = 32
GEOMETRY = 6  # leading entries of a record: x, y, three of the exponent, log2 opacity
EXPONENT = np.float32(1.4426950408889634 / 8)  # from a natural exponent to one in base 2 divided by 8
CUT = np.float32(math.log2(ALPHA_MIN) / 8)  # of the exponent: below it nothing is drawn


@njit(**OPTIONS)
def sort_by_depth(depth_bits, extents, order, keys_a, keys_b, values):
    """Radix sort of the visible Gaussians by the bits of their (positive) depth; ties keep index order. Returns their number."""
    histogram = np.zeros((3, 2048), np.uint32)
    visible = 0
    for i in range(depth_bits.shape[0]):
        if extents[i] > ZERO:
            bits = depth_bits[i]
            keys_a[visible] = bits
            values[visible] = i
            visible += 1
            histogram[0, bits & uint32(2047)] += uint32(1)
            histogram[1, (bits >> uint32(11)) & uint32(2047)] += uint32(1)
            histogram[2, bits >> uint32(22)] += uint32(1)
    for digit in range(3):
        total = uint32(0)
        for bucket in range(2048):
            count = histogram[digit, bucket]
            histogram[digit, bucket] = total
            total += count
    for digit in range(3):
        shift = uint32(11 * digit)
        if digit == 1:
            keys_in, values_in, keys_out, values_out = keys_b, order, keys_a, values
        else:
            keys_in, values_in, keys_out, values_out = keys_a, values, keys_b, order
        for i in range(visible):
            bucket = (keys_in[i] >> shift) & uint32(2047)
            place = histogram[digit, bucket]
            histogram[digit, bucket] = place + uint32(1)
            keys_out[place] = keys_in[i]
            values_out[place] = values_in[i]
    return visible


@njit(inline="always", **OPTIONS)
def _ellipse(records, o, width):
    """Of the ellipse in which a record is drawn: a, b, c and limit of a x^2 + 2 b x y + c y^2 <= limit, its determinant, and
    the first and last column of pixels that it covers (first > last: none)."""
    a, b, c, limit = -records[o + 2], -HALF * records[o + 3], -records[o + 4], max(records[o + 5] - CUT, ZERO)
    determinant = a * c - b * b
    half = math.sqrt(limit * c / determinant)
    left = max(math.ceil(records[o] - half - HALF), ZERO)
    right = min(math.floor(records[o] + half - HALF), float32(width - 1))
    return a, b, c, limit, determinant, left, right


@njit(parallel=True, **OPTIONS)
def pack(visible, order, means2d, conics, opacities, features, width, records, stride, column_offsets):
    """One record a Gaussian in depth order, the exponent in base 2 and divided by 8 (see ``blending``).

    column_offsets[s] becomes the number of tile columns that Gaussian s touches.
    """
    channels = features.shape[1]
    for s in prange(visible):
        i = int64(order[s])
        o = s * stride
        records[o] = means2d[i, 0]
        records[o + 1] = means2d[i, 1]
        records[o + 2] = -HALF * conics[i, 0] * EXPONENT
        records[o + 3] = -conics[i, 1] * EXPONENT
        records[o + 4] = -HALF * conics[i, 2] * EXPONENT
        records[o + 5] = math.log2(opacities[i]) * float32(0.125)
        for c in range(channels):
            records[o + GEOMETRY + c] = features[i, c]
        _, _, _, _, _, left, right = _ellipse(records, o, width)
        column_offsets[s] = int(right) // TILE_WIDTH - int(left) // TILE_WIDTH + 1 if left <= right else 0


@njit(parallel=True, **OPTIONS)
def cut_strips(visible, records, stride, width, height, column_offsets, strips, chunk_counts, instance_offsets):
    """For every tile column of a Gaussian the image rows [first, last] that its ellipse covers there.

    strips [S, 3]: tile column, first row, last row (first > last: none). chunk_counts [chunks, tiles] counts the instances a
    tile gets from a chunk of Gaussians; instance_offsets[s + 1] the instances of Gaussian s.
    """
    tile_columns = (width + TILE_WIDTH - 1) // TILE_WIDTH
    chunks = chunk_counts.shape[0]
    for chunk in prange(chunks):
        for s in range(visible * chunk // chunks, visible * (chunk + 1) // chunks):
            o = s * stride
            a, b, c, limit, determinant, left, right = _ellipse(records, o, width)
            x, y = records[o], records[o + 1]
            lowest = -b * math.sqrt(limit / (a * determinant))  # x offset of the ellipse's lowest point in the image
            inverse = ONE / c
            tile_x = int(left) // TILE_WIDTH
            instances = 0
            for k in range(column_offsets[s], column_offsets[s + 1]):
                low = max(float32(tile_x * TILE_WIDTH), left) + HALF - x
                high = min(float32(tile_x * TILE_WIDTH + TILE_WIDTH - 1), right) + HALF - x
                d = min(max(lowest, low), high)
                bottom = y + (-b * d + math.sqrt(max(limit * c - determinant * d * d, ZERO))) * inverse
                d = min(max(-lowest, low), high)
                top = y + (-b * d - math.sqrt(max(limit * c - determinant * d * d, ZERO))) * inverse
                first = int(min(max(math.ceil(top - HALF), ZERO), float32(height)))
                last = int(max(min(math.floor(bottom - HALF), float32(height - 1)), float32(-1)))
                strips[k, 0] = tile_x
                strips[k, 1] = first
                strips[k, 2] = last
                if first <= last:
                    for tile_y in range(first // TILE_HEIGHT, last // TILE_HEIGHT + 1):
                        chunk_counts[chunk, tile_y * tile_columns + tile_x] += 1
                        instances += 1
                tile_x += 1
            instance_offsets[s + 1] = instances


@njit(parallel=True, **OPTIONS)
def fill_tiles(visible, width, column_offsets, strips, chunk_counts, instance_offsets, instances):
    """instances [I, 3]: Gaussian (depth order), first | last << 8 row of blocks within the tile, slot (grouped by Gaussian).

    chunk_counts holds where each chunk writes in each tile, so the result does not depend on the number of chunks.
    """
    tile_columns = (width + TILE_WIDTH - 1) // TILE_WIDTH
    chunks = chunk_counts.shape[0]
    for chunk in prange(chunks):
        for s in range(visible * chunk // chunks, visible * (chunk + 1) // chunks):
            slot = instance_offsets[s]
            for k in range(column_offsets[s], column_offsets[s + 1]):
                tile_x, first, last = strips[k, 0], strips[k, 1], strips[k, 2]
                if first <= last:
                    for tile_y in range(first // TILE_HEIGHT, last // TILE_HEIGHT + 1):
                        tile = tile_y * tile_columns + tile_x
                        place = chunk_counts[chunk, tile]
                        chunk_counts[chunk, tile] = place + 1
                        row = tile_y * TILE_HEIGHT
                        instances[place, 0] = s
                        top, bottom = max(first - row, 0) // BLOCK_HEIGHT, min(last - row, TILE_HEIGHT - 1) // BLOCK_HEIGHT
                        instances[place, 1] = top | bottom << 8
                        instances[place, 2] = slot
                        slot += 1


@njit(**OPTIONS)
def prefix_sum(values, count):
    """values[k] becomes the sum of the first k entries, for k = 0 .. count."""
    total = 0
    for k in range(count):
        value = values[k]
        values[k] = total
        total += value
    values[count] = total
    return total


@njit(**OPTIONS)
def tile_ranges(chunk_counts, tile_offsets):
    """Turn counts into write positions (tile by tile, chunk by chunk) and tile_offsets [tiles + 1]."""
    total = 0
    chunks, tiles = chunk_counts.shape
    for tile in range(tiles):
        tile_offsets[tile] = total
        for chunk in range(chunks):
            count = chunk_counts[chunk, tile]
            chunk_counts[chunk, tile] = total
            total += count
    tile_offsets[tiles] = total
