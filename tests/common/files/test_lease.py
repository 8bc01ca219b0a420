"""One process at a time writes into a folder."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from flowsplat.common.errors import InputError
from flowsplat.common.files import lease
from flowsplat.common.files.lease import NAME, holder

pytest.importorskip("fcntl", reason="nothing is locked on Windows")

HOLD = """
import sys
from pathlib import Path
from flowsplat.common.files import lease
with lease(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def other(tmp_path) -> Iterator[subprocess.Popen]:
    """Another process that has the folder ``out``."""
    command = [sys.executable, "-c", HOLD, str(tmp_path / "out")]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.communicate()


def test_a_second_process_is_refused_in_a_line_that_names_the_first(other, tmp_path):
    words = f"out is being written by process {other.pid} on .* since 20..-"
    with pytest.raises(InputError, match=words) as caught, lease(tmp_path / "out"):
        pass
    assert "\n" not in str(caught.value)
    assert f"process {other.pid}" in (holder(tmp_path / "out") or "")


def test_the_folder_of_a_dead_process_is_free(other, tmp_path):
    other.kill()
    other.wait()
    assert (tmp_path / "out" / NAME).exists()
    assert holder(tmp_path / "out") is None
    with lease(tmp_path / "out"):
        assert json.loads((tmp_path / "out" / NAME).read_text())["process"] == os.getpid()


def test_a_folder_that_was_made_for_it_goes_where_it_stays_empty(tmp_path):
    with lease(tmp_path / "a"):
        assert (tmp_path / "a" / NAME).exists()
        with lease(tmp_path / "a"):
            pass
        assert (tmp_path / "a" / NAME).exists()
    assert not (tmp_path / "a").exists()
    (tmp_path / "b").mkdir()
    with lease(tmp_path / "b"):
        pass
    assert list((tmp_path / "b").iterdir()) == []
    with lease(tmp_path / "c"):
        (tmp_path / "c" / "x").touch()
    assert [path.name for path in (tmp_path / "c").iterdir()] == ["x"]


def test_many_processes_come_one_after_the_other(tmp_path):
    program = """
import sys, time
from pathlib import Path
from flowsplat.common.errors import InputError
from flowsplat.common.files import lease
folder, done = Path(sys.argv[1]), 0
while done < 20:
    try:
        with lease(folder):
            count = int((folder / "count").read_text())
            time.sleep(0.001)
            (folder / "count").write_text(str(count + 1))
            done += 1
    except InputError:
        time.sleep(0.002)
"""
    (tmp_path / "count").write_text("0")
    processes = [subprocess.Popen([sys.executable, "-c", program, str(tmp_path)]) for _ in range(3)]
    assert [process.wait(timeout=120) for process in processes] == [0, 0, 0]
    assert (tmp_path / "count").read_text() == "60"


def special(path: Path, kind: str) -> None:
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "link":
        path.symlink_to("/dev/zero")
    else:
        path.write_text("x")


@pytest.mark.parametrize("kind", ["pipe", "folder", "link"])
def test_a_lock_that_is_no_file_is_refused(tmp_path, kind):
    special(tmp_path / NAME, kind)
    with pytest.raises(InputError, match=NAME), lease(tmp_path):
        pass
    assert holder(tmp_path) is None


def test_what_stands_in_the_file_does_not_matter(tmp_path):
    special(tmp_path / NAME, "text")
    with lease(tmp_path):
        pass
    assert not (tmp_path / NAME).exists()
