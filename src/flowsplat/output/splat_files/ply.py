"""The .ply of 3D Gaussian Splatting (https://github.com/graphdeco-inria/gaussian-splatting): one vertex a Gaussian.

Read are ``x y z``, ``f_dc_*`` and ``f_rest_*`` (harmonics, channel by channel), ``opacity`` before the sigmoid, ``scale_*`` before
exp and ``rot_*`` wxyz, in any order, of any number type, whatever else there is. Binary, little or big endian.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.files import ordinary_file
from flowsplat.output.splat_files.splats import MAX_DEGREE, MAX_GAUSSIANS, Splats, to_float32

MAX_HEADER_BYTES = 64 * 2**10
"""Of a header. One with harmonics of degree 3 has 1.5 KiB."""
MAX_RECORD_BYTES = 4096
"""Of one vertex. One with harmonics of degree 3 has 248."""
_END = re.compile(rb"\nend_header\r?\n")
"""Of a header: the line after which the vertices begin."""
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
"""Of properties, by their names in a header."""
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_NAMES = (
    "x",
    "y",
    "z",
    "f_dc_0",
    "f_dc_1",
    "f_dc_2",
    "opacity",
    "scale_0",
    "scale_1",
    "scale_2",
    "rot_0",
    "rot_1",
    "rot_2",
    "rot_3",
)
"""Properties that a Gaussian needs."""


def read_ply(path: Path) -> Splats:
    """Read a file.

    Raises:
        InputError: it is missing, no such file, truncated, or has more Gaussians than can be read.
    """
    size = ordinary_file(path)
    with open(path, "rb") as file:
        head = file.read(min(size, MAX_HEADER_BYTES))
    if not head.startswith(b"ply"):
        raise InputError(f"{path} is no PLY file: it does not begin with ply.")
    end = _END.search(head)
    if end is None:
        raise InputError(f"{path} is damaged: its header does not end.")
    count, record = _parse_header(path, head[: end.start()].decode("ascii", "replace"))
    needed = count * record.itemsize
    if size < end.end() + needed:
        raise InputError(
            f"{path} is truncated: its header names {count:,} Gaussians, {needed:,} bytes, and {size - end.end():,} follow."
        )
    vertices = np.fromfile(path, record, count, offset=end.end())
    if len(vertices) < count:
        raise InputError(f"{path} is truncated.")
    return _to_splats(vertices)


def _parse_header(path: Path, text: str) -> tuple[int, np.dtype[Any]]:
    """Return how many vertices there are, and the type of one."""
    order, count, fields, is_vertex, elements = "", -1, list[tuple[str, str]](), False, 0
    for line in text.splitlines():
        words = line.split()
        if not words or words[0] in ("ply", "comment", "obj_info"):
            continue
        if words[0] == "format" and len(words) == 3:
            if words[1] not in _ORDERS:
                raise InputError(f"{path} is a PLY of format {words[1]:.40}: only binary ones can be read.")
            order = _ORDERS[words[1]]
        elif words[0] == "element" and len(words) == 3:
            elements, is_vertex = elements + 1, words[1] == "vertex"
            if is_vertex and elements > 1:
                raise InputError(f"{path} is a compressed PLY, or of another program: its vertices must come first. Convert it.")
            if is_vertex:
                count = _count(path, words[2])
        elif words[0] == "property" and is_vertex:
            if len(words) != 3 or words[1] not in _TYPES:
                raise InputError(f"{path} is damaged, or no PLY of Gaussians: {line.strip():.80} is no property of a vertex.")
            fields.append((words[2], _TYPES[words[1]]))
        elif words[0] not in ("element", "property", "format"):
            raise InputError(f"{path} is damaged: {line.strip():.80} is no line of a PLY header.")
    names = [name for name, _ in fields]
    if not order or count < 0 or len(set(names)) < len(names):
        raise InputError(f"{path} is damaged: its header names no format, no vertices, or a property twice.")
    if missing := [name for name in _NAMES if name not in names]:
        raise InputError(f"{path} is no PLY of 3D Gaussians: its vertices have no {missing[0]}.")
    if count > MAX_GAUSSIANS:
        raise InputError(f"{path} has {count:,} Gaussians: at most {MAX_GAUSSIANS:,} can be read.")
    rest = [name for name in names if name.startswith("f_rest_")]
    if len(rest) % 3 or set(rest) != {f"f_rest_{k}" for k in range(len(rest))} or _degree(len(rest)) < 0:
        raise InputError(f"{path} has {len(rest)} properties f_rest_: 0, 9, 24, 45 or 72 make whole degrees of harmonics.")
    record = np.dtype([(name, order + kind) for name, kind in fields])  # the format may stand after the properties
    if record.itemsize > MAX_RECORD_BYTES:
        raise InputError(f"{path} has {record.itemsize:,} bytes a Gaussian: at most {MAX_RECORD_BYTES:,} can be read.")
    return count, record


def _count(path: Path, word: str) -> int:
    if not (word.isascii() and word.isdecimal() and len(word) < 16):
        raise InputError(f"{path} is damaged: {word:.40} is no number of vertices.")
    return int(word)


def _degree(rest: int) -> int:
    """Return the degree of harmonics with so many properties beyond degree 0; -1 = none has."""
    return {0: 0, 9: 1, 24: 2, 45: 3, 72: 4}.get(rest, -1)


def _to_splats(vertices: np.ndarray) -> Splats:
    def columns(*names: str) -> np.ndarray:
        with np.errstate(over="ignore", invalid="ignore"):
            return to_float32(np.stack([vertices[name].astype(np.float32) for name in names], -1))

    assert vertices.dtype.names is not None
    others = sum(name.startswith("f_rest_") for name in vertices.dtype.names) // 3
    kept = min(others, (MAX_DEGREE + 1) ** 2 - 1)
    sh = [columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None]]
    if kept:
        rest = [columns(*(f"f_rest_{channel * others + k}" for channel in range(3))) for k in range(kept)]
        sh.append(np.stack(rest, 1))
    return Splats(
        columns("x", "y", "z"), columns("rot_0", "rot_1", "rot_2", "rot_3"), columns("scale_0", "scale_1", "scale_2"),
        columns("opacity")[:, 0], np.concatenate(sh, 1),
    )  # fmt: skip
