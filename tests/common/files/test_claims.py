"""Pieces of work that one process at a time has, on one machine and on several."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from flowsplat.common.errors import InputError
from flowsplat.common.files import Claims

HOLD = """
import sys
from pathlib import Path
from flowsplat.common.files import Claims
claims = Claims(Path(sys.argv[1]), beat=0.1, place=sys.argv[2] or None)
assert claims.take("a", 1)
print("taken", flush=True)
sys.stdin.read()
"""


def other(folder, place: str = "") -> subprocess.Popen:
    """Another process that has attempt 1 of ``a``."""
    command = [sys.executable, "-c", HOLD, str(folder), place]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "taken\n"
    return process


@pytest.fixture
def claims(tmp_path):
    made = Claims(tmp_path / "claims", beat=0.1, lost=1.0)
    yield made
    made.close()


def test_an_attempt_is_given_once(claims, tmp_path):
    another = Claims(tmp_path / "claims")
    assert claims.take("a.b", 1)
    assert not another.take("a.b", 1)
    assert claims.newest() == {"a.b": 1}
    assert claims.has("a.b")
    assert not another.has("a.b")
    assert not claims.is_dead("a.b", 1)
    assert not another.is_dead("a.b", 1)
    assert f"process {os.getpid()} on " in another.who("a.b", 1)
    claims.release("a.b")
    assert claims.newest() == {}
    another.close()


def test_of_many_who_try_one_has_it(tmp_path):
    all_claims = [Claims(tmp_path, place=str(k)) for k in range(8)]
    for number in range(1, 30):
        with ThreadPoolExecutor(8) as pool:
            assert sum(pool.map(lambda each, number=number: each.take("a", number), all_claims)) == 1
    for each in all_claims:
        each.close()


def test_a_killed_holder_on_this_machine_is_dead_at_once(claims, tmp_path):
    process = other(tmp_path / "claims")
    assert not claims.is_dead("a", 1)
    process.kill()
    process.wait()
    assert claims.is_dead("a", 1)
    assert claims.take("a", 2)
    assert claims.has("a")
    claims.release("a")
    assert claims.newest() == {}, "the file of the dead one is gone, too"


def test_a_holder_elsewhere_is_dead_when_it_no_longer_beats(claims, tmp_path):
    process = other(tmp_path / "claims", "another machine")
    for _ in range(20):
        assert not claims.is_dead("a", 1), "it beats ten times a second"
        time.sleep(0.1)
    process.kill()
    process.wait()
    assert not claims.is_dead("a", 1), "nobody can know yet"
    time.sleep(1.2)
    assert claims.is_dead("a", 1)


def test_who_slept_too_long_finds_that_it_has_nothing(claims, tmp_path):
    """A process that is stopped for longer than others wait; seen from another machine."""
    asleep = Claims(tmp_path / "claims", beat=1000, place="another machine")
    assert asleep.take("a", 1)
    assert not claims.is_dead("a", 1)
    time.sleep(1.2)
    assert claims.is_dead("a", 1)
    assert claims.take("a", 2)
    assert not asleep.has("a")
    asleep.release("a")
    assert claims.has("a"), "only its own file goes"
    assert claims.newest() == {"a": 2}
    asleep.close()


@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="has no SIGSTOP")
def test_a_stopped_process_on_this_machine_is_not_dead(claims, tmp_path):
    process = other(tmp_path / "claims")
    process.send_signal(signal.SIGSTOP)
    time.sleep(1.2)
    assert not claims.is_dead("a", 1)
    process.kill()
    process.wait()


@pytest.mark.parametrize("text", [b"", b"{", b"[1]", b'{"place": 1, "process": "x"}', b"\xff" * 2000])
def test_whatever_stands_in_the_file_it_is_dead_after_a_while(claims, tmp_path, text):
    (tmp_path / "claims" / "a.1").write_bytes(text)
    assert not claims.is_dead("a", 1)
    assert isinstance(claims.who("a", 1), str)
    time.sleep(1.1)
    assert claims.is_dead("a", 1)


def test_a_folder_that_cannot_be_written_is_a_line(claims, tmp_path):
    (tmp_path / "claims").rmdir()
    with pytest.raises(InputError):
        claims.take("a", 1)
    assert claims.newest() == {}
