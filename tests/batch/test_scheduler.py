"""Who does what: everything once, whoever dies; nothing again that has ended."""

from __future__ import annotations

import threading
import time
from collections import Counter

import pytest

from flowsplat.batch.records import Outcome, Records
from flowsplat.batch.scheduler import Scheduler
from flowsplat.common.errors import InputError, WritingError
from flowsplat.common.files import Claims
from tests.batch.fakes import Sleepers, jobs


def done(job, fewer) -> Outcome:
    return Outcome("done", result={"x": 1})


def scheduler(out, work, engine, retry=(), lost=60.0, place=None) -> Scheduler:
    claims = Claims(out / "claims", beat=0.1, lost=lost, place=place)
    return Scheduler(work, engine, Records(out), claims, retry, poll=0.05)


def test_everything_is_done_once_in_order(tmp_path):
    engine = Sleepers(1, done)
    assert set(scheduler(tmp_path, jobs(5), engine).run().values()) == {"done"}
    assert engine.started == [f"clip-{k}" for k in range(5)]
    again = Sleepers(1, done)
    assert len(scheduler(tmp_path, jobs(7), again).run()) == 7
    assert again.started == ["clip-5", "clip-6"]
    other = Sleepers(1, done)
    scheduler(tmp_path, jobs(3, key="other"), other).run()
    assert len(other.started) == 3, "with other settings it is done again"
    assert list((tmp_path / "claims").iterdir()) == []


def test_what_goes_wrong_is_tried_as_often_as_the_rules_say(tmp_path):
    def act(job, fewer) -> Outcome:
        how = {"clip-0": "refused", "clip-1": "crashed", "clip-2": "done" if fewer else "outgrew"}.get(job.id, "done")
        return Outcome(how, "why")

    engine = Sleepers(2, act)
    states = scheduler(tmp_path, jobs(5), engine).run()
    assert states == {"clip-0": "refused", "clip-1": "failed", "clip-2": "done", "clip-3": "done", "clip-4": "done"}
    assert Counter(engine.started) == {"clip-0": 1, "clip-1": 4, "clip-2": 2, "clip-3": 1, "clip-4": 1}
    assert Records(tmp_path).read("clip-2")["fewer"]
    again = Sleepers(2, done)
    assert scheduler(tmp_path, jobs(5), again).run() == states
    assert again.started == []
    assert scheduler(tmp_path, jobs(5), again, retry=["failed"]).run()["clip-1"] == "done"
    assert again.started == ["clip-1"]
    scheduler(tmp_path, jobs(5), again, retry=["refused", "done"]).run()
    assert len(again.started) == 1 + 5


def test_one_that_is_tried_once_more_and_fails_again_ends(tmp_path):
    engine = Sleepers(1, lambda job, fewer: Outcome("refused", "why"))
    scheduler(tmp_path, jobs(2), engine).run()
    assert scheduler(tmp_path, jobs(2), engine, retry=["refused"]).run() == {"clip-0": "refused", "clip-1": "refused"}
    assert len(engine.started) == 4


def test_a_full_disk_ends_the_batch_and_the_same_command_continues(tmp_path, monkeypatch):
    act = lambda job, fewer: Outcome("unwritable", "The disk is full: x.") if job.id == "clip-2" else done(job, fewer)  # noqa: E731
    with pytest.raises(InputError, match="The disk is full"):
        scheduler(tmp_path, jobs(6), Sleepers(1, act)).run()
    assert Records(tmp_path).states() == {"clip-0": "done", "clip-1": "done"}

    def full(self, record):
        raise WritingError("The disk is full: cannot write.")

    with monkeypatch.context() as patched:
        patched.setattr(Records, "write", full)
        with pytest.raises(InputError, match="The disk is full"):
            scheduler(tmp_path, jobs(6), Sleepers(2, done)).run()
    assert set(scheduler(tmp_path, jobs(6), Sleepers(1, done)).run().values()) == {"done"}


def test_stopping_gives_everything_back(tmp_path):
    class Interrupted(Sleepers):
        def wait(self, seconds):
            if len(self.lanes) == 2:
                raise KeyboardInterrupt
            return super().wait(seconds)

    with pytest.raises(KeyboardInterrupt):
        scheduler(tmp_path, jobs(4), Interrupted(2, done)).run()
    assert list((tmp_path / "claims").iterdir()) == []
    assert Records(tmp_path).read("clip-0")["state"] == "open"
    assert set(scheduler(tmp_path, jobs(4), Sleepers(1, done)).run().values()) == {"done"}


@pytest.mark.parametrize("same_machine", [True, False])
def test_many_schedulers_do_each_thing_once(tmp_path, same_machine):
    engines = [Sleepers(2, done, seconds=0.02) for _ in range(6)]
    all_of_them = [
        scheduler(tmp_path, jobs(60), engine, place=None if same_machine else str(k)) for k, engine in enumerate(engines)
    ]
    ended: list[dict[str, str]] = []
    threads = [threading.Thread(target=lambda each=each: ended.append(each.run())) for each in all_of_them]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert [len(each) for each in ended] == [60] * 6, "each waits until all has ended"
    assert Counter(name for engine in engines for name in engine.started) == {f"clip-{k}": 1 for k in range(60)}
    assert sum(bool(engine.started) for engine in engines) > 1


def test_what_a_dead_machine_had_is_taken_over_and_its_late_word_ignored(tmp_path):
    asleep = Sleepers(1, done, seconds=1e9)
    first = scheduler(tmp_path, jobs(1), asleep, place="another machine")
    first._claims._beat = 3.0  # as if it were suspended
    first._step()
    assert asleep.started == ["clip-0"]
    taker = Sleepers(1, done)
    began = time.monotonic()
    assert scheduler(tmp_path, jobs(1), taker, lost=1.0).run() == {"clip-0": "done"}
    assert time.monotonic() - began > 0.9
    record = Records(tmp_path).read("clip-0")
    assert (record["attempt"], record["orphaned"]) == (2, 1)
    ends = time.monotonic() + 10
    while not asleep.dropped and time.monotonic() < ends:
        first._step()
    assert asleep.dropped == ["clip-0"], "it woke and stopped its own"
    assert Records(tmp_path).read("clip-0") == record


def test_a_folder_that_somebody_else_writes_is_waited_for(tmp_path, monkeypatch):
    monkeypatch.setattr("flowsplat.batch.scheduler.RETRY_SECONDS", 0.3)
    seen: list[float] = []

    def act(job, fewer) -> Outcome:
        seen.append(time.monotonic())
        return Outcome("busy", "x") if len(seen) < 3 else done(job, fewer)

    assert scheduler(tmp_path, jobs(1), Sleepers(1, act)).run() == {"clip-0": "done"}
    assert seen[1] - seen[0] > 0.25
    assert Records(tmp_path).read("clip-0")["crashes"] == 0
