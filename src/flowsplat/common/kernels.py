"""How Numba compiles our kernels, and the elementary functions they call.

``math.exp``, ``math.floor`` and their like are calls into the C library, before which every vector register is saved, and
``math.floor`` gives an integer, with which the arithmetic that follows is double. What is here is inlined and stays float32.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import float32, int32, njit
from numba.extending import intrinsic

from flowsplat.common.kernel_cache import KernelCache

OPTIONS = {"error_model": "numpy", "nogil": True}
"""Other Python threads run beside a kernel (``nogil``).

No "fastmath": what Numba runs right after compiling and what it later loads from its cache may be two compilations of the
same code, and where LLVM may reorder or contract sums they round differently: a run that was stopped before its kernels were
in the cache would not continue to the same bits. Where speed needs it, ``common.simd`` says so operation by operation.
"""


def kernel(function: Callable[..., Any]) -> Any:
    """``njit`` for a function that Python calls, from any of its threads; what is compiled is kept on disk.

    A kernel that works on many things takes as its first two arguments from which to which: ``common.threads.parallel_for``.
    """
    compiled = njit(**OPTIONS)(function)
    compiled._cache = KernelCache(function)
    return compiled


def helper(function: Callable[..., Any]) -> Any:
    """``njit`` for a function that only kernels call. It is part of their machine code, and is not kept by itself."""
    return njit(**OPTIONS)(function)


def inline(function: Callable[..., Any]) -> Any:
    """As ``helper``, for small ones that LLVM puts into whoever calls them."""
    return njit(forceinline=True, **OPTIONS)(function)


@intrinsic
def bits_of(typingctx: Any, value: Any) -> Any:
    """The bits of a float32 as an int32."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.bitcast(args[0], ir.IntType(32))

    return int32(float32), codegen


@intrinsic
def float_of(typingctx: Any, bits: Any) -> Any:
    """The float32 that has these bits."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.bitcast(args[0], ir.FloatType())

    return float32(int32), codegen


_ONE, _HALF = np.float32(1), np.float32(0.5)
_SMALLEST, _LARGEST = np.float32(-87.3), np.float32(88.72283)  # The next float32 has no finite exponential.
_PER_OCTAVE = np.float32(1 / np.log(2))
_ROUND = np.float32(1.5 * 2**23)  # Added and taken away again it leaves the nearest integer.
_LN2_HIGH = np.float32(0.693359375)  # Few bits, so that its products with small integers are exact.
_LN2_LOW = np.float32(np.log(2) - 0.693359375)
_E2, _E3, _E4, _E5, _E6 = (np.float32(1 / factorial) for factorial in (2, 6, 24, 120, 720))
_L3, _L5, _L7, _L9 = (np.float32(2 / order) for order in (3, 5, 7, 9))
_SQRT2 = np.float32(np.sqrt(2))
_TWO, _MANTISSA, _BIAS = np.float32(2), np.int32(0x007FFFFF), np.int32(127)
_EXPONENT_BITS = np.int32(23)
_ONE_BITS = np.int32(127 << 23)


@inline
def exp(x):
    """e^x in float32 to within 3e-7 of itself; never below 1e-38, never above 3.4029e38, the largest float32."""
    x = min(max(float32(x), _SMALLEST), _LARGEST)
    n = (x * _PER_OCTAVE + _ROUND) - _ROUND
    r = (x - n * _LN2_HIGH) - n * _LN2_LOW
    series = ((((_E6 * r + _E5) * r + _E4) * r + _E3) * r + _E2) * (r * r) + r + _ONE
    # Times 2^n by adding to the exponent: 2^128 itself is no float32. The series is between 0.7 and 1.42, above 1 where n is -126.
    return float_of(bits_of(series) + (int32(n) << _EXPONENT_BITS))


@inline
def log(x):
    """The natural logarithm of a positive, normal float32, to within 2e-7 of the larger of itself and 1."""
    bits = bits_of(x)
    mantissa = float_of((bits & _MANTISSA) | _ONE_BITS)
    exponent = (bits >> _EXPONENT_BITS) - _BIAS
    above = mantissa > _SQRT2
    mantissa = mantissa * _HALF if above else mantissa
    octaves = float32(exponent + int32(1)) if above else float32(exponent)
    s = (mantissa - _ONE) / (mantissa + _ONE)
    square = s * s
    series = (((_L9 * square + _L7) * square + _L5) * square + _L3) * square * s + _TWO * s
    return octaves * _LN2_HIGH + (octaves * _LN2_LOW + series)
