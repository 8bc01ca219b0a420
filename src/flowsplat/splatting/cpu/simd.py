"""Blocks of pixels and the features of Gaussians as vectors (``common.simd``).

Functions that take ``channels`` take a tuple with one (ignored) entry a feature channel: its length is part of the type, so kernels
are compiled for each number of channels from this one source, and Numba's cache on disk holds them. Tuples of vectors stay in
registers as far as there are enough.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from flowsplat.common.simd import FAST, INDICES, LANES, VECTOR, at, constant, element, f32xn, load_lanes, splat, store_lanes

BLOCK_WIDTH = 8
"""Pixels of a row that are blended together."""
BLOCK_HEIGHT = LANES // BLOCK_WIDTH
"""A vector is a block of pixels, 8 x 2 or 8 x 1: small Gaussians fill it better than a row of 16."""
_I32 = ir.IntType(32)


@intrinsic
def block_columns(typingctx):
    """The x of every pixel center of a block: 0.5 ... 7.5, once a row."""

    def codegen(context, builder, sig, args):
        return ir.Constant(VECTOR, [lane % BLOCK_WIDTH + 0.5 for lane in range(LANES)])

    return f32xn(), codegen


@intrinsic
def block_rows(typingctx):
    """The row of every pixel of a block: 0, then 1."""

    def codegen(context, builder, sig, args):
        return ir.Constant(VECTOR, [float(lane // BLOCK_WIDTH) for lane in range(LANES)])

    return f32xn(), codegen


@intrinsic
def no_sums(typingctx, channels):
    """A tuple of zero vectors, one a channel."""
    kind = types.UniTuple(f32xn, len(channels))

    def codegen(context, builder, sig, args):
        return context.make_tuple(builder, kind, [constant(0.0)] * kind.count)

    return kind(channels), codegen


@intrinsic
def load_features(typingctx, record, start, channels):
    """A tuple of vectors: record[start + c] in every lane, for every channel c."""
    kind = types.UniTuple(f32xn, len(channels))

    def codegen(context, builder, sig, args):
        feature = element(context, builder, sig.args[0], args[0], args[1])
        values = [splat(builder, builder.load(at(builder, feature, c))) for c in range(kind.count)]
        return context.make_tuple(builder, kind, values)

    return kind(record, start, channels), codegen


@intrinsic
def add_features(typingctx, pixels, row, weight, features):
    """pixels[row + LANES c :][:LANES] += weight * features[c] for every channel c."""

    def codegen(context, builder, sig, args):
        base = element(context, builder, sig.args[0], args[0], args[1])
        for c, feature in enumerate(cgutils.unpack_tuple(builder, args[3])):
            slot = at(builder, base, LANES * c)
            product = builder.fmul(args[2], feature, flags=FAST)
            store_lanes(builder, builder.fadd(load_lanes(builder, slot), product, flags=FAST), slot)
        return context.get_dummy_value()

    return types.void(pixels, row, f32xn, features), codegen


@intrinsic
def dot_features(typingctx, pixels, row, features):
    """sum_c pixels[row + LANES c :][:LANES] * features[c]."""

    def codegen(context, builder, sig, args):
        base = element(context, builder, sig.args[0], args[0], args[1])
        result = constant(0.0)
        for c, feature in enumerate(cgutils.unpack_tuple(builder, args[2])):
            product = builder.fmul(load_lanes(builder, at(builder, base, LANES * c)), feature, flags=FAST)
            result = builder.fadd(result, product, flags=FAST)
        return result

    return f32xn(pixels, row, features), codegen


@intrinsic
def add_weighted(typingctx, sums, pixels, row, weight):
    """sums[c] + weight * pixels[row + LANES c :][:LANES] for every channel c."""

    def codegen(context, builder, sig, args):
        base = element(context, builder, sig.args[1], args[1], args[2])
        values = []
        for c, total in enumerate(cgutils.unpack_tuple(builder, args[0])):
            product = builder.fmul(args[3], load_lanes(builder, at(builder, base, LANES * c)), flags=FAST)
            values.append(builder.fadd(total, product, flags=FAST))
        return context.make_tuple(builder, sig.return_type, values)

    return sums(sums, pixels, row, f32xn), codegen


def _transpose_and_sum(builder: Any, vectors: list[Any]) -> Any:
    """Reduce up to LANES vectors to one vector whose lane i is the sum over the lanes of vector i.

    Every stage adds the halves of two vectors into one. The shuffles are those that a processor does in one cheap
    instruction (whole quarters first, then within quarters); they leave the sums in an order that one permutation mends.
    """
    quarters = LANES // 4
    order = [[vector] * LANES for vector in range(LANES)]  # which vector's sum a lane holds a part of

    def add_halves(picks: list[int], step: int) -> None:
        """Of the joined lanes of two neighbors, add those of ``picks`` and those ``step`` further."""
        nonlocal vectors, order
        others = [lane + step for lane in picks]
        merged, places = [], []
        for k in range(0, len(order), 2):
            joined = order[k] + order[k + 1]
            places.append([joined[lane] for lane in picks])
            if k < len(vectors):
                a, b = vectors[k], vectors[k + 1] if k + 1 < len(vectors) else constant(0.0)
                first, second = (builder.shuffle_vector(a, b, ir.Constant(INDICES, lanes)) for lanes in (picks, others))
                merged.append(builder.fadd(first, second, flags=FAST))
        vectors, order = merged, places

    def lanes_of(chosen_quarters: list[int]) -> list[int]:
        return [4 * quarter + lane for quarter in chosen_quarters for lane in range(4)]

    if quarters == 4:
        add_halves(lanes_of([0, 1, 4, 5]), 8)
        add_halves(lanes_of([0, 2, 4, 6]), 4)
    else:
        add_halves(lanes_of([0, 2]), 4)
    for pair, step in (([0, 1], 2), ([0, 2], 1)):
        add_halves([4 * q + lane for q in range(quarters) for lane in (*pair, *(LANES + p for p in pair))], step)
    inverse = [order[0].index(vector) for vector in range(LANES)]
    return builder.shuffle_vector(vectors[0], vectors[0], ir.Constant(INDICES, inverse))


@intrinsic
def store_sums(typingctx, geometry, features, out, index):
    """out[index + k] = sum over the lanes of the k-th vector of ``geometry`` and then ``features`` (tuples of vectors).

    Writes whole groups of LANES, the last one filled up with zeros.
    """

    def codegen(context, builder, sig, args):
        vectors = [*cgutils.unpack_tuple(builder, args[0]), *cgutils.unpack_tuple(builder, args[1])]
        target = element(context, builder, sig.args[2], args[2], args[3])
        for group in range(0, len(vectors), LANES):
            store_lanes(builder, _transpose_and_sum(builder, vectors[group : group + LANES]), at(builder, target, group))
        return context.get_dummy_value()

    return types.void(geometry, features, out, index), codegen


@intrinsic
def prefetch(typingctx, array, index):
    """Ask for the cache line of array[index]."""

    def codegen(context, builder, sig, args):
        pointer = builder.bitcast(element(context, builder, sig.args[0], *args), ir.IntType(8).as_pointer())
        kind = ir.FunctionType(ir.VoidType(), [pointer.type, _I32, _I32, _I32])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(function, [pointer, ir.Constant(_I32, 0), ir.Constant(_I32, 3), ir.Constant(_I32, 1)])
        return context.get_dummy_value()

    return types.void(array, index), codegen


@intrinsic
def align_stack(typingctx):
    """Make LLVM align the frame to 64 bytes, so that spilled vectors do not straddle cache lines (it halves the time)."""

    def codegen(context, builder, sig, args):
        with builder.goto_entry_block():
            slot = builder.alloca(VECTOR)
            slot.align = 64
        kind = ir.FunctionType(ir.VoidType(), [slot.type])
        builder.call(ir.InlineAsm(kind, "", "r,~{memory}", side_effect=True), [slot])
        return context.get_dummy_value()

    return types.void(), codegen
