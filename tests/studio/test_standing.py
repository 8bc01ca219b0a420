"""How far a run is, by its record and by what it said."""

from __future__ import annotations

import os
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from flowsplat.common.errors import InputError
from flowsplat.common.files import write_json
from flowsplat.common.run_paths import RunPaths
from flowsplat.studio.standing import MAX_TAIL_BYTES, StandingReader, read_last_lines, read_orbits
from flowsplat.studio.tasks import Tasks

EXPECTED = {"compiling": 5.0, "cameras": 15.0, "priors": 30.0, "train": 40.0, "rest": 10.0}


def record(folder: Path, *stages: str, priors: tuple[str, ...] = ()) -> RunPaths:
    """The folder of a run in which these stages and priors are finished."""
    finished = {name: {"key": "x", "seconds": {}} for name in stages}
    values = {"input": "x", "fingerprint": "x", "config": {}, "started": {}, "stages": finished, "wall_seconds": 0.0}
    write_json(folder / "run.json", values)
    write_json(folder / "scene" / "scene.json", {"priors": {prior: {} for prior in priors}})
    return RunPaths(folder)


def read(run: RunPaths, line: str = "", since: float | None = None, expected: dict[str, float] = EXPECTED):
    run.path.mkdir(exist_ok=True)
    log = run.path / "run.log"
    log.write_text(f"$ flowsplat run x\n{line}\n")
    return StandingReader().read([run], log, time.time() - 1 if since is None else since, [expected] if expected else [])


def test_time_left_is_that_of_the_stages_that_are_not_done(tmp_path):
    """Of the training, its steps tell it; compiling is beside the cameras."""
    first = read(RunPaths(tmp_path / "new"))
    assert (first.stage, first.seconds_left) == ("cameras", pytest.approx(100, abs=1.5))
    priors = read(record(tmp_path / "a", priors=("cameras",)))
    assert (priors.stage, priors.seconds_left) == ("priors", pytest.approx(80, abs=0.5))
    train = read(record(tmp_path / "b", "prepare"), "Training: 15 of 60, 30 s left  24.1 dB")
    assert (train.stage, train.seconds_left, train.share) == ("train", pytest.approx(40), pytest.approx(0.6))
    rest = read(record(tmp_path / "c", "prepare", "train"))
    assert (rest.stage, rest.seconds_left) == ("rest", pytest.approx(10, abs=0.5))
    assert read(record(tmp_path / "d"), expected={}).seconds_left is None
    again = read(record(tmp_path / "e", "prepare", "train"), since=time.time() + 5)
    assert again.stage == "cameras", "what an earlier process has finished tells nothing of this one"


def test_a_stage_that_takes_much_longer_is_not_said_to_end_soon(tmp_path):
    late = read(RunPaths(tmp_path / "new"), since=time.time() - 60)
    assert late.is_late
    assert late.seconds_left is None
    soon = read(RunPaths(tmp_path / "new"), since=time.time() - 25)
    assert not soon.is_late
    assert soon.seconds_left == pytest.approx(80 + 2, abs=0.5), "and a stage that takes longer is never said to be over"


def test_a_scene_that_is_made_again_is_not_late(tmp_path):
    """Its record is still that of the whole run when it begins: the last stage works then, and again much later."""
    run, log, reader = record(tmp_path / "run", "prepare", "train"), tmp_path / "run.log", StandingReader()
    since = time.time() - 600
    assert reader.read([run], log, since, [EXPECTED]).stage == "rest"
    reader._stage = (0, reader._stage[1], since, since)
    assert reader.read([run], log, since, [EXPECTED]).is_late
    record(run.path)
    assert reader.read([run], log, since, [EXPECTED]).stage == "cameras"
    record(run.path, "prepare", "train")
    last = reader.read([run], log, since, [EXPECTED])
    assert (last.stage, last.is_late) == ("rest", False)


@pytest.mark.parametrize(
    "line", ["", "Training", "a: b of c", "x: 1 of 0", "x: 9 of 3", ": 1 of 2", "x: 1e9 of 1e-9", "é" * 9999, "\x00"]
)
def test_whatever_it_says_is_read(tmp_path, line):
    found = read(record(tmp_path, "prepare"), line)
    assert 0 <= found.share < 1


def test_what_an_earlier_process_said_is_not_what_this_one_says(tmp_path):
    log = tmp_path / "run.log"
    assert read_last_lines(log) == []
    log.write_bytes(b"$ flowsplat run x\nError: old.\n$ flowsplat run x\n\n  \nFlow ...\nDepth \xff\n")
    assert read_last_lines(log) == ["Flow ...", "Depth �"]
    log.write_text("$ flowsplat run x\n" + "line\n" * MAX_TAIL_BYTES + "last\n")
    assert read_last_lines(log)[-1] == "last"
    assert len(read_last_lines(log)) < MAX_TAIL_BYTES


def test_a_log_that_is_a_pipe_holds_nobody_up(tmp_path):
    log = tmp_path / "run.log"
    os.mkfifo(log)
    assert read_last_lines(log) == []
    assert read_orbits(log) == {}
    with pytest.raises(InputError, match="is a pipe"):
        Tasks().start(SimpleNamespace(log=log, run=RunPaths(tmp_path)), "export html")


def test_orbits_of_all_runs_are_found_in_order(tmp_path):
    log = tmp_path / "run.log"
    text = "Orbit: 3 degrees to either side; 4% of what it shows there is a guess.\nSwinging camera: 9 degrees to either side.\n"
    log.write_text(f"{text}Orbit: 7.5 degrees to either side\nOrbit: . degrees to either side\nOrbit: ... degrees to either side\n")
    assert read_orbits(log) == {0: [(3.0, 4), (7.5, None)]}
    assert read_orbits(tmp_path / "none") == {}


def test_orbits_are_those_of_the_shot_that_the_run_was_at(tmp_path):
    log = tmp_path / "run.log"
    run = "$ flowsplat run clip.mp4 -o run\nShot 1 of 2: 0.00 to 1.00 s, in run/shots/01\nOrbit: {} degrees to either side\n"
    second = "Shot 2 of 2: 1.10 to 2.00 s, in run/shots/02\nOrbit: 5 degrees to either side\n"
    again = "$ flowsplat render run/shots/02\nOrbit: 9 degrees to either side\n"
    log.write_text(run.format(3) + second + run.format(4) + again)
    assert read_orbits(log) == {1: [(3.0, None), (4.0, None)], 2: [(5.0, None)], 0: [(9.0, None)]}


def test_a_run_of_shots_is_as_far_as_the_shot_that_it_works_on(tmp_path):
    """Those before it are done; those behind it, and what an earlier process did, are not."""
    runs = [record(tmp_path / name, "prepare", "train") for name in ("01", "02")]
    runs.append(RunPaths(tmp_path / "03"))
    since = time.time() - 1
    os.utime(runs[1].record_path, (since - 60, since - 60))
    log = tmp_path / "run.log"
    log.write_text("$ flowsplat run x\nTraining: 15 of 60, 30 s left\n")
    times = [EXPECTED] + 2 * [{name: seconds for name, seconds in EXPECTED.items() if name != "compiling"}]
    first = StandingReader().read(runs, log, since, times)
    assert (first.scene, first.stage) == (0, "rest")
    assert first.seconds_left == pytest.approx(10 + 95 + 95, abs=1)
    record(runs[1].path, "prepare")
    second = StandingReader().read(runs, log, since, times)
    assert (second.scene, second.stage) == (1, "train")
    assert second.seconds_left == pytest.approx(40 * 0.75 + 10 + 95)
    assert second.share == pytest.approx(1 - 135 / 290)
    assert StandingReader().read(runs, log, since, times[:1]).seconds_left is None
