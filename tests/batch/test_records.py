"""What follows from how an attempt ended."""

from __future__ import annotations

import pytest

from flowsplat.batch.records import MAX_CRASH_RESTARTS, MAX_WORKER_LOSSES, Outcome, Records, after_attempt


def ended(before, how: str, number: int | None = None, key: str = "k"):
    number = (before["attempt"] if before else 0) + 1 if number is None else number
    return after_attempt(before, "a", key, number, Outcome(how, how, {"x": 1} if how == "done" else None, 2.0, 1.5))


def test_done_and_refused_are_the_end():
    record = ended(None, "done")
    assert (record["state"], record["attempt"], record["result"], record["seconds"]) == ("done", 1, {"x": 1}, 2.0)
    assert ended(None, "refused")["state"] == "refused"


def test_a_crash_is_continued_three_times():
    record = None
    for k in range(MAX_CRASH_RESTARTS):
        record = ended(record, "crashed")
        assert (record["state"], record["crashes"], record["attempt"]) == ("open", k + 1, k + 1)
    assert ended(record, "done")["crashes"] == MAX_CRASH_RESTARTS
    record = ended(record, "crashed")
    assert record["state"] == "failed"
    assert record["seconds"] == 2.0 * (MAX_CRASH_RESTARTS + 1)
    assert ended(record, "crashed")["crashes"] == 1, "tried once more, it counts anew"


def test_other_settings_count_anew():
    record = ended(ended(None, "crashed"), "outgrew")
    record = ended(record, "crashed", key="other")
    assert (record["crashes"], record["fewer"], record["attempt"]) == (1, False, 3)


def test_memory_is_outgrown_once():
    record = ended(None, "outgrew")
    assert (record["state"], record["fewer"], record["crashes"]) == ("open", True, 0)
    assert ended(record, "done")["fewer"], "it is marked"
    assert ended(ended(record, "crashed"), "done")["fewer"]
    assert ended(record, "outgrew")["state"] == "failed"


@pytest.mark.parametrize("how", ["busy", "stopped"])
def test_what_says_nothing_about_the_clip_counts_for_nothing(how):
    record = None
    for _ in range(3 * MAX_WORKER_LOSSES):
        record = ended(record, how)
        assert (record["state"], record["crashes"], record["orphaned"]) == ("open", 0, 0)


def test_workers_that_die_are_counted_apart():
    record = ended(None, "crashed", number=4)
    assert (record["orphaned"], record["crashes"], record["state"]) == (3, 1, "open")
    assert ended(record, "lost")["orphaned"] == 4
    assert ended(record, "stopped", number=record["attempt"] + MAX_WORKER_LOSSES)["state"] == "failed"
    assert ended(record, "done", number=record["attempt"] + 2 * MAX_WORKER_LOSSES)["state"] == "done"


def test_records_on_disk(tmp_path):
    records = Records(tmp_path)
    assert records.states() == {}
    assert records.read("a") is None
    first = ended(None, "crashed")
    records.write(first)
    assert records.states() == {"a": "open"}
    assert records.read("a") == first
    second = ended(first, "done")
    records.write(second)
    assert records.states() == {"a": "done"}
    assert records.read("a") == second
    records.write({**first, "id": "b"})
    (tmp_path / ".batch" / "open" / "b.json").write_text("{")
    assert records.read("b") is None, "what cannot be read is done again"
    # A process that died between writing and deleting: the later attempt counts.
    (tmp_path / ".batch" / "failed" / "a.json").write_text((tmp_path / ".batch" / "done" / "a.json").read_text())
    records.write({**second, "state": "open", "attempt": 9})
    assert records.read("a")["attempt"] == 9
