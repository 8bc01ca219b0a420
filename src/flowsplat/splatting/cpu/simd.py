"""Sixteen float32 lanes as one value inside Numba kernels.

LLVM knows the type ``<16 x float>``: on AVX-512 it is one register, elsewhere LLVM splits it. Numba has no such type, so
this module gives it one (``f32x16``) with arithmetic operators and a few intrinsics. Functions that take ``channels`` take
a tuple with one (ignored) entry a feature channel: its length is part of the type, so kernels are compiled for each number
of channels from this one source, and Numba's cache on disk holds them.
"""

from __future__ import annotations

import operator
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

LANES = 16
_I32 = ir.IntType(32)
_VECTOR = ir.VectorType(ir.FloatType(), LANES)
_INDICES = ir.VectorType(_I32, LANES)
_FAST = ("reassoc", "contract", "arcp", "nsz", "afn")


class _F32x16(types.Type):
    def __init__(self) -> None:
        super().__init__(name="f32x16")


f32x16 = _F32x16()


@register_model(_F32x16)
class _F32x16Model(models.PrimitiveModel):
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
            signature(f32x16, f32x16, f32x16),
            signature(f32x16, f32x16, types.float32),
            signature(f32x16, types.float32, f32x16),
        ]

    @lower_builtin(op, f32x16, f32x16)
    def _vector_vector(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return getattr(builder, instruction)(*args, flags=_FAST)

    @lower_builtin(op, f32x16, types.float32)
    def _vector_scalar(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return getattr(builder, instruction)(args[0], _splat(builder, args[1]), flags=_FAST)

    @lower_builtin(op, types.float32, f32x16)
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
    """Lanes array[index : index + 16]."""

    def codegen(context, builder, sig, args):
        return _load(builder, _element(context, builder, sig.args[0], *args))

    return f32x16(array, index), codegen


@intrinsic
def store(typingctx, array, index, value):
    """array[index : index + 16] = value."""

    def codegen(context, builder, sig, args):
        _store(builder, args[2], _element(context, builder, sig.args[0], args[0], args[1]))
        return context.get_dummy_value()

    return types.void(array, index, value), codegen


@intrinsic
def broadcast(typingctx, scalar):
    """The same float32 in every lane."""

    def codegen(context, builder, sig, args):
        return _splat(builder, args[0])

    return f32x16(types.float32), codegen


@intrinsic
def pixel_centers(typingctx):
    """0.5, 1.5, ..., 15.5."""

    def codegen(context, builder, sig, args):
        return ir.Constant(_VECTOR, [lane + 0.5 for lane in range(LANES)])

    return f32x16(), codegen


@intrinsic
def where_at_least(typingctx, value, limit, chosen, otherwise):
    """Lane by lane: chosen where value >= limit, otherwise elsewhere."""

    def codegen(context, builder, sig, args):
        mask = builder.fcmp_ordered(">=", args[0], _splat(builder, args[1]))
        return builder.select(mask, args[2], args[3])

    return f32x16(f32x16, types.float32, f32x16, f32x16), codegen


@intrinsic
def where_above(typingctx, value, limit, chosen, otherwise):
    """Lane by lane: chosen where value > limit, otherwise elsewhere."""

    def codegen(context, builder, sig, args):
        mask = builder.fcmp_ordered(">", args[0], _splat(builder, args[1]))
        return builder.select(mask, args[2], args[3])

    return f32x16(f32x16, types.float32, f32x16, f32x16), codegen


@intrinsic
def maximum(typingctx, a, b):
    """The larger of two, lane by lane."""

    def codegen(context, builder, sig, args):
        return builder.select(builder.fcmp_ordered(">", args[0], args[1]), args[0], args[1])

    return f32x16(f32x16, f32x16), codegen


@intrinsic
def minus_magnitude(typingctx, value):
    """-abs(value), lane by lane."""

    def codegen(context, builder, sig, args):
        sign = ir.Constant(_INDICES, [0x80000000] * LANES)
        return builder.bitcast(builder.or_(builder.bitcast(args[0], _INDICES), sign), _VECTOR)

    return f32x16(f32x16), codegen


@intrinsic
def largest_lane(typingctx, value):
    """The largest of the 16 lanes."""

    def codegen(context, builder, sig, args):
        kind = ir.FunctionType(ir.FloatType(), [_VECTOR])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.vector.reduce.fmax.v16f32")
        return builder.call(function, [args[0]], fastmath=("nnan",))

    return types.float32(f32x16), codegen


@intrinsic
def reciprocal(typingctx, value):
    """1 / value for positive values, by an integer first guess and three Newton steps: no divider, no special cases."""

    def codegen(context, builder, sig, args):
        guess = builder.sub(ir.Constant(_INDICES, [0x7EF311C3] * LANES), builder.bitcast(args[0], _INDICES))
        result, two = builder.bitcast(guess, _VECTOR), _constant(2.0)
        for _ in range(3):
            error = builder.fsub(two, builder.fmul(args[0], result, flags=_FAST), flags=_FAST)
            result = builder.fmul(result, error, flags=_FAST)
        return result

    return f32x16(f32x16), codegen


@intrinsic
def add_features(typingctx, pixels, row, weight, record, start, channels):
    """pixels[row + 16 c :][:16] += weight * record[start + c] for every channel c."""

    def codegen(context, builder, sig, args):
        base = _element(context, builder, sig.args[0], args[0], args[1])
        feature = _element(context, builder, sig.args[3], args[3], args[4])
        for c in range(len(sig.args[5])):
            slot = _at(builder, base, LANES * c)
            value = _splat(builder, builder.load(_at(builder, feature, c)))
            product = builder.fmul(args[2], value, flags=_FAST)
            _store(builder, builder.fadd(_load(builder, slot), product, flags=_FAST), slot)
        return context.get_dummy_value()

    return types.void(pixels, row, f32x16, record, start, channels), codegen


@intrinsic
def dot_features(typingctx, pixels, row, weight, record, start, sums, first, channels):
    """Return sum_c g_c * record[start + c] with g_c = pixels[row + 16 c :][:16], and add weight * g_c to sums[first + 16 c]."""

    def codegen(context, builder, sig, args):
        base = _element(context, builder, sig.args[0], args[0], args[1])
        feature = _element(context, builder, sig.args[3], args[3], args[4])
        total = _element(context, builder, sig.args[5], args[5], args[6])
        result = _constant(0.0)
        for c in range(len(sig.args[7])):
            gradient = _load(builder, _at(builder, base, LANES * c))
            value = _splat(builder, builder.load(_at(builder, feature, c)))
            result = builder.fadd(result, builder.fmul(gradient, value, flags=_FAST), flags=_FAST)
            slot = _at(builder, total, LANES * c)
            product = builder.fmul(args[2], gradient, flags=_FAST)
            _store(builder, builder.fadd(_load(builder, slot), product, flags=_FAST), slot)
        return result

    return f32x16(pixels, row, f32x16, record, start, sums, first, channels), codegen


def _transposed_sums(builder: Any, vectors: list[Any]) -> Any:
    """Up to 16 vectors to one vector whose lane i is the sum over the lanes of vector i."""
    step = 1
    while step < LANES:
        merged = []
        for k in range(0, len(vectors), 2):
            a, b = vectors[k], vectors[k + 1] if k + 1 < len(vectors) else _constant(0.0)
            keep = [i if not i & step else LANES + i - step for i in range(LANES)]
            other = [i + step if not i & step else LANES + i for i in range(LANES)]
            first = builder.shuffle_vector(a, b, ir.Constant(_INDICES, keep))
            second = builder.shuffle_vector(a, b, ir.Constant(_INDICES, other))
            merged.append(builder.fadd(first, second, flags=_FAST))
        vectors, step = merged, step * 2
    return vectors[0]


@intrinsic
def store_sums(typingctx, sums, out, index, geometry, channels):
    """out[index + k] = sum over the lanes of sums[16 k :][:16], for as many k as ``geometry`` and ``channels`` have entries.

    Writes whole groups of 16, the last one filled up with zeros.
    """

    def codegen(context, builder, sig, args):
        count = len(sig.args[3]) + len(sig.args[4])
        source = _element(context, builder, sig.args[0], args[0], ir.Constant(ir.IntType(64), 0))
        target = _element(context, builder, sig.args[1], args[1], args[2])
        for group in range(0, count, LANES):
            vectors = [_load(builder, _at(builder, source, LANES * k)) for k in range(group, min(group + LANES, count))]
            _store(builder, _transposed_sums(builder, vectors), _at(builder, target, group))
        return context.get_dummy_value()

    return types.void(sums, out, index, geometry, channels), codegen


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
