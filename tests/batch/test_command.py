"""Whole batches of tiny clips through the command line."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from flowsplat.batch import command
from flowsplat.batch.warming import compile_kernels
from flowsplat.cli import main
from flowsplat.common.errors import InputError
from flowsplat.pipeline.speed import cache_file
from flowsplat.scenes.synthetic import SyntheticScene, write_synthetic
from tests.mounts import needs_mounts

SETTINGS = ["--priors", "true", "--train.iterations", "30", "--render.paths", "input", "--render.width", "32"]


@pytest.fixture(scope="module")
def clips(tmp_path_factory) -> Path:
    """Two scenes and a film that is none."""
    folder = tmp_path_factory.mktemp("clips")
    for k in range(2):
        write_synthetic(folder / f"world {k}", SyntheticScene(width=64, height=48, frames=12, fps=6.0, seed=k), holdout=10)
    (folder / "broken.mp4").write_bytes(b"no film")
    return folder


@pytest.fixture(autouse=True)
def kernels(request, monkeypatch):
    """Are compiled already."""
    if "compiling" not in request.keywords:
        monkeypatch.setattr(command, "compile_kernels", lambda device: None)


def batch(*arguments: object) -> int:
    """The exit code of a batch."""
    try:
        main(["batch", *map(str, arguments)])
    except SystemExit as error:
        return int(error.code or 0)
    return 0


def models(run: Path) -> bytes:
    return (run / "model" / "gaussians.safetensors").read_bytes() + (
        run / "model_all_frames" / "gaussians.safetensors"
    ).read_bytes()


@pytest.mark.slow
def test_a_batch_from_end_to_end(clips, tmp_path, capsys):
    out = tmp_path / "out"
    assert batch(clips, "-o", out, "--workers", "1", *SETTINGS) == 1, "one is broken"
    said = capsys.readouterr().err
    assert "2 of 3 clips are done, 1 refused." in said
    assert "broken.mp4 is not a video file" in said
    assert "Traceback" not in said
    found = json.loads((out / "batch.json").read_text())
    assert found["counts"] == {"done": 2, "refused": 1}
    entries = {Path(entry["input"]).name: entry for entry in found["clips"]}
    assert entries["broken.mp4"]["state"] == "refused"
    one = entries["world 0"]
    assert one["state"] == "done"
    assert one["psnr"] > 10
    assert one["peak_memory_gib"] > 0.1
    assert one["seconds"] > 0
    assert one["attempts"] == 1
    assert one["fewer_gaussians"] is False
    assert one["fingerprint"]
    assert one["versions"]["torch"]
    assert one["grade"] in ("better", "even", "worse")
    run = out / one["id"]
    assert all((run / name).exists() for name in ("run.json", "metrics.json", "report.html"))
    assert (out / one["thumb"]).exists()
    assert (out / one["video"]).suffix == ".mp4"
    assert (out / one["video"]).exists()
    # Bit for bit what a run of its own gives.
    main(["run", str(clips / "world 0"), "-o", str(tmp_path / "single"), *SETTINGS])
    assert models(run) == models(tmp_path / "single")
    capsys.readouterr()
    # Nothing is done twice; OUT alone is enough.
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*") if path.is_file()}
    assert batch(out, "--status") == 1
    assert batch(out, "--workers", "1") == 1
    assert "3 of 3 clips have ended before: 2 done, 1 refused." in capsys.readouterr().err
    assert {path: path.stat().st_mtime_ns for path in run.rglob("*") if path.is_file()} == before
    assert batch(out, "--only", one["id"]) == 0
    assert batch(out, "--retry", "refused", "--only", entries["broken.mp4"]["id"]) == 1
    assert json.loads((out / "batch.json").read_text())["clips"][0]["attempts"] == 2
    # A file that was mended is tried again by itself; here it is a prepared scene now.
    (clips / "broken.mp4").unlink()
    write_synthetic(clips / "broken.mp4", SyntheticScene(width=64, height=48, frames=12, fps=6.0, seed=5), holdout=10)
    try:
        assert batch(clips / "broken.mp4", clips, "-o", out, *SETTINGS) == 0
        assert (out / entries["broken.mp4"]["id"] / "report.html").exists()
    finally:
        import shutil

        shutil.rmtree(clips / "broken.mp4")
        (clips / "broken.mp4").write_bytes(b"no film")


@pytest.mark.slow
def test_settings_of_single_clips_reach_their_runs(clips, tmp_path):
    rows = [{"path": "world 0", "id": "first", "train.iterations": 10}, {"path": "world 1", "id": "second"}]
    (clips / "list.jsonl").write_text("\n".join(map(json.dumps, rows)))
    out = tmp_path / "out"
    assert batch(clips / "list.jsonl", "-o", out, "--shard", "1/1", "--workers", "1", *SETTINGS) == 0
    configs = [json.loads((out / name / "run.json").read_text())["config"] for name in ("first", "second")]
    assert [config["train"]["iterations"] for config in configs] == [10, 30]


@pytest.mark.slow
def test_shards_together_are_the_whole(clips, tmp_path):
    out = tmp_path / "out"
    few = ["--workers", "1", "--train.iterations", "5", "--priors", "true"]
    codes = [batch(clips, "-o", out, "--shard", f"{k}/2", *few) for k in (1, 2)]
    assert max(codes) == 1
    assert json.loads((out / "batch.json").read_text())["counts"] == {"done": 2, "refused": 1}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["nowhere.mp4", "-o", "OUT"], "does not exist"),
        (["CLIPS"], "Where shall it be written"),
        (["CLIPS", "-o", "OUT", "--only", "x"], "--only x"),
        (["CLIPS", "-o", "OUT", "--shard", "3/2"], "--shard 3/2"),
        (["CLIPS", "-o", "OUT", "--workers", "0"], "--workers"),
        (["CLIPS", "-o", "OUT", "--max-frames", "1"], "--max-frames"),
        (["CLIPS", "-o", "OUT", "--engine", "abacus"], "abacus"),
        (["CLIPS", "-o", "CLIPS/broken.mp4"], "is a file"),
        (["-o", "OUT"], "holds no batch"),
    ],
)
def test_what_cannot_be_used_is_a_line(clips, tmp_path, capsys, arguments, said):
    places = {"CLIPS": str(clips), "OUT": str(tmp_path / "out")}
    for name, place in places.items():
        arguments = [argument.replace(name, place) for argument in arguments]
    assert batch(*arguments) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert said in lines[-1]
    assert lines[-1].startswith("Error: ")


@pytest.mark.slow
@needs_mounts
def test_a_disk_that_is_full_and_room_again(clips, tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=300k", "tmpfs", str(disk)], check=True)
    arguments = [str(clips), "-o", str(disk / "out"), "--workers", "1", *SETTINGS]
    program = "from flowsplat.batch import command\ncommand.compile_kernels = print\nfrom flowsplat.cli import main\nmain()"
    process = [sys.executable, "-c", program, "batch", *arguments]
    try:
        ended = subprocess.run(process, capture_output=True, text=True, timeout=200)
        assert ended.returncode == 2, ended.stderr
        assert "disk is full" in ended.stderr.strip().splitlines()[-1]
        assert "Traceback" not in ended.stderr
        subprocess.run(["mount", "-o", "remount,size=1g", str(disk)], check=True)
        ended = subprocess.run(process, capture_output=True, text=True, timeout=200)
        assert ended.returncode == 1
        assert json.loads((disk / "out" / "batch.json").read_text())["counts"] == {"done": 2, "refused": 1}
    finally:
        subprocess.run(["umount", str(disk)], check=True)


@pytest.mark.slow
@pytest.mark.compiling
def test_kernels_are_compiled_once(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("FLOWSPLAT_CACHE", str(tmp_path))
    compile_kernels("cpu")
    assert "could not be compiled" not in capsys.readouterr().err
    assert (cache_file().parent / "compiled.json").exists()
    compile_kernels("cpu")
    assert "Compiling" not in capsys.readouterr().err


def test_a_damaged_plan_is_a_line(tmp_path):
    (tmp_path / ".batch").mkdir()
    (tmp_path / ".batch" / "plan.json").write_text('{"version": 1, "inputs": "x"}')
    with pytest.raises(InputError, match=r"plan\.json"):
        command.run_batch([tmp_path], None)
    assert os.listdir(tmp_path) == [".batch"]
