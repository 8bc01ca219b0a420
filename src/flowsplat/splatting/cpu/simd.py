"""Several float32 lanes as one value inside Numba kernels: 16 where the processor has AVX-512, 8 elsewhere.

LLVM knows vector types; where a register is narrower (NEON has 4 lanes) it splits them. Numba has no such type, so this
module gives it one (``f32xn``) with arithmetic operators and a few intrinsics. Functions that take ``channels`` take a tuple
with one (ignored) entry a feature channel: its length is part of the type, so kernels are compiled for each number of
channels from this one source, and Numba's cache on disk holds them. Tuples of vectors stay in registers as far as there are
enough.
"""

from __future__ import annotations

import operator
from typing import Any

from llvmlite import binding, ir
from numba import types
from numba.core import cgutils, config
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model


def _has_avx512() -> bool:
    """Whether Numba compiles for AVX-512 (``NUMBA_CPU_FEATURES`` included)."""
    if config.CPU_FEATURES is not None:
        return "+avx512f" in config.CPU_FEATURES.split(",")
    return bool(binding.get_host_cpu_features().get("avx512f"))


LANES = 16 if _has_avx512() else 8
BLOCK_WIDTH = 8
BLOCK_HEIGHT = LANES // BLOCK_WIDTH
"""A vector is a block of pixels, 8 x 2 or 8 x 1: small Gaussians fill it better than a row of 16."""
_I32 = ir.IntType(32)
_VECTOR = ir.VectorType(ir.FloatType(), LANES)
_INDICES = ir.VectorType(_I32, LANES)
_FAST = ("reassoc", "contract", "arcp", "nsz", "afn")


class _F32xN(types.Type):
    def __init__(self) -> None:
        super().__init__(name=f"f32x{LANES}")


f32xn = _F32xN()


@register_model(_F32xN)
class _F32xNModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, _VECTOR)


def _constant(value: float) -> ir.Constant:
    return ir.Constant(_VECTOR, [value] * LANES)


def _splat(builder: Any, scalar: Any) -> Any:
    single = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), scalar, ir.Constant(_I32, 0))
    return builder.shuffle_vector(single, ir.Constant(_VECTOR, ir.Undefined), ir.Constant(_INDICES, [0] * LANES))


def _define_operator(op: Any, instruction: str) -> None:
    @infer_global(op)
    class _Template(ConcreteTemplate):
        cases = [  # noqa: RUF012
            signature(f32xn, f32xn, f32xn),
            signature(f32xn, f32xn, types.float32),
            signature(f32xn, types.float32, f32xn),
        ]

    @lower_builtin(op, f32xn, f32xn)
    def _vector_vector(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return getattr(builder, instruction)(*args, flags=_FAST)

    @lower_builtin(op, f32xn, types.float32)
    def _vector_scalar(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return getattr(builder, instruction)(args[0], _splat(builder, args[1]), flags=_FAST)

    @lower_builtin(op, types.float32, f32xn)
    def _scalar_vector(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return getattr(builder, instruction)(_splat(builder, args[0]), args[1], flags=_FAST)


for _operator, _instruction in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
):
    _define_operator(_operator, _instruction)


def _element(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    """Pointer to one element of a contiguous float32 array."""
    return builder.gep(context.make_array(array_type)(context, builder, array).data, [index])


def _load(builder: Any, pointer: Any) -> Any:
    value = builder.load(builder.bitcast(pointer, _VECTOR.as_pointer()))
    value.align = 4
    return value


def _store(builder: Any, value: Any, pointer: Any) -> None:
    builder.store(value, builder.bitcast(pointer, _VECTOR.as_pointer())).align = 4


def _at(builder: Any, pointer: Any, offset: int) -> Any:
    return builder.gep(pointer, [ir.Constant(ir.IntType(64), offset)])


@intrinsic
def load(typingctx, array, index):
    """Lanes array[index : index + LANES]."""

    def codegen(context, builder, sig, args):
        return _load(builder, _element(context, builder, sig.args[0], *args))

    return f32xn(array, index), codegen


@intrinsic
def store(typingctx, array, index, value):
    """array[index : index + LANES] = value."""

    def codegen(context, builder, sig, args):
        _store(builder, args[2], _element(context, builder, sig.args[0], args[0], args[1]))
        return context.get_dummy_value()

    return types.void(array, index, value), codegen


@intrinsic
def broadcast(typingctx, scalar):
    """The same float32 in every lane."""

    def codegen(context, builder, sig, args):
        return _splat(builder, args[0])

    return f32xn(types.float32), codegen


@intrinsic
def block_columns(typingctx):
    """The x of every pixel centre of a block: 0.5 ... 7.5, once a row."""

    def codegen(context, builder, sig, args):
        return ir.Constant(_VECTOR, [lane % BLOCK_WIDTH + 0.5 for lane in range(LANES)])

    return f32xn(), codegen


@intrinsic
def block_rows(typingctx):
    """The row of every pixel of a block: 0, then 1."""

    def codegen(context, builder, sig, args):
        return ir.Constant(_VECTOR, [float(lane // BLOCK_WIDTH) for lane in range(LANES)])

    return f32xn(), codegen


@intrinsic
def where_at_least(typingctx, value, limit, chosen, otherwise):
    """Lane by lane: chosen where value >= limit, otherwise elsewhere."""

    def codegen(context, builder, sig, args):
        mask = builder.fcmp_ordered(">=", args[0], _splat(builder, args[1]))
        return builder.select(mask, args[2], args[3])

    return f32xn(f32xn, types.float32, f32xn, f32xn), codegen


@intrinsic
def where_above(typingctx, value, limit, chosen, otherwise):
    """Lane by lane: chosen where value > limit, otherwise elsewhere."""

    def codegen(context, builder, sig, args):
        mask = builder.fcmp_ordered(">", args[0], _splat(builder, args[1]))
        return builder.select(mask, args[2], args[3])

    return f32xn(f32xn, types.float32, f32xn, f32xn), codegen


@intrinsic
def maximum(typingctx, a, b):
    """The larger of two, lane by lane."""

    def codegen(context, builder, sig, args):
        return builder.select(builder.fcmp_ordered(">", args[0], args[1]), args[0], args[1])

    return f32xn(f32xn, f32xn), codegen


@intrinsic
def minimum(typingctx, a, b):
    """The smaller of two, lane by lane."""

    def codegen(context, builder, sig, args):
        return builder.select(builder.fcmp_ordered("<", args[0], args[1]), args[0], args[1])

    return f32xn(f32xn, f32xn), codegen


@intrinsic
def minus_magnitude(typingctx, value):
    """-abs(value), lane by lane."""

    def codegen(context, builder, sig, args):
        sign = ir.Constant(_INDICES, [0x80000000] * LANES)
        return builder.bitcast(builder.or_(builder.bitcast(args[0], _INDICES), sign), _VECTOR)

    return f32xn(f32xn), codegen


@intrinsic
def largest_lane(typingctx, value):
    """The largest of the lanes."""

    def codegen(context, builder, sig, args):
        kind = ir.FunctionType(ir.FloatType(), [_VECTOR])
        function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.vector.reduce.fmax.v{LANES}f32")
        return builder.call(function, [args[0]], fastmath=("nnan",))

    return types.float32(f32xn), codegen


@intrinsic
def no_sums(typingctx, channels):
    """A tuple of zero vectors, one a channel."""
    kind = types.UniTuple(f32xn, len(channels))

    def codegen(context, builder, sig, args):
        return context.make_tuple(builder, kind, [_constant(0.0)] * kind.count)

    return kind(channels), codegen


@intrinsic
def load_features(typingctx, record, start, channels):
    """A tuple of vectors: record[start + c] in every lane, for every channel c."""
    kind = types.UniTuple(f32xn, len(channels))

    def codegen(context, builder, sig, args):
        feature = _element(context, builder, sig.args[0], args[0], args[1])
        values = [_splat(builder, builder.load(_at(builder, feature, c))) for c in range(kind.count)]
        return context.make_tuple(builder, kind, values)

    return kind(record, start, channels), codegen


@intrinsic
def add_features(typingctx, pixels, row, weight, features):
    """pixels[row + LANES c :][:LANES] += weight * features[c] for every channel c."""

    def codegen(context, builder, sig, args):
        base = _element(context, builder, sig.args[0], args[0], args[1])
        for c, feature in enumerate(cgutils.unpack_tuple(builder, args[3])):
            slot = _at(builder, base, LANES * c)
            product = builder.fmul(args[2], feature, flags=_FAST)
            _store(builder, builder.fadd(_load(builder, slot), product, flags=_FAST), slot)
        return context.get_dummy_value()

    return types.void(pixels, row, f32xn, features), codegen


@intrinsic
def dot_features(typingctx, pixels, row, features):
    """sum_c pixels[row + LANES c :][:LANES] * features[c]."""

    def codegen(context, builder, sig, args):
        base = _element(context, builder, sig.args[0], args[0], args[1])
        result = _constant(0.0)
        for c, feature in enumerate(cgutils.unpack_tuple(builder, args[2])):
            product = builder.fmul(_load(builder, _at(builder, base, LANES * c)), feature, flags=_FAST)
            result = builder.fadd(result, product, flags=_FAST)
        return result

    return f32xn(pixels, row, features), codegen


@intrinsic
def add_weighted(typingctx, sums, pixels, row, weight):
    """sums[c] + weight * pixels[row + LANES c :][:LANES] for every channel c."""

    def codegen(context, builder, sig, args):
        base = _element(context, builder, sig.args[1], args[1], args[2])
        values = []
        for c, total in enumerate(cgutils.unpack_tuple(builder, args[0])):
            product = builder.fmul(args[3], _load(builder, _at(builder, base, LANES * c)), flags=_FAST)
            values.append(builder.fadd(total, product, flags=_FAST))
        return context.make_tuple(builder, sig.return_type, values)

    return sums(sums, pixels, row, f32xn), codegen


def _transposed_sums(builder: Any, vectors: list[Any]) -> Any:
    """Up to LANES vectors to one vector whose lane i is the sum over the lanes of vector i.

    Every stage adds the halves of two vectors into one. The shuffles are those that a processor does in one cheap
    instruction (whole quarters first, then within quarters); they leave the sums in an order that one permutation mends.
    """
    quarters = LANES // 4
    order = [[vector] * LANES for vector in range(LANES)]  # which vector's sum a lane holds a part of

    def add_halves(picks: list[int], step: int) -> None:
        """Of the joined lanes of two neighbours, add those of ``picks`` and those ``step`` further."""
        nonlocal vectors, order
        others = [lane + step for lane in picks]
        merged, places = [], []
        for k in range(0, len(order), 2):
            joined = order[k] + order[k + 1]
            places.append([joined[lane] for lane in picks])
            if k < len(vectors):
                a, b = vectors[k], vectors[k + 1] if k + 1 < len(vectors) else _constant(0.0)
                first, second = (builder.shuffle_vector(a, b, ir.Constant(_INDICES, lanes)) for lanes in (picks, others))
                merged.append(builder.fadd(first, second, flags=_FAST))
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
    return builder.shuffle_vector(vectors[0], vectors[0], ir.Constant(_INDICES, inverse))


@intrinsic
def store_sums(typingctx, geometry, features, out, index):
    """out[index + k] = sum over the lanes of the k-th vector of ``geometry`` and then ``features`` (tuples of vectors).

    Writes whole groups of LANES, the last one filled up with zeros.
    """

    def codegen(context, builder, sig, args):
        vectors = [*cgutils.unpack_tuple(builder, args[0]), *cgutils.unpack_tuple(builder, args[1])]
        target = _element(context, builder, sig.args[2], args[2], args[3])
        for group in range(0, len(vectors), LANES):
            _store(builder, _transposed_sums(builder, vectors[group : group + LANES]), _at(builder, target, group))
        return context.get_dummy_value()

    return types.void(geometry, features, out, index), codegen


@intrinsic
def prefetch(typingctx, array, index):
    """Ask for the cache line of array[index]."""

    def codegen(context, builder, sig, args):
        pointer = builder.bitcast(_element(context, builder, sig.args[0], *args), ir.IntType(8).as_pointer())
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
            slot = builder.alloca(_VECTOR)
            slot.align = 64
        kind = ir.FunctionType(ir.VoidType(), [slot.type])
        builder.call(ir.InlineAsm(kind, "", "r,~{memory}", side_effect=True), [slot])
        return context.get_dummy_value()

    return types.void(), codegen
