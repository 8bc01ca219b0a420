"""Bin projected Gaussians into the list of Gaussians of every tile, in depth order.

One sort over the visible Gaussians (not over pairs of tile and depth), then a stable counting sort into tiles, which keeps
the depth order for free. Instances are exact: a Gaussian enters only the tiles, and within a tile only the rows, that its
alpha >= 1/255 ellipse touches.
"""

from __future__ import annotations

import math

import numpy as np
from numba import float32, int64, uint32

from flowsplat.common.kernels import inline, kernel, log
from flowsplat.splatting.cpu.projection import HALF, ONE, TWO, ZERO
from flowsplat.splatting.cpu.simd import BLOCK_HEIGHT, BLOCK_WIDTH, prefetch
from flowsplat.splatting.rules import ALPHA_MIN

TILE_WIDTH = BLOCK_WIDTH  # one block of pixels wide
TILE_HEIGHT = 64
"""Pixels. Chosen by eye."""
GEOMETRY = 6
"""Leading entries of a record: x, y, three of the exponent, log2 opacity."""
EXPONENT = np.float32(1.4426950408889634 / 8)  # from a natural exponent to one in base 2 divided by 8
LOG_ALPHA_MIN = np.float32(math.log(ALPHA_MIN))
MIN_CONIC = np.float32(1e-20)
CUT = np.float32(math.log2(ALPHA_MIN) / 8)  # of the exponent: below it nothing is drawn
BATCH_GAUSSIANS = 64
"""Gaussians that are packed before they are cut. Chosen by eye."""
PREFETCH = 8
"""Gaussians ahead whose scattered inputs are asked for. Chosen by eye."""


@kernel
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


@inline
def _pack(i, means2d, conics, opacities, features, slopes, last_column, records, o, ellipse):
    """The record of Gaussian i at records[o:], and the ellipse in which it is drawn.

    ellipse: center; the first and last column of pixels that it covers (first > last: none); then slope, top, bend and lowest:
    at an offset dx it reaches over y - slope dx +- sqrt(top - bend dx^2), and its lowest point in the image is at dx = lowest.
    """
    x, y, a, b, c = means2d[i, 0], means2d[i, 1], conics[i, 0], conics[i, 1], conics[i, 2]
    level = log(opacities[i])
    records[o] = x
    records[o + 1] = y
    records[o + 2] = -HALF * a * EXPONENT
    records[o + 3] = -b * EXPONENT
    records[o + 4] = -HALF * c * EXPONENT
    records[o + 5] = level * EXPONENT
    for channel in range(features.shape[1]):
        records[o + GEOMETRY + channel] = features[i, channel]
    if slopes.shape[0] > 0:
        end = o + GEOMETRY + features.shape[1]
        records[end], records[end + 1] = slopes[i, 0], slopes[i, 1]
    # Drawn is where a dx^2 + 2 b dx dy + c dy^2 <= limit.
    limit = max(TWO * (level - LOG_ALPHA_MIN), ZERO)
    # Of a very long and thin one the difference may come out as nothing, or below.
    inverse, inverse_determinant = ONE / c, ONE / max(a * c - b * b, MIN_CONIC)
    half = math.sqrt(limit * c * inverse_determinant)
    ellipse[0] = x
    ellipse[1] = y
    ellipse[2] = max(np.ceil(x - half - HALF), ZERO)
    ellipse[3] = min(np.floor(x + half - HALF), last_column)
    ellipse[4] = b * inverse
    ellipse[5] = limit * inverse
    ellipse[6] = inverse * inverse / inverse_determinant
    ellipse[7] = -b * math.sqrt(limit * inverse_determinant / a)


@kernel
def pack_and_cut(
    begin_chunk, end_chunk, visible, order, means2d, conics, opacities, features, slopes, width, height, records, stride, strips,
    strip_counts, columns,
    chunk_counts, instance_offsets,
):  # fmt: skip
    """One record a Gaussian in depth order, and for every tile column the image rows that its ellipse covers there.

    slopes is [N, 2], or [0, 2] where there are none. The exponent of a record is in base 2 and divided by 8 (see
    ``blending``). strips [chunks, capacity, 3] takes tile column,
    first and last row, Gaussian after Gaussian of a chunk, columns[s] of them for Gaussian s; strip_counts [chunks] says how
    many there are, also those that found no room. chunk_counts [chunks, tiles] counts the instances that a tile gets from a
    chunk; instance_offsets[s + 1] those of Gaussian s.
    """
    tile_columns = (width + TILE_WIDTH - 1) // TILE_WIDTH
    chunks, capacity = strips.shape[0], strips.shape[1]
    w, h = float32(width - 1), float32(height - 1)
    for chunk in range(begin_chunk, end_chunk):
        k = 0
        end = visible * (chunk + 1) // chunks
        ellipses = np.empty((BATCH_GAUSSIANS, 8), np.float32)
        for begin in range(visible * chunk // chunks, end, BATCH_GAUSSIANS):
            # How many columns a Gaussian has is a branch that no processor guesses; what it waits for is done before.
            size = min(BATCH_GAUSSIANS, end - begin)
            for s in range(begin, begin + size):
                ahead = int64(order[min(s + PREFETCH, end - 1)])
                prefetch(means2d, ahead * 2)
                prefetch(conics, ahead * 3)
                prefetch(features, ahead * features.shape[1])
                prefetch(opacities, ahead)
                _pack(int64(order[s]), means2d, conics, opacities, features, slopes, w, records, s * stride, ellipses[s - begin])
            for s in range(begin, begin + size):
                e = ellipses[s - begin]
                x, y, left, right, slope, top, bend, lowest = e[0], e[1], e[2], e[3], e[4], e[5], e[6], e[7]
                before, instances = k, 0
                # Where nothing is covered, the last column may lie before the first.
                for tile_x in range(int(left) // TILE_WIDTH, int(right) // TILE_WIDTH + 1):
                    low = max(float32(tile_x * TILE_WIDTH), left) + HALF - x
                    high = min(float32(tile_x * TILE_WIDTH + TILE_WIDTH - 1), right) + HALF - x
                    d, u = min(max(lowest, low), high), min(max(-lowest, low), high)
                    first = int(max(np.ceil(y - slope * u - math.sqrt(max(top - bend * u * u, ZERO)) - HALF), ZERO))
                    last = int(min(np.floor(y - slope * d + math.sqrt(max(top - bend * d * d, ZERO)) - HALF), h))
                    if first <= last and left <= right:
                        if k < capacity:
                            strips[chunk, k, 0] = tile_x
                            strips[chunk, k, 1] = first
                            strips[chunk, k, 2] = last
                        k += 1
                        first_tile, last_tile = first // TILE_HEIGHT, last // TILE_HEIGHT
                        instances += last_tile - first_tile + 1
                        for tile_y in range(first_tile, last_tile + 1):
                            chunk_counts[chunk, tile_y * tile_columns + tile_x] += 1
                columns[s] = k - before
                instance_offsets[s + 1] = instances
        strip_counts[chunk] = k


@kernel
def fill_tiles(begin, stop, visible, width, strips, columns, chunk_counts, instance_offsets, instances):
    """instances [I, 3]: Gaussian (depth order), first | last << 8 row of blocks within the tile, slot (grouped by Gaussian).

    chunk_counts holds where each chunk writes in each tile, so the result does not depend on the number of chunks.
    """
    tile_columns = (width + TILE_WIDTH - 1) // TILE_WIDTH
    chunks = chunk_counts.shape[0]
    for chunk in range(begin, stop):
        k = 0
        for s in range(visible * chunk // chunks, visible * (chunk + 1) // chunks):
            slot = instance_offsets[s]
            end = k + columns[s]
            while k < end:
                tile_x, first, last = strips[chunk, k, 0], strips[chunk, k, 1], strips[chunk, k, 2]
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
                k += 1


@kernel
def prefix_sum(values, count):
    """values[k] becomes the sum of the first k entries, for k = 0 .. count."""
    total = 0
    for k in range(count):
        value = values[k]
        values[k] = total
        total += value
    values[count] = total
    return total


@kernel
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
