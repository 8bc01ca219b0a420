"""A small kernel that shows whether Triton compiles and runs here."""

from __future__ import annotations

import torch
import triton
import triton.language as tl


@triton.jit
def _squares(values, results, count, BLOCK: tl.constexpr):
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    value = tl.load(values + i, mask=i < count, other=0.0)
    tl.store(results + i, value * value, mask=i < count)


def probe(device: str = "cuda") -> bool:
    """Return square some numbers on the device; whether they came out right."""
    values = torch.arange(300, dtype=torch.float32, device=device)
    results = torch.zeros_like(values)
    _squares[(triton.cdiv(len(values), 128),)](values, results, len(values), BLOCK=128)
    return bool(torch.equal(results, values * values))
