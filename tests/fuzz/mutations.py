"""What may have become of a file: bytes, JSON values, members of archives, headers of arrays and images, and files that are none.

The same generator makes the same mutation.
"""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

MARK = "\ue000"
HOSTILE_VALUES = (
    "null", "true", "-1", "0", "1e308", "-1e308", "5e-324", "NaN", "Infinity", "-Infinity", "9" * 5000, "-" + "9" * 30,
    '""', '"\\u0000"', '"../../evil"',
    '"/etc/passwd"', '"http://127.0.0.1:9/x"', '"a\\nb\\u001b[31m"', '"\\ud800"', '"' + "x" * 163_793 + '"',
    "[]", "{}", "[null]", '{"a": 1}', "[" * 100_000 + "]" * 100_000, "[" * 200 + "]" * 200, "[" + "0," * 100_000 + "0]",
    "1e5", "65536", "4294967296", "9223372036854775808", "2.5", "1" + "0" * 400, '"1"', "[[1, 2], [3]]", "01", "'a'", "",
)  # fmt: skip
"""Of JSON, as it is written."""
HOSTILE_NUMBERS = (
    "nan", "inf", "-inf", "1e400", "-1", "0", "9" * 5000, "1e308", "", "x", "../../evil", "\0", "1_0", "\u0663", "1;2",
)  # fmt: skip
"""Of a text."""
DTYPES = (
    "'|O'", "'<f8'", "'<f4'", "'<c16'", "'<M8[s]'", "'<U9'", "'|V8'", "[('a', '<f4')]", "'|u1'", "'<i8'", "'|b1'",
    "'>f2'", "'x'", "None",
)  # fmt: skip
SHAPES = (
    "()", "(0,)", "(1,)", "(-1,)", "(100000000000,)", "(65536, 65536, 4)", "(2, 2)", "(1,) * 99", "'a'", "(1.5,)", "(True,)",
    "(" * 99,
)  # fmt: skip

Change = Callable[[np.random.Generator, bytes], bytes]


def mutate(rng: np.random.Generator, path: Path) -> str:
    """Spoil a file; what was done to it."""
    if rng.random() < 0.06:
        return _become_special(rng, path)
    data = path.read_bytes()
    changes = [*_OF_KIND.get(path.suffix.lower(), ()), _change_bytes]
    change = changes[0] if len(changes) > 1 and rng.random() < 0.65 else changes[rng.integers(len(changes))]
    changed = change(rng, data)
    for _ in range(int(rng.integers(0, 3)) if rng.random() < 0.2 else 0):
        changed = _change_bytes(rng, changed)
    path.unlink()  # others may be links to it
    path.write_bytes(changed)
    return change.__name__.strip("_")


def _pick(rng: np.random.Generator, choices: Any) -> Any:
    return choices[int(rng.integers(len(choices)))]


def _become_special(rng: np.random.Generator, path: Path) -> str:
    """What is no file at all, a link that leads nowhere or for ever, or one that only seems to be large."""
    what = _pick(rng, ("missing", "folder", "pipe", "zero", "random", "null", "loop", "nowhere", "sparse", "empty"))
    path.unlink()
    if what == "folder":
        path.mkdir()
    elif what == "pipe":
        os.mkfifo(path)
    elif what in ("zero", "random", "null"):
        path.symlink_to(f"/dev/{'urandom' if what == 'random' else what}")
    elif what == "loop":
        path.symlink_to(path.name)
    elif what == "nowhere":
        path.symlink_to("nowhere")
    elif what == "sparse":
        with open(path, "wb") as file:
            file.truncate(16 * 2**30)
    elif what == "empty":
        path.touch()
    return what


def _change_bytes(rng: np.random.Generator, data: bytes) -> bytes:
    values = bytearray(data)
    size = len(values)
    kind = int(rng.integers(10))
    at = int(rng.integers(size)) if size else 0
    if kind == 0:
        return bytes(values[:at])
    if kind == 1:
        return bytes(values) + rng.bytes(int(rng.integers(1, 100)))
    if kind == 2:
        return rng.bytes(int(rng.integers(0, 300)))
    if kind == 3 and size:
        del values[at : at + int(rng.integers(1, 40))]
    elif kind == 4 and size:
        values[at:at] = values[at : at + int(rng.integers(1, 40))]
    elif kind == 5 and size >= 8:
        extreme = _pick(rng, (b"\xff" * 4, b"\x7f\xff\xff\xff", b"\0" * 4, b"\xff\xff\xff\x7f", b"\0\0\xc0\x7f", b"\0\0\0\x80"))
        values[at : at + 4] = extreme
    elif kind == 6 and size:
        first = int(rng.integers(min(size, 64)))  # headers stand there
        values[first] = int(rng.integers(256))
    elif size:
        for _ in range(int(rng.integers(1, 9))):
            values[int(rng.integers(size))] ^= 1 << int(rng.integers(8))
    return bytes(values)


# -- JSON


def _places(value: Any, found: list[tuple[Any, Any]]) -> list[tuple[Any, Any]]:
    for key in list(value) if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ():
        found.append((value, key))
        _places(value[key], found)
    return found


def _change_json(rng: np.random.Generator, data: bytes) -> bytes:
    try:
        value = json.loads(data)
    except ValueError:
        return _change_bytes(rng, data)
    places = _places(value, [])
    if not places or rng.random() < 0.03:
        return _pick(rng, HOSTILE_VALUES).encode()
    holder, key = _pick(rng, places)
    kind = rng.random()
    if kind < 0.12:
        del holder[key]
    elif kind < 0.17 and isinstance(holder, dict):
        holder[_pick(rng, ("../../evil", "", "a\nb", "version", "x" * 9999))] = holder.pop(key)
    elif kind < 0.25:
        other, place = _pick(rng, places)
        holder[key] = json.loads(json.dumps(other[place]))
    else:
        holder[key] = MARK
    return json.dumps(value).replace(json.dumps(MARK), _pick(rng, HOSTILE_VALUES)).encode()


def _change_text(rng: np.random.Generator, data: bytes) -> bytes:
    words = list(re.finditer(rb"[^\s,]+", data))
    if not words:
        return _change_bytes(rng, data)
    word = _pick(rng, words)
    return data[: word.start()] + _pick(rng, HOSTILE_NUMBERS).encode() + data[word.end() :]


# -- arrays


def _change_npy(rng: np.random.Generator, data: bytes) -> bytes:
    kind = rng.random()
    if kind < 0.35:
        length = int.from_bytes(data[8:10], "little")
        header = data[10 : 10 + length].decode("latin1")
        if rng.random() < 0.5:
            header = re.sub(r"'shape': \([^)]*\)", f"'shape': {_pick(rng, SHAPES)}", header)
        else:
            header = re.sub(r"'descr': '[^']*'", f"'descr': {_pick(rng, DTYPES)}", header)
        stored = header.encode("latin1")
        return data[:8] + struct.pack("<H", len(stored)) + stored + data[10 + length :]
    if kind < 0.45:
        return data[:8] + _pick(rng, (b"\0\0", b"\xff\xff", b"\x01\0")) + data[10:]
    try:
        array = np.load(io.BytesIO(data), allow_pickle=False)
    except Exception:
        return _change_bytes(rng, data)
    return _npy(_other_array(rng, array))


def _other_array(rng: np.random.Generator, array: np.ndarray) -> np.ndarray:
    kind = int(rng.integers(8))
    if kind == 0:
        return array.astype(_pick(rng, ("f2", "f4", "f8", "u1", "i8", "?", "U5")))
    if kind == 1:
        return array[: len(array) // 2] if array.ndim else array.reshape(1)
    if kind == 2:
        return array.T
    if kind == 3:
        return np.zeros(_pick(rng, ((), (0,), (1,), (3, 3), (0, 4), (2, 2, 2, 2, 2))), array.dtype)
    if kind == 4 and array.ndim:
        return np.concatenate([array, array])
    if kind == 5:
        return np.zeros((3000, 3000, 7), array.dtype)
    changed = array.copy()
    if changed.size:
        place = int(rng.integers(changed.size))
        values = (np.nan, np.inf, -np.inf, 1e38, -1e38, 0, -1) if changed.dtype.kind == "f" else (0, 1, 127, 255, -1, 2**62)
        with np.errstate(all="ignore"):
            changed.flat[place if rng.random() < 0.5 else slice(None)] = np.array(_pick(rng, values)).astype(changed.dtype)
    return changed


def _npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array, allow_pickle=False)
    return file.getvalue()


def _change_npz(rng: np.random.Generator, data: bytes) -> bytes:
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
    except (zipfile.BadZipFile, zlib.error, OSError, NotImplementedError, EOFError):
        return _change_bytes(rng, data)
    name = _pick(rng, list(members))
    kind = rng.random()
    if kind < 0.1:
        del members[name]
    elif kind < 0.15:
        members[_pick(rng, ("../../evil.npy", "x.npy", "a\nb.npy"))] = members.pop(name)
    elif kind < 0.25:
        members[name] = _change_bytes(rng, members[name])
    else:
        members[name] = _change_npy(rng, members[name])
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", _pick(rng, (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2))) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    whole = bytearray(file.getvalue())
    if rng.random() < 0.15:  # the directory says something else than the members
        at = whole.rfind(b"PK\x01\x02")
        place = at + _pick(rng, (8, 10, 16, 20, 24, 28, 42))
        whole[place : place + 4] = _pick(rng, (b"\xff" * 4, b"\0" * 4, b"\x01\0\0\0", b"\0\0\0\x10"))
    return bytes(whole)


def _change_tensors(rng: np.random.Generator, data: bytes) -> bytes:
    """safetensors: eight bytes of length, JSON, numbers."""
    length = int.from_bytes(data[:8], "little")
    header, numbers = data[8 : 8 + length], bytearray(data[8 + length :])
    kind = rng.random()
    if kind < 0.35:
        header = _change_json(rng, header)
    elif kind < 0.5:
        values = json.loads(header)
        stored = values.get("__metadata__", {}).get("values")
        if stored:
            values["__metadata__"]["values"] = _change_json(rng, stored.encode()).decode(errors="replace")
        header = json.dumps(values).encode()
    elif numbers:
        for _ in range(int(rng.integers(1, 20))):
            at = int(rng.integers(len(numbers) // 4 or 1)) * 4
            numbers[at : at + 4] = _pick(rng, (b"\0\0\xc0\x7f", b"\0\0\x80\x7f", b"\xff\xff\x7f\x7f", b"\0\0\0\0", b"\xff" * 4))
    stated = _pick(rng, (len(header), len(header), len(header), len(header) + 1, 2**40, 0))
    return struct.pack("<Q", stated) + header + bytes(numbers)


# -- images


def _change_png(rng: np.random.Generator, data: bytes) -> bytes:
    """Another header with a checksum that fits it: its size asks for gigabytes, or its colors are others."""
    if data[12:16] != b"IHDR":
        return _change_bytes(rng, data)
    head = bytearray(data[16:29])
    if rng.random() < 0.6:
        struct.pack_into(">II", head, 0, *_pick(rng, ((60_000, 60_000), (2**31 - 1, 1), (0, 9), (30_000, 1_000), (1, 1), (63, 48))))
    else:
        head[int(rng.integers(8, 13))] = _pick(rng, (0, 1, 2, 3, 4, 6, 8, 16, 255))
    return data[:16] + bytes(head) + struct.pack(">I", zlib.crc32(b"IHDR" + bytes(head))) + data[33:]


def _change_jpeg(rng: np.random.Generator, data: bytes) -> bytes:
    at = max(data.find(b"\xff\xc0"), data.find(b"\xff\xc2"))
    if at < 0:
        return _change_bytes(rng, data)
    values = bytearray(data)
    struct.pack_into(">HH", values, at + 5, *_pick(rng, ((65_500, 65_500), (65_000, 800), (0, 0), (1, 1), (48, 65_000), (49, 64))))
    return bytes(values)


_OF_KIND: dict[str, tuple[Change, ...]] = {
    ".json": (_change_json,),
    ".txt": (_change_text,),
    ".csv": (_change_text,),
    ".npy": (_change_npy,),
    ".npz": (_change_npz,),
    ".safetensors": (_change_tensors,),
    ".png": (_change_png,),
    ".jpg": (_change_jpeg,),
}


def fresh(originals: Path, work: Path) -> Path:
    """A copy to spoil, alone in a folder in a folder."""
    shutil.rmtree(work.parent.parent, ignore_errors=True)
    shutil.copytree(originals, work)
    return work
