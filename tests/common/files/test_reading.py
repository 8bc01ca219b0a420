"""What comes from outside is opened only where it is an ordinary file, and read only as far as it fits."""

from __future__ import annotations

import io
import json
import os
import tracemalloc
import warnings
import zipfile
from typing import TypedDict

import numpy as np
import pytest

from flowsplat.common.errors import MAX_MESSAGE_CHARACTERS, InputError
from flowsplat.common.files import ordinary_file, plain_name, read_bytes, read_json, read_npy, read_npz, read_text


class Entry(TypedDict):
    """What the files below have to hold."""

    name: str
    numbers: list[float]


@pytest.mark.parametrize(
    "text",
    [
        '{"a": NaN}', '{"a": 1e999}', '{"a": ' + "9" * 5000 + "}", "[" * 100 + "]" * 100, "[" * 10**6 + "]" * 10**6, '{"a": 1', "",
        "\0",
    ],
    ids=["NaN", "beyond float64", "5,000 digits", "100 deep", "a million deep", "cut off", "empty", "NUL"],
)  # fmt: skip
def test_json_that_is_none(tmp_path, text):
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(InputError, match=r"a\.json"):
        read_json(tmp_path / "a.json")


@pytest.mark.parametrize(
    ("value", "where"),
    [
        ({"name": 1, "numbers": []}, "name"), ({"name": "a"}, "numbers"), ({"name": "a", "numbers": [1, "2"]}, r"numbers\[1\]"),
        ([], "object"),
    ],
)  # fmt: skip
def test_json_of_another_form_is_told_where(tmp_path, value, where):
    (tmp_path / "a.json").write_text(json.dumps(value))
    with pytest.raises(InputError, match=where):
        read_json(tmp_path / "a.json", Entry)


def test_json_keeps_what_a_newer_version_adds(tmp_path):
    value = {"name": "a", "numbers": [1, 2.5], "more": {"x": [None, True]}}
    (tmp_path / "a.json").write_text("\ufeff" + json.dumps(value), encoding="utf-8")
    assert read_json(tmp_path / "a.json", Entry) == value


def npy(header: str, data: bytes = b"") -> bytes:
    stored = header.encode()
    return b"\x93NUMPY\x01\x00" + len(stored).to_bytes(2, "little") + stored + data


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("{'descr': '<f8', 'fortran_order': False, 'shape': (100000, 100000), }", "MiB"),
        ("{'descr': '<f8', 'fortran_order': False, 'shape': (9, 9), }", "truncated"),
        ("{'descr': '<f8', 'fortran_order': False, 'shape': (-1,), }", "damaged"),
        ("{'descr': '|O', 'fortran_order': False, 'shape': (1,), }", "not numbers"),
        ("{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (1,), }", "not numbers"),
        ("{'descr': '<f8', 'fortran_order': False, 'shape': (" + "(" * 500, "no readable .npy file"),
        ("__import__('os').abort()", "no readable .npy file"),
    ],
)
def test_arrays_are_what_their_header_says(tmp_path, header, words):
    (tmp_path / "a.npy").write_bytes(npy(header, b"\0" * 16))
    with pytest.raises(InputError, match=words):
        read_npy(tmp_path / "a.npy")
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("a.npy", npy(header, b"\0" * 16))
    with pytest.raises(InputError, match=r"a\.npz"):
        read_npz(tmp_path / "a.npz")


def test_arrays_come_back_as_they_were(tmp_path):
    arrays = {"a": np.arange(6.0).reshape(2, 3).T, "b": np.array(True), "c": np.zeros((0, 2), ">i2"), "d": np.float16([1, np.nan])}
    np.savez_compressed(tmp_path / "a.npz", **arrays)
    found = read_npz(tmp_path / "a.npz")
    for name, array in arrays.items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].shape == array.shape
    assert read_npz(tmp_path / "a.npz", ("b",)).keys() == {"b"}
    np.save(tmp_path / "a.npy", arrays["a"])
    np.testing.assert_array_equal(read_npy(tmp_path / "a.npy"), arrays["a"])
    with pytest.raises(InputError, match="MiB that fit here"):
        read_npz(tmp_path / "a.npz", most=50)


def test_a_nan_that_warns_is_read_as_one_that_does_not(tmp_path):
    np.save(tmp_path / "a.npy", np.array([0x7FA00000, 0x3F800000], np.uint32).view(np.float32))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = read_npy(tmp_path / "a.npy") / 2
    np.testing.assert_array_equal(found, [np.nan, 0.5])


def test_archives_that_unpack_without_end_take_no_memory(tmp_path):
    file = io.BytesIO()
    np.save(file, np.ones(1000))
    for packed in (zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        with zipfile.ZipFile(tmp_path / f"{packed}.npz", "w", packed) as archive, archive.open("a.npy", "w") as member:
            member.write(file.getvalue())
            for _ in range(300 if packed == zipfile.ZIP_BZIP2 else 3):  # the other is refused whatever its size
                member.write(bytes(2**20))
    assert (tmp_path / f"{zipfile.ZIP_BZIP2}.npz").stat().st_size < 30_000
    tracemalloc.start()
    np.testing.assert_array_equal(read_npz(tmp_path / f"{zipfile.ZIP_BZIP2}.npz")["a"], np.ones(1000))
    assert tracemalloc.get_traced_memory()[1] < 200 * 2**20
    tracemalloc.stop()
    with pytest.raises(InputError, match="packed in a way"):
        read_npz(tmp_path / f"{zipfile.ZIP_LZMA}.npz")


def test_what_is_no_ordinary_file_is_not_opened(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("/dev/zero")
    (tmp_path / "loop").symlink_to("loop")
    with open(tmp_path / "sparse", "wb") as file:
        file.truncate(2**40)
    for name in ("pipe", "link", "loop", "sparse", "", "none", "\0", "n" * 5000):
        for read in (read_bytes, read_text, read_json, read_npy, read_npz):
            with pytest.raises(InputError) as caught:
                read(tmp_path / name)
            assert str(caught.value).isprintable()
    assert ordinary_file(tmp_path / "sparse") == 2**40


def test_text_that_is_none(tmp_path):
    (tmp_path / "a.txt").write_bytes(b"abc\xff")
    with pytest.raises(InputError, match="byte 3"):
        read_text(tmp_path / "a.txt")


@pytest.mark.parametrize(
    "name",
    ["", ".", "..", "../a", "/a", "a/b", "a\\b", "a\nb", "a\0b", "\x1b[31m", ".hidden", " a", "a" * 151, None, 3, "\ud800"],
)
def test_names_that_cannot_name_a_file(name):
    with pytest.raises(InputError):
        plain_name(name)


def test_names_that_can():
    for name in ("a", "a.b", "left 2", "Übung-東京", "a" * 150, "-rf", "12:30"):
        assert plain_name(name) == name


def test_an_error_is_one_line_whatever_is_in_it():
    text = str(InputError("a\nb\r\x1b[31m\u2028\ud800" + "x" * 163_793))
    assert text.isprintable()
    assert len(text) <= MAX_MESSAGE_CHARACTERS + 10
    assert text.startswith("a\\nb\\r\\x1b[31m")
