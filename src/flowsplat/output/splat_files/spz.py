"""The .spz of Niantic Labs, versions 2 and 3 (https://github.com/nianticlabs/spz), see ``output.export.formats.spz``.

Version 2 has three bytes for a rotation, x, y and z from -1 to 1, and w follows from them. Axes are x right, y up and z backward in
the file, and are turned half round about x, as this package's own are.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch

from flowsplat.common.errors import InputError
from flowsplat.common.files import ordinary_file
from flowsplat.geometry.rotations import multiply_quats
from flowsplat.output.export.formats.spz import COLOR_SCALE, MAGIC, bytes_per_gaussian
from flowsplat.output.export.still import FLIP_AXES, rotate_harmonics
from flowsplat.output.splat_files.splats import MAX_DEGREE, MAX_GAUSSIANS, Splats, to_float32
from flowsplat.splatting.harmonics import harmonics_count

_HEADER = struct.Struct("<IIIBBBB")
"""Magic number, version, Gaussians, degree, bits behind the point, flags, nothing."""
_VERSIONS = (2, 3)
_MAX_FILE_DEGREE = 4
"""Of the harmonics in a file."""
_MAX_RATIO = 50
"""Bytes unpacked for one of the file: real files have less than 2, nothing but zeros 1,000."""
_MAX_FRACTION_BITS = 23
"""Bits behind the point of a position of 24, at most."""
_HALF_TURN = torch.tensor([0.0, 1, 0, 0])
"""About x, wxyz."""


def read_spz(path: Path) -> Splats:
    """Read a file.

    Raises:
        InputError: it is missing, no such file, truncated, of another version, or has more Gaussians than can be read or than a
            file of its size can hold.
    """
    size = ordinary_file(path, MAX_GAUSSIANS * bytes_per_gaussian(harmonics_count(_MAX_FILE_DEGREE)))
    with open(path, "rb") as file:
        unpacker = _Unpacker(path, file)
        magic, version, count, degree, fraction_bits, _, _ = _HEADER.unpack(unpacker.read(_HEADER.size))
        if magic != MAGIC:
            raise InputError(f"{path} is no .spz: its first four bytes are others.")
        if version not in _VERSIONS:
            raise InputError(f"{path} is of version {version} of spz: only 2 and 3 can be read.")
        if count > MAX_GAUSSIANS:
            raise InputError(f"{path} has {count:,} Gaussians: at most {MAX_GAUSSIANS:,} can be read.")
        if degree > _MAX_FILE_DEGREE or fraction_bits > _MAX_FRACTION_BITS:
            raise InputError(f"{path} is damaged: it names degree {degree} and {fraction_bits} bits behind the point.")
        harmonics, kept = harmonics_count(degree), harmonics_count(min(degree, MAX_DEGREE))
        needed = count * bytes_per_gaussian(harmonics)
        if needed > _MAX_RATIO * size:  # looked at before room is made for them
            raise InputError(f"{path} is damaged: it names {count:,} Gaussians, {needed:,} bytes, and has {size:,} packed ones.")
        means = _from_fixed_point(unpacker.read_bytes(count, 3, 3), fraction_bits)
        alphas = unpacker.read_bytes(count).astype(np.float32) / 255
        colors = (unpacker.read_bytes(count, 3).astype(np.float32) / 255 - 0.5) / COLOR_SCALE
        log_scales = unpacker.read_bytes(count, 3).astype(np.float32) / 16 - 10
        quats = _from_three_bytes(unpacker.read_bytes(count, 3)) if version == 2 else _from_largest(unpacker.read_bytes(count, 4))
        rest = (unpacker.read_bytes(count, harmonics - 1, 3)[:, : kept - 1].astype(np.float32) - 128) / 128
    sh = rotate_harmonics(torch.from_numpy(np.concatenate([colors[:, None], rest], 1)), FLIP_AXES.double())
    turned = multiply_quats(_HALF_TURN.expand(count, 4), torch.from_numpy(quats))
    with np.errstate(divide="ignore"):
        logits = np.log(alphas) - np.log1p(-alphas)
    return Splats(means * np.array([1, -1, -1], np.float32), turned.numpy(), log_scales, logits, sh.numpy())


class _Unpacker:
    """What gzip has packed, unpacked as far as it is asked for: some bytes may hold gigabytes."""

    def __init__(self, path: Path, file: BinaryIO):
        self._path, self._file, self._unpacker = path, file, zlib.decompressobj(wbits=31)

    def read(self, count: int) -> bytes:
        """Return the next bytes.

        Raises:
            InputError: there are fewer, or they are damaged.
        """
        data = bytearray()
        try:
            while len(data) < count:
                packed = self._unpacker.unconsumed_tail or self._file.read(2**16)
                if not packed or self._unpacker.eof:
                    raise InputError(f"{self._path} is truncated.")
                data += self._unpacker.decompress(packed, count - len(data))
        except zlib.error as error:
            raise InputError(f"{self._path} is damaged or no .spz: it cannot be unpacked.") from error
        return bytes(data)

    def read_bytes(self, *shape: int) -> np.ndarray:
        """Return the next of them as an array of uint8."""
        return np.frombuffer(self.read(int(np.prod(shape))), np.uint8).reshape(shape)


def _from_fixed_point(packed: np.ndarray, fraction_bits: int) -> np.ndarray:
    """Return coordinates [N, 3] of their low three bytes [N, 3, 3]."""
    low, middle, high = (packed[..., k].astype(np.int32) for k in range(3))
    whole = low | middle << 8 | high << 16
    whole -= (whole >= 1 << 23) * (1 << 24)
    return to_float32(whole / float(1 << fraction_bits))


def _from_three_bytes(packed: np.ndarray) -> np.ndarray:
    """Return unit quaternions [N, 4] wxyz."""
    xyz = packed.astype(np.float32) / 127.5 - 1
    w = np.sqrt(np.maximum(1 - (xyz * xyz).sum(1, keepdims=True), 0))
    return np.concatenate([w, xyz], 1)


def _from_largest(packed: np.ndarray) -> np.ndarray:
    """Return unit quaternions [N, 4] wxyz of the three smaller ones of x, y, z, w, ten bits each, and the place of the largest."""
    bits = np.ascontiguousarray(packed).view("<u4")[:, 0]
    largest = (bits >> 30).astype(np.int64)
    small = np.stack([(bits >> shift) & 1023 for shift in (20, 10, 0)], 1)
    values = (small & 511) / (511 * np.sqrt(2)) * np.where(small >> 9, -1, 1)
    others = np.array([[k for k in range(4) if k != place] for place in range(4)])[largest]
    rows = np.arange(len(bits))
    xyzw = np.zeros((len(bits), 4))
    xyzw[rows[:, None], others] = values
    xyzw[rows, largest] = np.sqrt(np.maximum(1 - (values * values).sum(1), 0))
    return to_float32(np.roll(xyzw, 1, axis=1))
