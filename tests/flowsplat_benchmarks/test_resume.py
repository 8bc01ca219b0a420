"""Many measurements: continued, told when they fail, measured again when asked or when their key changed."""

from __future__ import annotations

import errno
import json
import multiprocessing.synchronize
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from flowsplat.common.errors import InputError
from flowsplat.common.processes import in_own_process, usable_cores
from flowsplat_benchmarks.resume import BenchmarkOptions, Measurement, measure_jobs, results_in
from flowsplat_benchmarks.roots import open_root, require_scenes
from tests.marks import slow
from tests.mounts import needs_mounts, without_shared_memory


@pytest.fixture
def calls():
    return []


def job(calls, name: str, key: str = "k", reason: str | None = None) -> Measurement:
    def measure():
        calls.append(name)
        if reason:
            raise InputError(reason)
        return {"protocol": "test", "name": name}

    return Measurement(name, key, measure)


def test_what_is_measured_is_kept(calls, tmp_path, in_this_process):
    seen = []

    def report(failed):
        seen.append((dict(failed), [result["name"] for result in results_in("test", tmp_path)]))
        return tmp_path / "page.html"

    assert measure_jobs([job(calls, "a"), job(calls, "b")], tmp_path, report) == tmp_path / "page.html"
    assert seen[:2] == [({}, ["a"]), ({}, ["a", "b"])], "the page is written after each"
    measure_jobs([job(calls, "a"), job(calls, "b", key="other")], tmp_path, report)
    assert calls == ["a", "b", "b"]
    measure_jobs([job(calls, "a")], tmp_path, report, again=True)
    assert calls == ["a", "b", "b", "a"]
    assert json.loads((tmp_path / "b.json").read_text())["key"] == "other"
    assert results_in("another", tmp_path) == []
    (tmp_path / ".a.1.partial.json").write_text("{left by a process that was killed")
    assert len(results_in("test", tmp_path)) == 2


def test_one_that_fails_does_not_stop_the_others(calls, tmp_path, in_this_process):
    reported = []

    def report(failed):
        reported.append(dict(failed))
        return tmp_path

    jobs = [job(calls, "a", reason="it is broken"), job(calls, "b")]
    with pytest.raises(InputError, match="1 of 2 runs could not be run, first a: it is broken"):
        measure_jobs(jobs, tmp_path, report, "runs")
    assert calls == ["a", "b"]
    assert reported[-1] == {"a": "it is broken"}
    assert not (tmp_path / "a.json").exists()


@dataclass(frozen=True)
class Meeting:
    """Leaves its name and waits until another one has, which one after the other never could."""

    folder: Path
    name: str

    def __call__(self) -> dict[str, Any]:
        (self.folder / self.name).write_text("")
        ends = time.monotonic() + 30
        while len(list(self.folder.iterdir())) < 2:
            if time.monotonic() > ends:
                raise InputError("nobody came.")
            time.sleep(0.02)
        return {"protocol": "test", "threads": os.environ["OMP_NUM_THREADS"], "process": os.getpid()}


@pytest.mark.parametrize("names", ["ab", slow("abc")])
def test_two_at_a_time_in_processes_of_their_own(tmp_path, names):
    meeting, reported = tmp_path / "meeting", []
    meeting.mkdir()

    def report(failed):
        reported.append(len(results_in("test", tmp_path)))
        return tmp_path

    jobs = [Measurement(name, "k", Meeting(meeting, name)) for name in names]
    measure_jobs(jobs, tmp_path, report, options=BenchmarkOptions(workers=2))
    assert reported[-1] == len(names)
    found = results_in("test", tmp_path)
    assert len({os.getpid(), *(each["process"] for each in found)}) == len(names) + 1
    assert {each["threads"] for each in found} == {str(max(1, usable_cores() // 2))}


def test_parts_of_a_benchmark(calls, tmp_path, in_this_process):
    jobs = [job(calls, name) for name in "abcdefgh"]
    for part in ("1/2", "2/2"):
        measure_jobs(jobs, tmp_path, lambda _: tmp_path, options=BenchmarkOptions(shard=part))
        assert 0 < len(calls) < 8 or part == "2/2"
    assert sorted(calls) == list("abcdefgh")
    with pytest.raises(InputError, match="--shard 3/2"):
        measure_jobs(jobs, tmp_path, lambda _: tmp_path, options=BenchmarkOptions(shard="3/2"))


def test_a_process_of_its_own():
    assert in_own_process(os.getpid) != os.getpid()
    with pytest.raises(InputError, match="no folder"):
        in_own_process(open_root, "/missing", "rig/")


def test_a_process_that_is_killed_is_told():
    with pytest.raises(InputError, match="killed"):
        in_own_process(os._exit, 9)


def test_a_system_without_semaphores_is_a_line(monkeypatch):
    def none_there(*_: object, **__: object) -> None:
        raise FileNotFoundError(errno.ENOENT, "No such file or directory")  # as without /dev/shm

    monkeypatch.setattr(multiprocessing.synchronize.SemLock, "__init__", none_there)
    with pytest.raises(InputError, match=r"^No processes of their own .*No such file or directory.*: is there a /dev/shm"):
        in_own_process(os.getpid)


@needs_mounts
@pytest.mark.slow
def test_a_benchmark_needs_no_shared_memory(tmp_path):
    """Its engine has pipes, not semaphores."""
    program = (
        "from flowsplat_benchmarks.resume import Measurement, measure_jobs\nfrom pathlib import Path\n"
        "if __name__ == '__main__':\n    measure_jobs([Measurement('a', 'k', dict)], Path('out'), lambda failed: Path('page'))"
    )
    (tmp_path / "program.py").write_text(program)
    command = [*without_shared_memory(), sys.executable, "program.py"]
    ended = subprocess.run(command, stderr=subprocess.PIPE, text=True, timeout=120, cwd=tmp_path)
    assert ended.returncode == 0, ended.stderr
    assert json.loads((tmp_path / "out" / "a.json").read_text()) == {"key": "k"}


def test_a_process_ends_with_the_one_that_asked():
    asked = "import os, time; print('here', flush=True); time.sleep(60)"
    program = f"from flowsplat.common.processes import in_own_process; in_own_process(exec, {asked!r})"
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        assert parent.stdout.readline() == "here\n"
        parent.kill()
        # The end of the file comes when no process holds the pipe any more.
        assert parent.communicate(timeout=20)[0] == ""


def test_names_of_scenes(tmp_path):
    require_scenes(tmp_path, ["a"], ["a", "b"])
    with pytest.raises(InputError, match="has no scene 'c': choose from a, b"):
        require_scenes(tmp_path, ["a", "c"], ["a", "b"])
