"""Files are whole or not there, and what killed processes left goes."""

from __future__ import annotations

import errno
import os

import pytest

from flowsplat.common.errors import InputError
from flowsplat.common.files import atomic_path, hash_files, read_json, remove_partials, write_bytes, write_json, write_text


def test_what_killed_processes_left_goes_and_nothing_else(tmp_path):
    dead, alive = 99_999_999, os.getppid()
    left = [tmp_path / f".a.{dead}.partial.png", tmp_path / "b" / f".c.{dead}.partial", tmp_path / f".d.{os.getpid()}.partial.json"]
    kept = [tmp_path / f".a.{alive}.partial.png", tmp_path / "a.partial.png", tmp_path / ".partial", tmp_path / ".x.1a.partial.png"]
    for path in (*left, *kept):
        path.parent.mkdir(exist_ok=True)
        path.touch()
    (tmp_path / f".link.{dead}.partial").symlink_to(kept[1])
    assert sorted(remove_partials(tmp_path)) == sorted(left)
    assert all(path.exists() for path in kept)


@pytest.mark.parametrize(
    ("number", "words"),
    [(errno.ENOSPC, "disk is full"), (errno.EFBIG, "ulimit -f"), (errno.EROFS, "No permission"), (errno.EIO, "Cannot write")],
)
def test_why_a_file_cannot_be_written_is_one_line_and_nothing_is_left(tmp_path, number, words):
    def fail() -> None:
        with atomic_path(tmp_path / "a.txt") as temporary:
            temporary.write_text("half")
            raise OSError(number, "x")

    write_text(tmp_path / "a.txt", "before")
    with pytest.raises(InputError, match=words):
        fail()
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]
    assert (tmp_path / "a.txt").read_text() == "before"


def test_names_of_files_that_are_no_text_can_be_written_and_read(tmp_path):
    names = [os.fsdecode(b"a\xff.png"), "b\u00e4.png"]
    write_json(tmp_path / "a.json", {names[0]: names[1]})
    assert read_json(tmp_path / "a.json") == {r"a\udcff.png": names[1]}
    for name in names:
        write_text(tmp_path / name, "x")
    assert hash_files("", [(names[0], tmp_path / names[0])]) != hash_files("", [(names[1], tmp_path / names[0])])


def test_devices_and_pipes_are_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("/dev/null")
    for name in ("pipe", "link", "\0"):
        with pytest.raises(InputError):
            write_bytes(tmp_path / name, b"x")
    assert (tmp_path / "link").is_symlink()
    assert not (tmp_path / "pipe").is_file()
