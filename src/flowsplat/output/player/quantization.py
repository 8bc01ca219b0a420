"""Numbers rounded to 8 or 16 bits and laid out so that they compress well.

A quantized array holds one parameter, ``count`` rows of ``components`` numbers. Value = low + step * q, where low and step
belong to a chunk of consecutive rows. Its bytes, in this order:

| bytes | content |
| --- | --- |
| 4 * chunks * components | low, float32 |
| 4 * chunks * components | step, float32 |
| per component, count | the high bytes of q (16 bits only) |
| per component, count | the low bytes of q |

With ``delta`` q is the zigzag-coded difference to the row before (0, -1, 1, -2, ... become 0, 1, 2, 3, ...).
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np

_CLIPPED_SHARE = 2e-4
"""Share of the values on either side that may be clipped, so that a few far out do not make the steps of all large.
Chosen by eye."""


@dataclass(frozen=True)
class QuantizedArray:
    """One quantized parameter.

    Attributes:
        name: of the parameter.
        bits: 8 or 16.
        q: [count, components] uint16.
        low: [chunks, components] float32
        step: [chunks, components] float32
        chunk: rows that share a low and a step.
    """

    name: str
    bits: int
    q: np.ndarray
    low: np.ndarray
    step: np.ndarray
    chunk: int

    @property
    def values(self) -> np.ndarray:
        """[count, components] float32: what a reader will see."""
        chunks = np.arange(len(self.q)) // self.chunk
        return self.low[chunks] + self.step[chunks] * self.q.astype(np.float32)

    def encode(self) -> tuple[dict[str, Any], bytes]:
        """Return (description for the header, bytes), with or without ``delta``, whatever compresses better."""
        candidates = [self._bytes(delta) for delta in (False, True)]
        sizes = [len(zlib.compress(data, 6)) for data in candidates]
        delta = sizes[1] < sizes[0]
        count, components = self.q.shape
        about = {
            "name": self.name, "bits": self.bits, "count": count, "components": components, "chunks": len(self.low),
            "chunk": self.chunk, "delta": delta,
        }  # fmt: skip
        return about, candidates[delta]

    def _bytes(self, delta: bool) -> bytes:
        q = self.q.astype(np.int32)
        if delta:
            span = 1 << self.bits
            difference = np.diff(q, axis=0, prepend=0)
            difference = (difference + span // 2) % span - span // 2
            q = np.where(difference < 0, -2 * difference - 1, 2 * difference)
        columns = np.ascontiguousarray(q.T)
        halves = [columns >> 8, columns & 255] if self.bits == 16 else [columns]
        body = np.stack(halves, 1).astype(np.uint8) if len(columns) else np.zeros(0, np.uint8)
        return self.low.astype("<f4").tobytes() + self.step.astype("<f4").tobytes() + body.tobytes()


def quantize(name: str, values: np.ndarray, bits: int, low: np.ndarray | float, high: np.ndarray | float) -> QuantizedArray:
    """Quantize values [count, components] in equal steps from ``low`` to ``high`` (each [components] or one number); clipped to
    them."""
    components = values.shape[1]
    low = np.broadcast_to(np.asarray(low, np.float32), components)
    high = np.broadcast_to(np.asarray(high, np.float32), components)
    step = np.maximum(high - low, np.float32(1e-12)) / np.float32((1 << bits) - 1)
    return _quantize(name, values, bits, low[None], step[None], max(len(values), 1))


def quantize_to_range(name: str, values: np.ndarray, bits: int, tail: float = _CLIPPED_SHARE) -> QuantizedArray:
    """Quantize values [count, components], each component between its own smallest and largest value, a few outliers apart."""
    if not len(values):
        return quantize(name, values, bits, 0.0, 1.0)
    low, high = np.quantile(values, (tail, 1 - tail), axis=0)
    return quantize(name, values, bits, low, high)


def quantize_to_step(name: str, values: np.ndarray, step: float) -> QuantizedArray:
    """Quantize values around zero to multiples of ``step``, 16 bits."""
    components = values.shape[1]
    low = np.full((1, components), -32768 * step, np.float32)
    return _quantize(name, values, 16, low, np.full((1, components), step, np.float32), max(len(values), 1))


def quantize_in_chunks(name: str, values: np.ndarray, steps: np.ndarray, chunk: int) -> QuantizedArray:
    """Quantize values [count, components] in 16 bits between the smallest and the largest of every chunk of rows.

    Args:
        name: of the parameter.
        values: rows that follow each other should be near each other.
        steps: [count] steps that are fine enough; none is made finer than the smallest in its chunk.
        chunk: rows.
    """
    starts = np.arange(0, len(values), chunk)
    low = np.minimum.reduceat(values, starts) if len(values) else np.zeros((0, values.shape[1]))
    high = np.maximum.reduceat(values, starts) if len(values) else low
    fine = np.minimum.reduceat(steps, starts)[:, None] if len(values) else np.zeros((0, 1))
    step = np.maximum((high - low) / 65535, fine)
    return _quantize(name, values, 16, low.astype(np.float32), step.astype(np.float32), chunk)


def _quantize(name: str, values: np.ndarray, bits: int, low: np.ndarray, step: np.ndarray, chunk: int) -> QuantizedArray:
    chunks = np.arange(len(values)) // chunk
    q = np.rint((values.astype(np.float64) - low[chunks]) / step[chunks])
    return QuantizedArray(name, bits, np.clip(q, 0, (1 << bits) - 1).astype(np.uint16), low, step, chunk)
