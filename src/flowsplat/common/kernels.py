"""How Numba compiles our kernels."""

from __future__ import annotations

OPTIONS = {"cache": True, "error_model": "numpy"}
"""No "fastmath": what Numba runs right after compiling and what it later loads from its cache may be two compilations of the
same code, and where LLVM may reorder or contract sums they round differently: a run that was stopped before its kernels were
in the cache would not continue to the same bits. Where speed needs it, ``splatting.cpu.simd`` says so operation by operation.
"""
