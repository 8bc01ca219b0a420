"""What ``make test`` counts and ends with."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from _pytest.mark.expression import Expression

from tests import run
from tests.marks import slow
from tests.run import GROUPS, NOTHING, ROOT, Group, Run, Tally, code_of

A_FEW = """
import time

import pytest


def test_passes():
    pass


def test_fails():
    assert False


@pytest.fixture
def spoilt():
    yield
    raise ValueError


def test_fails_in_the_end(spoilt):
    pass


@pytest.mark.skip
def test_is_skipped():
    pass


@pytest.mark.xfail
def test_is_known_to_fail():
    assert False


@pytest.mark.slow
def test_works():
    end = time.process_time() + 0.3
    while time.process_time() < end:
        pass


@pytest.mark.browser
def test_is_of_another_group():
    pass
"""


def tally_of(*lines: dict) -> Tally:
    """Of phases, each of which is what is said of it and passed otherwise."""
    tally = Tally()
    whole = {"phase": "call", "outcome": "passed", "seconds": 1.0, "processor": 1.0, "slow": False}
    tally.add([json.dumps({**whole, **line}) for line in lines])
    return tally


def measured(folder: Path, group: Group, *, everything: bool, tests: str = A_FEW) -> tuple[int, Tally]:
    """What a group with these tests ends with, and what was written of them."""
    (folder / "test_a_few.py").write_text(tests)
    (folder / "pytest.ini").write_text("[pytest]\nmarkers =\n    slow\n    browser\n    all_cores\n")
    file, tally = folder / "measured.jsonl", Tally()
    command = [*group.command(everything, file), "--rootdir", str(folder), "-c", str(folder / "pytest.ini"), str(folder)]
    code = subprocess.run(command, cwd=ROOT, capture_output=True, timeout=300).returncode
    if file.exists():
        tally.add(file.read_text().splitlines())
    return code, tally


@pytest.mark.parametrize("workers", [slow(False), True])
def test_every_test_is_counted_once(tmp_path, workers):
    group = GROUPS[0] if workers else Group("alone", GROUPS[0].marked)
    code, tally = measured(tmp_path, group, everything=True)
    assert code == 1
    assert json.loads((tmp_path / "measured.alone").read_text()) == [str(tmp_path / "test_a_few.py")]
    assert tally.line() == "2 passed, 2 failed, 2 skipped"
    times = {name.split("::")[-1]: test for name, test in tally.tests.items()}
    assert times["test_works"].slow
    assert 0.2 < times["test_works"].processor < 5
    assert times["test_passes"].processor < 0.2


def test_slow_ones_are_left_out_and_a_group_may_be_empty(tmp_path):
    code, tally = measured(tmp_path, Group("alone", GROUPS[0].marked), everything=False)
    assert (code, tally.line()) == (1, "1 passed, 2 failed, 2 skipped")
    (tmp_path / "measured.jsonl").unlink()
    code, tally = measured(tmp_path, GROUPS[1], everything=True)
    assert (code, tally.line()) == (NOTHING, "0 passed, 0 failed, 0 skipped")


def test_a_file_that_cannot_be_imported_has_failed(tmp_path):
    code, tally = measured(tmp_path, Group("alone", GROUPS[0].marked), everything=False, tests="import nowhere_to_be_found")
    assert code not in (0, NOTHING)
    assert tally.line() == "0 passed, 1 failed, 0 skipped"


def test_every_test_is_in_one_group():
    for browser in (False, True):
        for cores in (False, True):
            has = {"browser": browser, "all_cores": cores}
            chosen = [group.name for group in GROUPS if Expression.compile(group.marked).evaluate(lambda name, has=has: has[name])]
            assert len(chosen) == 1, has


def test_what_it_ends_with():
    good, bad = tally_of({"test": "a"}), tally_of({"test": "a"}, {"test": "a", "phase": "teardown", "outcome": "failed"})
    assert code_of([0, NOTHING, 0], good) == 0
    assert code_of([0, 0, 1], good) == 1
    assert code_of([0, -9, 0], good) == 1, "killed"
    assert code_of([0], bad) == 1
    assert code_of([NOTHING, NOTHING], tally_of()) == 1, "no test at all"


def test_long_ones_are_named():
    tally = tally_of(
        {"test": "long", "processor": 7.0}, {"test": "long", "phase": "setup", "processor": 4.0},
        {"test": "marked", "processor": 20.0, "slow": True}, {"test": "waits", "seconds": 50.0},
        {"test": "skipped", "outcome": "skipped"},
    )  # fmt: skip
    assert [line.split()[-1] for line in tally.to_be_marked()] == ["long"]
    assert [line.split()[-1] for line in tally.slowest()][:2] == ["waits", "long"]
    assert tally.line() == "3 passed, 0 failed, 1 skipped"


def test_what_fails_is_shown(capfd):
    quiet, loud = [sys.executable, "-c", "print('well')"], [sys.executable, "-c", "print('not so well'); exit(3)"]
    assert Run().at_once({"quiet": quiet, "loud": loud}, {}) == ["loud"]
    told = capfd.readouterr().out
    assert "not so well" in told
    assert "\nwell" not in f"\n{told}"


@pytest.mark.parametrize("number", [signal.SIGINT, slow(signal.SIGTERM)])
def test_asked_to_stop_it_ends_what_it_began(tmp_path, number):
    waits = f"import time; open({str(tmp_path / 'began')!r}, 'w').close(); time.sleep(60)"
    code = f"from tests import run; run.CHECKS = {{'waits': ['python', '-c', {waits!r}]}}; run._PATIENCE = 1.0; exit(run.main())"
    process = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 60
    while not (tmp_path / "began").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(number)
    told, _ = process.communicate(timeout=60)
    assert process.returncode == run.INTERRUPTED
    assert told.splitlines()[-2:] == ["Stopped.", "0 passed, 0 failed, 0 skipped"]
