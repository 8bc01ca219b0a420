"""Real processes: every way to end, memory that runs out, kills of workers and of the one that started them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest

from flowsplat.batch.embedded import Embedded
from flowsplat.batch.records import Outcome, Records
from flowsplat.batch.scheduler import Scheduler
from flowsplat.batch.work import Job
from flowsplat.common.errors import InputError
from flowsplat.common.files import Claims, lease
from tests.batch.helpers import Deed


def outcome(tmp_path, how: str, **options) -> Outcome:
    """How one deed ends."""
    engine = Embedded(tmp_path / "logs", 1, **options)
    engine.start(Job("a", "k", Deed(how, tmp_path)), fewer=False)
    ended = engine.wait(60)
    assert engine.list_running() == []
    assert [each.job.id for each in ended] == ["a"]
    return ended[0].outcome


def test_what_it_returns_comes_back_from_a_process_of_its_own(tmp_path):
    before = dict(os.environ)
    found = outcome(tmp_path, "done")
    assert found.how == "done"
    assert found.result is not None
    assert found.result["process"] != os.getpid()
    assert found.result["threads"] == "1"
    assert dict(os.environ) == before


@pytest.mark.parametrize(
    ("how", "ends", "said"),
    [
        ("refused", "refused", "a.mp4 is no film."),
        ("unwritable", "unwritable", "The disk is full"),
        ("wrong", "crashed", "RuntimeError: a mistake of ours"),
        ("killed", "crashed", "SIGKILL"),
        ("aborted", "crashed", "SIGABRT"),
        ("exits", "crashed", "exit code 3"),
    ],
)
def test_however_it_ends_it_is_known(tmp_path, how, ends, said):
    found = outcome(tmp_path, how)
    assert found.how == ends
    assert said in found.reason
    if how == "wrong":
        assert "Traceback" in (tmp_path / "logs" / "a.log").read_text()


def test_a_folder_that_another_process_writes(tmp_path):
    with lease(tmp_path / "held"):
        (tmp_path / "held" / "x").touch()
        assert outcome(tmp_path, "busy").how == "busy"


def test_who_outgrows_its_memory_is_ended_and_tried_with_less(tmp_path):
    engine = Embedded(tmp_path / "logs", 2, memory=0.35)
    records = Records(tmp_path)
    work = [Job("a", "k", Deed("greedy", tmp_path, "a")), Job("b", "k", Deed("naps", tmp_path, "b"))]
    claims = Claims(tmp_path / "claims")
    assert Scheduler(work, engine, records, claims).run() == {"a": "done", "b": "done"}
    record = records.read("a")
    assert record["fewer"]
    assert record["result"] == {"fewer": True}
    assert record["attempt"] == 2
    assert len(work[1].call.begun()) == 1, "the other one is left alone"


def test_memory_is_given_to_as_many_as_it_is_enough_for(tmp_path):
    """Each wants 0.1 GiB, with a margin: two fit into 0.3, a third waits."""
    engine = Embedded(tmp_path / "logs", 4, memory=0.3)
    for name in "abc":
        engine.start(Job(name, "k", Deed("sleeps", tmp_path, name)), fewer=False)
    ends = time.monotonic() + 60
    while time.monotonic() < ends:
        engine._hear(0.2)
        engine._admit()
        waiting = [lane.job.id for lane in engine._lanes.values() if lane.wants is not None]
        given = [lane.job.id for lane in engine._lanes.values() if lane.share]
        if len(given) == 2 and len(waiting) == 1:
            break
    assert (len(given), len(waiting)) == (2, 1)
    assert not engine.has_room()
    for name in "abc":
        engine.drop(name)
    assert engine.list_running() == []


def test_asked_to_stop_they_end_soon_and_nothing_counts(tmp_path):
    engine = Embedded(tmp_path / "logs", 2)
    for name in "ab":
        engine.start(Job(name, "k", Deed("sleeps", tmp_path, name)), fewer=False)
    time.sleep(1.0)
    began = time.monotonic()
    assert [each.outcome.how for each in engine.stop()] == ["stopped", "stopped"]
    assert time.monotonic() - began < 20


def test_numbers_that_are_none(tmp_path):
    for options in ({"workers": 0}, {"memory": 0.0}, {"memory": float("nan")}):
        with pytest.raises(InputError, match="--workers"):
            Embedded(tmp_path, **options)


PARENT = """
import sys
from pathlib import Path
from flowsplat.batch.embedded import Embedded
from flowsplat.batch.records import Records
from flowsplat.batch.scheduler import Scheduler
from flowsplat.batch.work import Job
from flowsplat.common.files import Claims
from tests.batch.helpers import Deed
if __name__ == "__main__":
    out, how = Path(sys.argv[1]), sys.argv[2]
    work = [Job(f"clip-{k}", "k", Deed(how, out, f"clip-{k}")) for k in range(6)]
    print(Scheduler(work, Embedded(out / "logs", 2), Records(out), Claims(out / "claims")).run())
"""


def parent(tmp_path, how: str) -> subprocess.Popen:
    """A process that does six deeds, two at a time."""
    (tmp_path / "parent.py").write_text(PARENT)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    command = [sys.executable, str(tmp_path / "parent.py"), str(tmp_path), how]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)


def alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


def test_kill_9_of_the_parent_and_of_workers_and_the_same_command_again(tmp_path):
    deeds = [Deed("naps", tmp_path, f"clip-{k}") for k in range(6)]
    first = parent(tmp_path, "sleeps")
    ends = time.monotonic() + 60
    while not (deeds[0].begun() and deeds[1].begun()) and time.monotonic() < ends:
        time.sleep(0.05)
    victim = deeds[0].begun()[0]
    os.kill(victim, signal.SIGKILL)
    while len([one for deed in deeds for one in deed.begun()]) < 3 and time.monotonic() < ends:
        time.sleep(0.05)
    first.kill()
    first.wait()
    workers = [one for deed in deeds for one in deed.begun()]
    while any(map(alive, workers)) and time.monotonic() < ends:
        time.sleep(0.05)
    assert not any(map(alive, workers)), "none outlives its parent"
    assert len(list((tmp_path / "claims").iterdir())) == 2
    crashed = Records(tmp_path).read("clip-0")
    assert (crashed["state"], crashed["crashes"]) == ("open", 1)
    before = sum(len(deed.begun()) for deed in deeds)
    second = parent(tmp_path, "naps")
    assert second.wait(timeout=120) == 0
    assert set(Records(tmp_path).states().values()) == {"done"}
    assert sum(len(deed.begun()) for deed in deeds) == before + 6, "each once"
    assert list((tmp_path / "claims").iterdir()) == []


@pytest.mark.slow
def test_two_parents_share_the_work(tmp_path):
    both = [parent(tmp_path, "naps") for _ in range(2)]
    assert [each.wait(timeout=120) for each in both] == [0, 0]
    assert all(len(Deed("naps", tmp_path, f"clip-{k}").begun()) == 1 for k in range(6))
