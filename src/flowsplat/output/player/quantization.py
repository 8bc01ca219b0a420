"""Numbers rounded to multiples of a step, and laid out so that they compress well.

A quantized array holds one parameter, ``count`` rows of ``components`` numbers. Value = step * q, where the step belongs to a
component of a chunk of consecutive rows, and q is a whole number. Its bytes, in this order:

| bytes | content |
| --- | --- |
| 4 * components * chunks | step, float32 |
| per component, count | the highest bytes of z, |
| per component, count | ... down to the lowest |

z is q as a number that is not negative (0, -1, 1, -2, ... become 0, 1, 2, 3, ...); with ``delta`` so is its difference to the row
before in its chunk.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np

MAX_BITS = 24
"""Of z: three bytes, so that a step is a millionth of the largest value of its chunk and less."""
_STEPS_IN_AN_OCTAVE = 2
"""Steps are rounded to these, so that they take hardly any room. Chosen by eye."""


@dataclass(frozen=True)
class QuantizedArray:
    """One quantized parameter.

    Attributes:
        name: of the parameter.
        q: [count, components] int32.
        step: [chunks, components] float32
        chunk: rows that share their steps.
    """

    name: str
    q: np.ndarray
    step: np.ndarray
    chunk: int

    @property
    def values(self) -> np.ndarray:
        """[count, components] float32: what a reader will see."""
        return self.step[np.arange(len(self.q)) // self.chunk] * self.q.astype(np.float32)

    def encode(self) -> tuple[dict[str, Any], bytes]:
        """Return (description for the header, bytes), with or without ``delta``, whatever compresses better."""
        candidates = [self._encode(delta) for delta in (False, True)]
        sizes = [len(zlib.compress(data, 1)) for _, data in candidates]
        return candidates[int(sizes[1] < sizes[0])]

    def _encode(self, delta: bool) -> tuple[dict[str, Any], bytes]:
        count, components = self.q.shape
        q = self.q.astype(np.int64)
        if delta and count:
            q = np.diff(q, axis=0, prepend=0)
            q[:: self.chunk] = self.q[:: self.chunk]
        z = np.ascontiguousarray(np.where(q < 0, -2 * q - 1, 2 * q).T)
        planes = max((int(z.max(initial=0)).bit_length() + 7) // 8, 1)
        body = np.stack([z >> 8 * k & 255 for k in reversed(range(planes))], 1).astype(np.uint8)
        about = {
            "name": self.name, "bits": 8 * planes, "count": count, "components": components, "chunk": self.chunk, "delta": delta,
        }  # fmt: skip
        return about, np.ascontiguousarray(self.step.T).astype("<f4").tobytes() + body.tobytes()


def quantize(name: str, values: np.ndarray, step: float) -> QuantizedArray:
    """Quantize values [count, components] to multiples of one step, coarser where that needs too many bits."""
    return quantize_in_chunks(name, values, np.full((min(len(values), 1), values.shape[1]), step), max(len(values), 1))


def quantize_in_chunks(name: str, values: np.ndarray, steps: np.ndarray, chunk: int) -> QuantizedArray:
    """Quantize values [count, components], every chunk of rows to its own steps.

    Args:
        name: of the parameter.
        values: rows that follow each other should be alike.
        steps: [chunks, components] that are fine enough; coarser ones are taken where these need too many bits.
        chunk: rows.
    """
    if not len(values):
        return QuantizedArray(name, np.zeros(values.shape, np.int32), np.zeros((0, values.shape[1]), np.float32), chunk)
    largest = np.maximum.reduceat(np.abs(values.astype(np.float64)), np.arange(0, len(values), chunk))
    # Of a difference, which is twice as large and has a sign; one bit for rounding.
    steps = np.maximum(steps, largest / (1 << MAX_BITS - 3)).clip(1e-12, 1e12).astype(np.float32)
    q = np.rint(values.astype(np.float64) / steps[np.arange(len(values)) // chunk])
    return QuantizedArray(name, q.astype(np.int32), steps, chunk)


def round_steps(steps: np.ndarray) -> np.ndarray:
    """Return steps on a coarse logarithmic scale, of about the same size."""
    return np.asarray(2.0 ** (np.rint(_STEPS_IN_AN_OCTAVE * np.log2(np.maximum(steps, 1e-12))) / _STEPS_IN_AN_OCTAVE))


def means_of_chunks(values: np.ndarray, chunk: int) -> np.ndarray:
    """Return [chunks, components] the mean of each chunk of the rows of values [count, components]."""
    if not len(values):
        return np.zeros((0, values.shape[1]))
    starts = np.arange(0, len(values), chunk)
    counts = np.diff(np.append(starts, len(values)))
    return np.add.reduceat(values.astype(np.float64), starts) / counts[:, None]
