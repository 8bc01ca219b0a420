"""What is no ordinary file is refused before a byte of it is read."""

from __future__ import annotations

import os
import socket
import tracemalloc
from pathlib import Path

import pytest

from flowsplat.common.errors import InputError
from flowsplat.common.files import ordinary_file, read_bytes, read_npy, read_npz, read_text
from flowsplat.common.files.json_file import read_json

READERS = [read_bytes, read_text, read_json, read_npy, read_npz]


@pytest.mark.parametrize("read", READERS)
def test_what_never_ends_or_blocks_is_refused(tmp_path, read):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    (tmp_path / "link").symlink_to("/dev/zero")
    for path, kind in ((tmp_path / "pipe", "pipe"), (tmp_path / "folder", "folder"), (tmp_path / "link", "device")):
        with pytest.raises(InputError, match=f"is a {kind}, not a file"):
            read(path)
    with pytest.raises(InputError, match="is a device, not a file"):
        read(Path("/dev/zero"))


@pytest.mark.parametrize("read", READERS)
@pytest.mark.parametrize("name", ["missing", "file/below", "x" * 300, "null\0byte"])
def test_what_is_not_there_is_said_in_a_line(tmp_path, read, name):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError) as error:
        read(tmp_path / name)
    assert "\n" not in str(error.value)
    assert "\0" not in str(error.value)


def test_links_that_lead_nowhere_or_in_a_circle_are_refused(tmp_path):
    (tmp_path / "nowhere").symlink_to(tmp_path / "missing")
    (tmp_path / "circle").symlink_to(tmp_path / "circle")
    with pytest.raises(InputError, match="does not exist"):
        ordinary_file(tmp_path / "nowhere")
    with pytest.raises(InputError, match="cannot be read"):
        ordinary_file(tmp_path / "circle")


def test_a_socket_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # names of sockets may have about 100 bytes
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind("socket")
        with pytest.raises(InputError, match="is a socket"):
            ordinary_file(tmp_path / "socket")


def test_sizes_are_bounded_before_anything_is_read(tmp_path):
    path = tmp_path / "sparse"
    with open(path, "wb") as file:
        file.truncate(2**40)
    assert ordinary_file(path) == 2**40
    with pytest.raises(InputError, match=r"1,048,576\.0 MiB, more than the 64\.0 MiB"):
        read_bytes(path)
    (tmp_path / "small").write_bytes(b"12345")
    assert read_bytes(tmp_path / "small", most=5) == b"12345"
    with pytest.raises(InputError, match="more than the 4 bytes"):
        read_bytes(tmp_path / "small", most=4)


def test_text_is_utf_8_with_or_without_a_mark(tmp_path):
    path = tmp_path / "text"
    path.write_bytes(b"\xef\xbb\xbfsea\xc3\xb1or")
    assert read_text(path) == "seañor"
    path.write_bytes(b"sea\xf1or")
    with pytest.raises(InputError, match=r"no text in UTF-8 \(byte 3\)"):
        read_text(path)


def test_a_small_file_takes_little_memory_however_large_it_might_be(tmp_path):
    path = tmp_path / "small"
    path.write_bytes(b"x" * 100)
    tracemalloc.start()
    try:
        assert read_bytes(path, most=2**29) == b"x" * 100
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()


def test_a_file_that_grows_is_read_to_its_end_and_no_further(tmp_path, monkeypatch):
    path = tmp_path / "log"
    path.write_bytes(b"x" * 200_000)
    told = os.stat(path)
    monkeypatch.setattr(os, "fstat", lambda file: os.stat_result((*told[:6], 10, *told[7:])))
    assert read_bytes(path) == b"x" * 200_000
    monkeypatch.setattr("flowsplat.common.files.opening.ordinary_file", lambda *_: 10)
    with pytest.raises(InputError, match="more than the 100,000 bytes"):
        read_bytes(path, most=100_000)
