"""Several float32 lanes as one value inside Numba kernels: 16 where the processor has AVX-512, 8 elsewhere.

LLVM knows vector types; where a register is narrower (NEON has 4 lanes) it splits them. Numba has no such type, so this
module gives it one (``f32xn``) with arithmetic operators and a few intrinsics.
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
_I32 = ir.IntType(32)
VECTOR = ir.VectorType(ir.FloatType(), LANES)
INDICES = ir.VectorType(_I32, LANES)
FAST = ("reassoc", "contract", "arcp", "nsz", "afn")
"""What LLVM may do with the arithmetic of vectors."""


class _F32xN(types.Type):
    def __init__(self) -> None:
        super().__init__(name=f"f32x{LANES}")


f32xn = _F32xN()


@register_model(_F32xN)
class _F32xNModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, VECTOR)


def constant(value: float) -> ir.Constant:
    return ir.Constant(VECTOR, [value] * LANES)


def splat(builder: Any, scalar: Any) -> Any:
    single = builder.insert_element(ir.Constant(VECTOR, ir.Undefined), scalar, ir.Constant(_I32, 0))
    return builder.shuffle_vector(single, ir.Constant(VECTOR, ir.Undefined), ir.Constant(INDICES, [0] * LANES))


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
        return getattr(builder, instruction)(*args, flags=FAST)

    @lower_builtin(op, f32xn, types.float32)
    def _vector_scalar(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return getattr(builder, instruction)(args[0], splat(builder, args[1]), flags=FAST)

    @lower_builtin(op, types.float32, f32xn)
    def _scalar_vector(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return getattr(builder, instruction)(splat(builder, args[0]), args[1], flags=FAST)


for _operator, _instruction in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
):
    _define_operator(_operator, _instruction)


def element(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    """Pointer to one element of a contiguous float32 array."""
    return builder.gep(context.make_array(array_type)(context, builder, array).data, [index])


def load_lanes(builder: Any, pointer: Any) -> Any:
    value = builder.load(builder.bitcast(pointer, VECTOR.as_pointer()))
    value.align = 4
    return value


def store_lanes(builder: Any, value: Any, pointer: Any) -> None:
    builder.store(value, builder.bitcast(pointer, VECTOR.as_pointer())).align = 4


def at(builder: Any, pointer: Any, offset: int) -> Any:
    return builder.gep(pointer, [ir.Constant(ir.IntType(64), offset)])


@intrinsic
def load(typingctx, array, index):
    """Lanes array[index : index + LANES]."""

    def codegen(context, builder, sig, args):
        return load_lanes(builder, element(context, builder, sig.args[0], *args))

    return f32xn(array, index), codegen


@intrinsic
def store(typingctx, array, index, value):
    """array[index : index + LANES] = value."""

    def codegen(context, builder, sig, args):
        store_lanes(builder, args[2], element(context, builder, sig.args[0], args[0], args[1]))
        return context.get_dummy_value()

    return types.void(array, index, value), codegen


@intrinsic
def broadcast(typingctx, scalar):
    """The same float32 in every lane."""

    def codegen(context, builder, sig, args):
        return splat(builder, args[0])

    return f32xn(types.float32), codegen


@intrinsic
def lane_numbers(typingctx):
    """0, 1, 2, ..."""

    def codegen(context, builder, sig, args):
        return ir.Constant(VECTOR, [float(lane) for lane in range(LANES)])

    return f32xn(), codegen


@intrinsic
def where_at_least(typingctx, value, limit, chosen, otherwise):
    """Lane by lane: chosen where value >= limit (a float32 or lanes of its own), otherwise elsewhere."""
    return _select_kind(limit), _make_select(">=")


@intrinsic
def where_above(typingctx, value, limit, chosen, otherwise):
    """Lane by lane: chosen where value > limit (a float32 or lanes of its own), otherwise elsewhere."""
    return _select_kind(limit), _make_select(">")


def _select_kind(limit: Any) -> Any:
    return f32xn(f32xn, f32xn if limit == f32xn else types.float32, f32xn, f32xn)


def _make_select(comparison: str) -> Any:
    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        limit = args[1] if sig.args[1] == f32xn else splat(builder, args[1])
        return builder.select(builder.fcmp_ordered(comparison, args[0], limit), args[2], args[3])

    return codegen


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
        sign = ir.Constant(INDICES, [0x80000000] * LANES)
        return builder.bitcast(builder.or_(builder.bitcast(args[0], INDICES), sign), VECTOR)

    return f32xn(f32xn), codegen


@intrinsic
def largest_lane(typingctx, value):
    """The largest of the lanes."""

    def codegen(context, builder, sig, args):
        kind = ir.FunctionType(ir.FloatType(), [VECTOR])
        function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.vector.reduce.fmax.v{LANES}f32")
        return builder.call(function, [args[0]], fastmath=("nnan",))

    return types.float32(f32xn), codegen


@intrinsic
def magnitude(typingctx, value):
    """abs(value), lane by lane."""

    def codegen(context, builder, sig, args):
        rest = ir.Constant(INDICES, [0x7FFFFFFF] * LANES)
        return builder.bitcast(builder.and_(builder.bitcast(args[0], INDICES), rest), VECTOR)

    return f32xn(f32xn), codegen


@intrinsic
def whole(typingctx, value):
    """The whole part of lanes between 0 and 2^31."""

    def codegen(context, builder, sig, args):
        return builder.sitofp(builder.fptosi(args[0], INDICES), VECTOR)

    return f32xn(f32xn), codegen


def _splat_number(builder: Any, number: Any) -> Any:
    """An int64 as an int32 in every lane."""
    undefined = ir.Constant(INDICES, ir.Undefined)
    single = builder.insert_element(undefined, builder.trunc(number, _I32), ir.Constant(_I32, 0))
    return builder.shuffle_vector(single, undefined, ir.Constant(INDICES, [0] * LANES))


@intrinsic
def gather(typingctx, array, start, stride, column, row):
    """array[start + stride * row + column] for every lane of column and row, which are whole; below 2^31 without the start."""

    def codegen(context, builder, sig, args):
        base = element(context, builder, sig.args[0], args[0], args[1])
        columns, rows = (builder.fptosi(each, INDICES) for each in args[3:])
        offsets = builder.add(builder.mul(rows, _splat_number(builder, args[2])), columns)
        result = ir.Constant(VECTOR, ir.Undefined)
        for lane in range(LANES):  # One instruction for all of them is no faster on most processors.
            number = ir.Constant(_I32, lane)
            value = builder.load(builder.gep(base, [builder.extract_element(offsets, number)]))
            result = builder.insert_element(result, value, number)
        return result

    return f32xn(array, types.int64, types.int64, f32xn, f32xn), codegen


@intrinsic
def byte_of(typingctx, value, shift):
    """The eight bits of every lane from bit ``shift`` on, as a number from 0 to 255."""

    def codegen(context, builder, sig, args):
        bits = builder.lshr(builder.bitcast(args[0], INDICES), _splat_number(builder, args[1]))
        return builder.sitofp(builder.and_(bits, ir.Constant(INDICES, [255] * LANES)), VECTOR)

    return f32xn(f32xn, types.int64), codegen
