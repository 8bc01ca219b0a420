"""The folder of a run: one writes, others read; what is refused leaves it as it was; whatever stops it is a line."""

from __future__ import annotations

import errno
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flowsplat.cli import main
from flowsplat.common.errors import InputError
from flowsplat.common.files import lease
from flowsplat.pipeline import prepare, run
from flowsplat.pipeline.describe import describe
from flowsplat.pipeline.folder import RunFolder
from flowsplat.pipeline.preparing import find_prepared
from flowsplat.priors.given import GivenPriors
from flowsplat.scenes import Scene
from tests.commands import call_in_one_process
from tests.mounts import needs_mounts, read_only, without_shared_memory
from tests.shared import small_config

COMMAND = [sys.executable, "-m", "flowsplat.cli"]
SMALL = ["--priors", "true", "--render.paths", "input", "--render.width", "32"]
HOLD = "import sys; from flowsplat.common.files import lease\nwith lease(sys.argv[1]): print(flush=True); sys.stdin.read()"


def begun(scene: Path, out: Path, until: str, iterations: int = 3000) -> subprocess.Popen:
    """A run in a process of its own that has written the file ``until``."""
    command = [*COMMAND, "run", str(scene), "-o", str(out), *SMALL, "--train.iterations", str(iterations)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 120
    while process.poll() is None and not (out / until).exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    return process


def the_line(process: subprocess.Popen, code: int, words: str) -> str:
    """What a process says in the end, that it ends so, and soon."""
    _, told = process.communicate(timeout=120)
    assert process.returncode == code, told
    assert "Traceback" not in told, told
    last = told.strip().splitlines()[-1]
    assert words in last, told
    return last


@pytest.mark.slow
def test_one_writes_and_others_read(tiny_scene, tmp_path, capsys):
    out = tmp_path / "out"
    first = begun(tiny_scene, out, "training/latest.json", iterations=100_000)
    try:
        for command in (["run", str(tiny_scene), "-o"], ["prepare", str(tiny_scene), "-o"], ["train"], ["evaluate"], ["render"]):
            with pytest.raises(SystemExit) as error:
                main([*command, str(out)])
            assert error.value.code == 2
            assert f"is being written by process {first.pid} on " in capsys.readouterr().err.strip().splitlines()[-1]
        assert any(f"process {first.pid}" in line for line in describe(out))
        main(["info", str(out)])
        assert "is being written by" in capsys.readouterr().out
        assert first.poll() is None
    finally:
        first.kill()
        first.communicate()
    with lease(out):  # of a dead one
        pass


@pytest.mark.slow
@pytest.mark.parametrize(("number", "times", "code"), [(signal.SIGTERM, 1, 143), (signal.SIGINT, 1, 130), (signal.SIGINT, 2, 130)])
def test_signals_end_it_with_a_line(tiny_scene, tmp_path, number, times, code):
    process = begun(tiny_scene, tmp_path / "out", "training/latest.json")
    for _ in range(times):
        process.send_signal(number)
        time.sleep(0.01)
    the_line(process, code, "continues from here")
    left = [path for path in (tmp_path / "out").rglob("*") if ".partial" in path.name or path.name == ".lock"]
    assert left == []


@pytest.mark.slow
def test_a_folder_that_is_removed_ends_it_with_a_line(tiny_scene, tmp_path):
    process = begun(tiny_scene, tmp_path / "out", "training/latest.json")
    shutil.rmtree(tmp_path / "out", ignore_errors=True)
    process.send_signal(signal.SIGINT)
    _, told = process.communicate(timeout=120)
    assert process.returncode in (2, 130), told
    assert "Traceback" not in told, told


@pytest.mark.slow
def test_files_that_may_not_be_that_large_are_a_line(tiny_scene, tmp_path):
    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (3000, 3000))

    command = [*COMMAND, "run", str(tiny_scene), "-o", str(tmp_path / "out"), *SMALL, "--train.iterations", "3000"]
    the_line(subprocess.Popen(command, stderr=subprocess.PIPE, text=True, preexec_fn=limited), 2, "ulimit -f")
    assert not [path for path in tmp_path.rglob("*") if ".partial" in path.name]


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@needs_mounts
@pytest.mark.slow
def test_a_folder_that_not_even_root_can_write_is_a_line(tiny_scene, finished, tmp_path):
    """Where the file system is mounted to be read only: so stands much of what others give."""
    (tmp_path / "empty").mkdir()
    before = contents(finished)

    scene, out, new, elsewhere = str(tiny_scene), str(finished), str(tmp_path / "empty" / "new"), tmp_path / "model.ply"
    refused = {
        tmp_path / "empty": [
            ["run", scene, "-o", str(tmp_path / "empty")], ["run", scene, "-o", new], ["demo", "-o", new],
        ],
        finished: [
            ["run", scene, "-o", out, "--priors", "true"], ["train", out, "--train.iterations", "40"], ["evaluate", out],
            ["render", out, "--render.paths", "orbit"], ["export", out, "--to", "ply"], ["tracks", out, "--at", "9,9,0"],
        ],
    }  # fmt: skip
    allowed = [["info", out], ["export", out, "--to", "ply", "-o", str(elsewhere)]]
    for folder, commands in refused.items():
        told = call_in_one_process([*commands, *(allowed if folder == finished else ())], read_only(folder))
        for command, (code, _, error) in zip(commands, told, strict=False):
            assert code == 2, (command, error)
            assert "Traceback" not in error, error
            last = error.strip().splitlines()[-1]
            assert re.match(r"Error: (No permission to write|Cannot write) .+", last), (command, last)
    shown, exported = told[-2:]
    assert (shown[0], shown[2]) == (0, "")
    assert exported[0] == 0
    assert elsewhere.exists()
    assert list((tmp_path / "empty").iterdir()) == []
    assert contents(finished) == before


def refusal(work: Callable[[], object]) -> str | None:
    """What work is refused with."""
    try:
        work()
    except InputError as error:
        return str(error)
    return None


@pytest.mark.slow
def test_a_file_system_that_turns_read_only_is_a_line(tiny_scene, finished, tmp_path, monkeypatch):
    """Linux does that with a disk that fails: again and again, each time after one more file. The run goes on from there each time,
    and in the end nothing tells."""
    replace_file, failed, out = os.replace, 0, tmp_path / "out"

    def fails_after(count: int) -> Callable[[Path, Path], None]:
        left = iter(range(count))

        def replacing(source: Path, target: Path) -> None:
            if next(left, None) is None:
                raise OSError(errno.EROFS, "Read-only file system", str(source), None, str(target))
            replace_file(source, target)

        return replacing

    for count in range(1000):
        with monkeypatch.context() as patch:
            patch.setattr(os, "replace", fails_after(count))
            told = refusal(lambda: run(tiny_scene, out, small_config()))
        if told is None:
            break
        assert re.match(r"No permission to write .+", told)
        failed += 1
        assert not [path for path in out.rglob("*") if ".partial" in path.name or path.name == ".lock"]
    assert failed > 20
    for name in ("model/gaussians.safetensors", "model_all_frames/gaussians.safetensors", "renders/input_path.mp4"):
        assert (out / name).read_bytes() == (finished / name).read_bytes(), name


@needs_mounts
@pytest.mark.slow
def test_a_run_needs_no_shared_memory(tiny_scene, finished, tmp_path):
    command = [*without_shared_memory(), *COMMAND, "run", str(tiny_scene), "-o", str(tmp_path / "out"), "--priors", "true"]
    settings = ["--train.iterations", "5", "--render.paths", "input", "--render.width", "32"]
    ended = subprocess.run([*command, *settings], stderr=subprocess.PIPE, text=True, timeout=240)
    assert ended.returncode == 0, ended.stderr
    assert (tmp_path / "out" / "report.html").exists()


@pytest.mark.skipif(os.geteuid() == 0, reason="whoever is root may write everywhere")
def test_a_folder_that_cannot_be_written_is_a_line(tiny_scene, tmp_path):
    (tmp_path / "out").mkdir(mode=0o555)
    with pytest.raises(InputError, match="No permission"):
        prepare(tiny_scene, tmp_path / "out", small_config())


def _masks_that_do_not_fit(folder: Path) -> GivenPriors:
    folder.mkdir()
    return GivenPriors(masks=folder)


def _depth_that_does_not_fit(folder: Path) -> GivenPriors:
    folder.mkdir()
    np.save(folder / "00000.npy", np.zeros(3))
    return GivenPriors(depth=folder)


@pytest.mark.parametrize("given", [_masks_that_do_not_fit, _depth_that_does_not_fit])
@pytest.mark.parametrize("there", [True, False])
def test_given_files_that_are_refused_leave_the_folder_as_it_was(tiny_scene, tmp_path, given: Callable[[Path], GivenPriors], there):
    config = small_config()
    config = replace(config, priors=replace(config.priors, priors="own", given=given(tmp_path / "given")))
    if there:
        (tmp_path / "out").mkdir()
    with pytest.raises(InputError, match="given"):
        prepare(tiny_scene, tmp_path / "out", config)
    assert (tmp_path / "out").exists() == there
    assert not there or not any((tmp_path / "out").iterdir())


def test_what_a_killed_run_left_half_written_goes(tiny_scene, tmp_path):
    out, config = tmp_path / "out", small_config()
    prepare(tiny_scene, out, config)
    half = out / "scene" / "depth" / ".00000.99999999.partial.npz"
    half.write_bytes(b"half")
    prepare(tiny_scene, out, config)
    assert not half.exists()


def test_commands_that_are_refused_change_nothing_of_a_run_that_another_process_has(tiny_scene, tmp_path, capsys):
    out = tmp_path / "out"
    prepare(tiny_scene, out, small_config())
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    first = subprocess.Popen([sys.executable, "-c", HOLD, out], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment)
    try:
        assert first.stdout is not None
        first.stdout.readline()
        before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file() and path.name != ".lock"}
        for command in (["train", "--train.iterations", "7"], ["evaluate", "--baselines", "all"], ["render", "--device", "cpu"]):
            with pytest.raises(SystemExit) as error:
                main([command[0], str(out), *command[1:]])
            assert error.value.code == 2
            assert f"is being written by process {first.pid}" in capsys.readouterr().err.strip().splitlines()[-1]
        assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file() and path.name != ".lock"} == before
    finally:
        first.kill()
        first.communicate()


@pytest.mark.parametrize("leads_to", ["/", "/dev/zero", "/etc/passwd", "nowhere"])
def test_what_a_scene_of_others_links_to_does_not_come_along(tiny_scene, tmp_path, leads_to):
    scene = Path(shutil.copytree(tiny_scene, tmp_path / "scene"))
    (scene / "frames" / "more").symlink_to(leads_to)
    with pytest.raises(InputError, match="is a link or no ordinary file"):
        prepare(scene, tmp_path / "out", small_config())
    assert not (tmp_path / "out").exists()


def test_a_scene_is_not_copied_into_itself(tiny_scene, tmp_path):
    scene = Path(shutil.copytree(tiny_scene, tmp_path / "scene"))
    before = contents(scene)
    with pytest.raises(InputError, match="choose another output folder with -o"):
        prepare(scene, scene / "out", small_config())
    assert contents(scene) == before
    assert not (scene / "out").exists()


def test_a_scene_that_changed_is_not_taken_for_the_one_before(tiny_scene, tmp_path):
    scene = Scene(shutil.copytree(tiny_scene, tmp_path / "scene"))
    prepare(scene.folder, tmp_path / "out", small_config())
    scene.write_frame(0, 255 - scene.frame(0))
    with pytest.raises(InputError, match="belongs to a different input"):
        prepare(scene.folder, tmp_path / "out", small_config())


@pytest.mark.parametrize("lost", ["scene", "scene/scene.json"])
def test_a_prepared_scene_that_is_gone_is_prepared_again(tiny_scene, tmp_path, lost):
    out = tmp_path / "out"
    prepare(tiny_scene, out, small_config())
    shutil.rmtree(out / lost) if (out / lost).is_dir() else (out / lost).unlink()
    assert find_prepared(tiny_scene, out, small_config()) is None
    assert Scene(prepare(tiny_scene, out, small_config()).scene_path).has_depth(0)


@pytest.mark.skipif(sys.platform != "linux", reason="names of files are text elsewhere")
def test_names_of_files_that_are_no_text_are_no_trouble(tiny_scene, tmp_path):
    scene, out = (tmp_path / os.fsdecode(name) for name in (b"sc\xffne", b"\xfeout"))
    shutil.copytree(tiny_scene, scene)
    (scene / os.fsdecode(b"n\xffte.txt")).write_text("of somebody")
    for command in (["prepare", scene, "-o", out, *SMALL[:2]], ["info", out]):
        ended = subprocess.run([*COMMAND, *command], capture_output=True, text=True, timeout=240)
        assert ended.returncode == 0, ended.stderr
    assert r"\udcfeout of" in ended.stdout
    assert RunFolder(out).record["input"].endswith(r"sc\udcffne")
    assert find_prepared(scene, out, small_config()) is not None


def test_a_scene_that_does_not_fit_on_the_disk_is_one_line(tiny_scene, tmp_path, monkeypatch):
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device", "x")

    monkeypatch.setattr(os, "link", full)
    monkeypatch.setattr(shutil, "copy2", full)
    with pytest.raises(InputError, match=r"^The disk is full: cannot write .{1,200}$"):
        prepare(tiny_scene, tmp_path / "out", small_config())
    assert not (tmp_path / "out").exists()
