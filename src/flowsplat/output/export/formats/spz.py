"""3D Gaussians as the .spz of Niantic Labs, version 3 (https://github.com/nianticlabs/spz): rounded, then gzip.

A header of 16 bytes, then for all Gaussians one after the other:

| content | bytes | how |
| --- | --- | --- |
| position | 9 | 24 bits each, fixed point, as many bits behind the point as the scene's size leaves |
| opacity | 1 | after the sigmoid, 0 to 255 |
| color | 3 | harmonics of degree 0, 0.15 of them, from -0.5 to 0.5 |
| scales | 3 | logarithm, from -10 in steps of 1/16 |
| rotation | 4 | place of the largest of x, y, z, w in 2 bits, sign and size of the other three in 10 each |
| harmonics | 0, 9, 24, 45 | of degrees 1 to 3, from -1 to 1, channel by channel for each |

Axes are x right, y up and z backward, whatever those of the scene.
"""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import numpy as np

from flowsplat.common.files import write_bytes
from flowsplat.common.registry import Entry
from flowsplat.gaussians.model import SceneModel
from flowsplat.output.export.formats import EXPORTERS, Exporter
from flowsplat.output.export.options import ExportOptions
from flowsplat.output.export.still import Still, middle_or, still_at
from flowsplat.scenes import Scene
from flowsplat.splatting.harmonics import harmonics_count

MAGIC, _VERSION = 0x5053474E, 3
"""First four bytes ("NGSP") and version of a file, as in Niantic's format spz."""
_FRACTION_BITS = 16
"""Bits behind the point of a position at most: a step of 1/65536 of a unit, within 128 units of the middle."""
COLOR_SCALE = 0.15
"""Factor on degree 0 of the harmonics before they become bytes, as in Niantic's format spz."""

_GZIP_RATIO = 0.6
"""What gzip leaves of the bytes, as measured on trained scenes."""


def write(path: Path, model: SceneModel, scene: Scene, options: ExportOptions) -> None:
    """Write one file atomically."""
    write_spz(path, still_at(model, middle_or(model, options.time), flip_axes=True))


def estimate_bytes(model: SceneModel, scene: Scene, options: ExportOptions) -> int:
    """Return about how many it will be."""
    harmonics = harmonics_count(model.gaussians.sh_degree)
    return round(_GZIP_RATIO * bytes_per_gaussian(harmonics) * model.active_count(middle_or(model, options.time)))


def bytes_per_gaussian(harmonics: int) -> int:
    """Before gzip, for ``harmonics`` coefficients a channel."""
    return 20 + 3 * (harmonics - 1)


def write_spz(path: Path, still: Still) -> None:
    """Write one file atomically. ``still`` has y up and z backward (``flip_axes`` of ``still_at``).

    Raises:
        InputError: it cannot be written.
    """
    count, harmonics = still.sh.shape[:2]
    sh = still.sh.numpy()
    positions, fraction_bits = _convert_to_fixed_point(still.means.numpy())
    header = struct.pack("<IIIBBBB", MAGIC, _VERSION, count, int(harmonics**0.5) - 1, fraction_bits, 0, 0)
    parts = [
        positions,
        _bytes(255 * still.opacities.numpy()),
        _bytes(255 * (COLOR_SCALE * sh[:, 0] + 0.5)),
        _bytes(16 * (still.log_scales.numpy() + 10)),
        _smallest_three(still.quats.numpy()),
        # All 8 bits; Niantic's own writer rounds to 5 and 4 of them, which saves a tenth of the file and costs 3 dB.
        _bytes(128 * sh[:, 1:] + 128),
    ]
    write_bytes(path, gzip.compress(header + b"".join(part.tobytes() for part in parts), mtime=0))


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _convert_to_fixed_point(means: np.ndarray) -> tuple[np.ndarray, int]:
    """Return [N, 3, 3] the low three bytes of every coordinate, and the bits behind the point."""
    largest = max(float(np.abs(means).max(initial=0)), 1e-9)
    bits = int(np.clip(np.floor(23 - np.log2(largest)), 0, _FRACTION_BITS))
    limit = (1 << 23) - 1
    fixed = np.clip(np.rint(means.astype(np.float64) * (1 << bits)), -limit, limit).astype("<i4")
    return fixed[..., None].view(np.uint8)[..., :3], bits


def _smallest_three(quats: np.ndarray) -> np.ndarray:
    """Return [N] uint32 of unit quaternions [N, 4] wxyz: the largest component follows from the others, whose signs are turned to
    it."""
    xyzw = np.roll(quats, -1, axis=1)
    largest = np.abs(xyzw).argmax(1)
    rows = np.arange(len(xyzw))
    xyzw = xyzw * np.where(xyzw[rows, largest] < 0, -1, 1)[:, None]
    others = np.array([[k for k in range(4) if k != place] for place in range(4)])[largest]
    small = xyzw[rows[:, None], others]
    sizes = np.minimum(np.rint(511 * np.sqrt(2) * np.abs(small)), 511).astype(np.uint32)
    signed = sizes | ((small < 0).astype(np.uint32) << 9)
    return (largest.astype("<u4") << 30) | (signed[:, 0] << 20) | (signed[:, 1] << 10) | signed[:, 2]


SENTENCE = "Niantic's: rounded and compressed, y up and z backward, at one time."
SPZ = Exporter(write, estimate_bytes, "scene.spz", is_of_one_time=True, rounds=True)
EXPORTERS.add(Entry("spz", "SPZ", SENTENCE, SPZ, place=50))
