"""Arrays from anywhere: their headers are looked at before anything of them is read."""

from __future__ import annotations

import io
import pickle
import time
import tracemalloc
import zipfile
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.common.files import read_npy, read_npz


def npy(header: str, data: bytes = b"", version: int = 1) -> bytes:
    """A ``.npy`` with any header."""
    length = len(header).to_bytes(2 if version == 1 else 4, "little")
    return b"\x93NUMPY" + bytes([version, 0]) + length + header.encode() + data


def header(dtype: str = "<f4", shape: str = "(2,)", order: str = "False") -> str:
    return f"{{'descr': '{dtype}', 'fortran_order': {order}, 'shape': {shape}, }}\n"


def zipped(folder, members, compression=zipfile.ZIP_STORED):
    path = folder / "file.npz"
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return path


def stored(array) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


@pytest.mark.parametrize(
    "array",
    [
        np.arange(12, dtype=np.float32).reshape(3, 4), np.asfortranarray(np.arange(6).reshape(2, 3)), np.float64(3.5),
        np.zeros((0, 3), np.uint8), np.array([True, False]), np.arange(3, dtype=">i4"),
    ],
)  # fmt: skip
def test_arrays_come_back_as_they_were(tmp_path, array):
    np.save(tmp_path / "a.npy", array)
    np.savez_compressed(tmp_path / "a.npz", a=array, b=array)
    for read in (read_npy(tmp_path / "a.npy"), read_npz(tmp_path / "a.npz")["b"], read_npz(tmp_path / "a.npz", ["a"])["a"]):
        np.testing.assert_array_equal(read, array)
        assert read.dtype == np.asarray(array).dtype.newbyteorder("=")
        assert read.shape == np.shape(array)
    assert set(read_npz(tmp_path / "a.npz", ["a", "missing"])) == {"a"}


@pytest.mark.parametrize(
    "data",
    [
        b"", b"\x93NUMPY", b"\x93NUMPY\x01\x00", b"no array at all", npy(header()), npy(header(), b"\0" * 7),
        npy("{'descr': "), npy("__import__('os').system('true')"), npy("[" * 9000), npy("{}"), npy("(" * 200 + ")" * 200),
        npy(header(shape="(-1,)"), b"\0" * 8), npy(header(shape="(2.5,)"), b"\0" * 8), npy(header(shape="'ab'")),
        npy(header(shape="(9**9,)")), npy(header(dtype="<f99")), npy(header(dtype="|O"), b"\0" * 16),
        npy(header(dtype="|V8"), b"\0" * 16), npy(header(dtype="<M8[s]"), b"\0" * 16), npy(header(order="7"), b"\0" * 8),
        npy(header(shape="(" + "1," * 40 + ")"), b"\0" * 4), npy(header(), b"\0" * 8, version=9),
        npy(" " * 60_000 + header(), b"\0" * 8), npy(header(), b"\0" * 8, version=2)[:11], b"\x93NUMPY\x02\x00\xff\xff\xff\xff",
    ],
)  # fmt: skip
def test_damaged_arrays_are_refused(tmp_path, data):
    (tmp_path / "a.npy").write_bytes(data)
    with pytest.raises(InputError) as error:
        read_npy(tmp_path / "a.npy")
    assert len(str(error.value)) < 400 + len(str(tmp_path))
    with pytest.raises(InputError):
        read_npz(zipped(tmp_path, {"a.npy": data}))


@pytest.mark.parametrize("shape", ["(100000, 100000)", "(2147483647, 2147483647, 2147483647)", "(0, 99999999999999)"])
def test_a_header_cannot_ask_for_memory(tmp_path, shape):
    (tmp_path / "a.npy").write_bytes(npy(header(shape=shape), b"\0" * 100))
    path = zipped(tmp_path, {"a.npy": npy(header(shape=shape), b"\0" * 100)})
    tracemalloc.start()
    try:
        for read, file in ((read_npy, tmp_path / "a.npy"), (read_npz, path)):
            with pytest.raises(InputError):
                read(file)
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()


def test_objects_are_never_unpickled(tmp_path):
    ran = tmp_path / "ran"

    class Evil:
        """Makes a file when it is unpickled."""

        def __reduce__(self):
            return (open, (str(ran), "w"))

    array = np.empty(1, object)
    array[0] = Evil()
    np.save(tmp_path / "a.npy", array, allow_pickle=True)
    np.savez(tmp_path / "a.npz", a=array)
    (tmp_path / "b.npy").write_bytes(pickle.dumps(Evil()))
    for read, name in ((read_npy, "a.npy"), (read_npz, "a.npz"), (read_npy, "b.npy"), (read_npz, "b.npy")):
        with pytest.raises(InputError):
            read(tmp_path / name)
    assert not ran.exists()


def test_a_zip_bomb_is_refused_before_it_is_inflated(tmp_path):
    array = header("|u1", f"({2**29},)")
    path = zipped(tmp_path, {"a.npy": npy(array, bytes(2**24))}, zipfile.ZIP_DEFLATED)
    with pytest.raises(InputError, match=r"more than the 96\.0 MiB that fit"):
        read_npz(path)
    # one that names a small array and has much behind it
    path = zipped(tmp_path, {"a.npy": stored(np.zeros(2)) + bytes(2**24)}, zipfile.ZIP_DEFLATED)
    tracemalloc.start()
    try:
        assert read_npz(path)["a"].shape == (2,)
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()


def test_the_members_together_are_bounded(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, **{f"a{k}": np.zeros(100) for k in range(10)})
    assert len(read_npz(path, most=8000)) == 10
    with pytest.raises(InputError, match="that fit here"):
        read_npz(path, most=7999)
    np.save(tmp_path / "a.npy", np.zeros(100))
    with pytest.raises(InputError, match="that fit here"):
        read_npy(tmp_path / "a.npy", most=799)


def test_a_zip_with_too_many_members_is_refused(tmp_path):
    path = zipped(tmp_path, {f"{k}.npy": b"" for k in range(5000)})
    with pytest.raises(InputError, match="lists more arrays"):
        read_npz(path)


@pytest.mark.parametrize("compression", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_truncated_and_changed_zips_are_refused(tmp_path, compression):
    path = zipped(tmp_path, {"a.npy": stored(np.arange(500.0)), "b.npy": stored(np.arange(9))}, compression)
    whole = path.read_bytes()
    refused = 0
    for k in range(0, len(whole), max(len(whole) // 80, 1)):
        path.write_bytes(whole[:k])
        with pytest.raises(InputError):
            read_npz(path)
        changed = bytearray(whole)
        changed[k] ^= 0xFF
        path.write_bytes(changed)
        try:
            arrays = read_npz(path)
        except InputError:
            refused += 1
        else:  # a date or a flag was changed, never a number
            assert all(np.array_equal(array, np.arange(len(array))) for array in arrays.values())
    assert refused > 40


def test_encrypted_and_unknown_members_are_refused(tmp_path):
    path = zipped(tmp_path, {"a.npy": stored(np.arange(5))})
    whole = path.read_bytes()
    for offset, value in ((8, 99), (6, 1)):  # method of compression, flag of encryption
        data = bytearray(whole)
        data[offset] = value
        data[whole.rfind(b"PK\x01\x02") + offset + 2] = value
        path.write_bytes(data)
        with pytest.raises(InputError, match=r"damaged or truncated|packed in a way"):
            read_npz(path)


def test_one_header_is_parsed_at_a_time(tmp_path, monkeypatch):
    """CPython 3.11 counts the depth of its parser for all threads together: see ``common/syntax.py``."""
    read, at_once, most = np.lib.format.read_array_header_1_0, [], []

    def watched(header):
        at_once.append(1)
        most.append(len(at_once))
        time.sleep(0.01)
        at_once.pop()
        return read(header)

    monkeypatch.setattr(np.lib.format, "read_array_header_1_0", watched)
    path = tmp_path / "a.npy"
    np.save(path, np.arange(3.0))
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: read_npy(path), range(8)))
    assert all(each.tolist() == [0.0, 1.0, 2.0] for each in found)
    assert most == [1] * 8
