"""The command line as a person uses it: help, figures, and one line with exit code 2 for every bad input."""

from __future__ import annotations

import inspect
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

import flowsplat
from flowsplat import pipeline
from flowsplat.cli import main
from flowsplat.cli.command import functions_of
from flowsplat.cli.help import USUAL_OPTIONS
from flowsplat.common.errors import InputError
from flowsplat.common.kernel_cache import kernels_folder, key_of
from flowsplat.common.source import PACKAGE
from flowsplat.pipeline.compiling import read_signatures
from flowsplat.pipeline.config import find_setting, preset
from flowsplat.pipeline.renamed_options import RENAMED
from flowsplat.scenes import Depth, Scene
from flowsplat.scenes.synthetic import SyntheticScene, write_synthetic

FAST = ["--train.iterations", "6", "--train.checkpoint-every", "3", "--render.paths", "input", "--render.width", "32"]


def call(capsys, *arguments: object) -> tuple[int, str]:
    """Exit code and stderr of a command."""
    code = 0
    try:
        main([str(argument) for argument in arguments])
    except SystemExit as end:
        code = int(end.code or 0)
    return code, capsys.readouterr().err


def refuse(capsys, *arguments: object) -> str:
    """The one line that bad input gives."""
    code, error = call(capsys, *arguments)
    assert code == 2, error
    message = error.strip().splitlines()[-1]
    assert message.startswith("Error: "), error
    assert "Traceback" not in error
    return message


def images(folder: Path, count: int = 4, size: tuple[int, int] = (48, 32)) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    world = cv2.resize(rng.integers(0, 255, (40, 60, 3), dtype=np.uint8), (240, 160), interpolation=cv2.INTER_CUBIC)
    for i in range(count):
        encoded = cv2.imencode(".png", world[20 : 20 + size[1], 20 + 2 * i : 20 + 2 * i + size[0]])[1]
        (folder / f"{i:03d}.png").write_bytes(encoded.tobytes())
    return folder


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("cli") / "scene"
    write_synthetic(folder, SyntheticScene(width=64, height=48, frames=12, fps=6.0), holdout=10)
    return folder


@pytest.mark.parametrize(
    ("arguments", "folder"),
    [
        (["films/Urlaub am See.mov"], "out/Urlaub am See"), (["films/clip.mp4", "-o", "mine"], "mine"), (["films"], "out/films"),
        (["."], "out/here"), (["films", "--sequence", "bear"], "out/bear"), (["films/..."], "out/clip"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("command", ["run", "prepare"])
def test_without_a_folder_the_name_of_the_clip_is_one(tmp_path, monkeypatch, capsys, command, arguments, folder):
    def refuse_folder(source, out, *_):
        raise InputError(f"made in {Path(out).as_posix()}")

    for name in ("run_shots", "prepare"):
        monkeypatch.setattr(pipeline, name, refuse_folder)
    (tmp_path / "here" / "films").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "here")
    assert refuse(capsys, command, *arguments) == f"Error: made in {folder}"


def test_help_explains(capsys):
    with pytest.raises(SystemExit) as end:
        main(["run", "--help-all"])
    assert end.value.code == 0
    text = capsys.readouterr().out
    for word in ("--holdout", "--preset", "--train.iterations", "--seed", "video file"):
        assert word in text


def test_help_is_short_and_says_where_the_rest_is(capsys):
    with pytest.raises(SystemExit) as end:
        main(["run", "--help"])
    assert end.value.code == 0
    text = capsys.readouterr().out
    words = {word.rstrip(",") for word in text.split()}
    usual = set(USUAL_OPTIONS) & words
    with pytest.raises(SystemExit):
        main(["batch", "--help"])
    assert set(USUAL_OPTIONS) <= words | {word.rstrip(",") for word in capsys.readouterr().out.split()}, "every usual option is one"
    assert "--seed" not in text
    assert "video file" in text
    assert re.search(rf"These are {len(usual)} of 1\d\d options. All of them: flowsplat run --help-all\n$", text)
    with pytest.raises(SystemExit):
        main(["export", "--help"])
    assert "--flip-axes" in capsys.readouterr().out, "few options are all shown"


def test_the_version(capsys):
    main(["--version"])
    assert capsys.readouterr().out == f"flowsplat {flowsplat.__version__}\n"


def test_a_file_in_the_folder_is_a_command(tmp_path, monkeypatch):
    package = tmp_path / "some_commands"
    package.mkdir()
    (package / "__init__.py").touch()
    for name, place in (("apples", ""), ("figs", ", place=2"), ("pears", ", place=1"), ("dates", ", place=2"), ("all", "")):
        text = f"from flowsplat.cli.command import Command\nCOMMAND = Command(lambda defaults: (defaults, {name!r}){place})\n"
        (package / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    functions = functions_of("some_commands", ["figs", "--preset", "paper"])
    assert list(functions) == ["pears", "dates", "figs", "all", "apples"]
    assert functions["figs"] == (preset("paper"), "figs")


def test_defaults_are_those_of_the_command_that_is_named(tmp_path, scene, capsys):
    out = tmp_path / "out"
    assert call(capsys, "prepare", scene, "-o", out, "--priors", "true", *FAST)[0] == 0
    for arguments, iterations in (
        (["train", str(out)], 6),
        (["train", str(out), "--preset", "paper"], 1500),
        (["render", str(out)], 6),
        (["run", str(out)], 1600),
        (["export", str(out)], 1600),
    ):
        train = inspect.signature(functions_of("flowsplat.cli.commands", arguments)["train"]).parameters["train"]
        assert train.default.iterations == iterations, arguments


def test_out_is_where_to_write_everywhere(capsys):
    for command in ("run", "prepare", "demo", "export", "tracks", "benchmark rig"):
        with pytest.raises(SystemExit):
            main([*command.split(), "--help"])
        assert re.search(r"-o OUT, (--path OUT, )?--out OUT", capsys.readouterr().out), command


def test_a_run_prints_its_figures_and_says_what_was_held_out(capsys, scene, tmp_path):
    code, error = call(capsys, "run", scene, "-o", tmp_path / "out", "--priors", "true", *FAST)
    assert code == 0
    assert "held-out frames, PSNR" in error
    lines = error.strip().splitlines()
    assert "--holdout none" in lines[-5]
    assert re.fullmatch(
        r"(Sharp|Soft|Blurred) along your path.*; (sharp|soft|blurred) from where other cameras stood.*\.", lines[-4]
    )
    told = [line.split(":", 1)[1].strip() for line in lines[-3:]]
    out = tmp_path / "out"
    assert told == [str(out / "report.html"), f"flowsplat view {out}", f"flowsplat export {out} --to html"]
    assert re.search(r"^time +\S", error, re.M)
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["heldout_frames"]["count"] == 1


def test_the_stages_one_by_one(capsys, scene, tmp_path):
    out = tmp_path / "out"
    assert call(capsys, "prepare", scene, "-o", out, "--priors", "true", *FAST)[0] == 0
    assert call(capsys, "train", out)[0] == 0
    assert call(capsys, "evaluate", out)[0] == 0
    assert call(capsys, "render", out)[0] == 0
    assert (out / "renders" / "input_path.mp4").exists()
    record = json.loads((out / "run.json").read_text())
    assert record["config"]["train"]["iterations"] == 6
    code, error = call(capsys, "render", out, "--render.paths", "input", "--render.slow-motion", "2")
    assert code == 0, error
    assert {path.name for path in (out / "renders").glob("*path*.mp4")} >= {"input_path.mp4", "input_path_slow2.mp4"}
    assert "input_path_slow2.mp4" in (out / "report.html").read_text()
    again = json.loads((out / "run.json").read_text())
    # All time that went into the run is counted, this last one's hundredths of a second, too.
    assert {**again, "wall_seconds": 0} == {**record, "wall_seconds": 0}, "what is asked for once is not kept"
    for command, option in (("train", "--resize"), ("evaluate", "--train.iterations"), ("render", "--train.iterations")):
        assert option in refuse(capsys, command, out, option, "9"), "an option that the command cannot act on"
    main(["info", str(out)])
    counts = json.loads((out / "model" / "model.json").read_text())["objects"]
    assert "Gaussians of the objects: " + ", ".join(f"{n:,} of {m}" for m, n in counts.items()) in capsys.readouterr().out
    assert len(counts) > 1
    assert f"no object 99: there are {', '.join(counts)}" in refuse(capsys, "render", out, "--render.parts", "objects:99")
    assert "no object 99" in refuse(capsys, "render", out, "--render.object-depth", "99=1.2")
    obj, other = list(counts)[:2]
    chosen = ("--render.paths", "bullet", "--render.max-frames", "2", "--render.object-depth", f"{obj}=1.2", f"{other}=.9")
    assert call(capsys, "render", out, *chosen)[0] == 0
    assert (out / "renders" / f"bullet_time_distance_{obj}x1.2_{other}x0.9.mp4").exists()
    assert call(capsys, "info", scene)[0] == 0


@pytest.mark.slow
def test_images_without_anything_else_become_a_scene(capsys, tmp_path):
    folder = images(tmp_path / "Ünïcode and spaces", 6, (96, 64))
    code, error = call(capsys, "run", folder, "-o", tmp_path / "öut put", "--holdout", "none", *FAST)
    assert code == 0, error
    metrics = json.loads((tmp_path / "öut put" / "metrics.json").read_text())
    assert metrics["heldout_frames"] is None
    assert metrics["training_frames"]["psnr"] > 10


@pytest.mark.slow
def test_two_frames_work(capsys, tmp_path):
    code, error = call(capsys, "run", images(tmp_path / "two", 2), "-o", tmp_path / "out", *FAST)
    assert code == 0, error


@pytest.mark.slow
@pytest.mark.parametrize("value", [0, 255])
def test_masks_all_empty_or_all_full_work(capsys, tmp_path, value):
    images(tmp_path / "clip" / "images", 4, (65, 43))
    (tmp_path / "clip" / "masks").mkdir()
    for i in range(4):
        cv2.imwrite(str(tmp_path / "clip" / "masks" / f"{i:03d}.png"), np.full((43, 65), value, np.uint8))
    code, error = call(capsys, "run", tmp_path / "clip", "-o", tmp_path / "out", *FAST)
    assert code == 0, error


def test_input_that_cannot_be_used(capsys, tmp_path):
    out = tmp_path / "out"
    assert "does not exist" in refuse(capsys, "run", tmp_path / "missing.mp4", "-o", out)
    (tmp_path / "empty").mkdir()
    assert "no images" in refuse(capsys, "run", tmp_path / "empty", "-o", out)
    (tmp_path / "text.mp4").write_text("hello\n" * 100)
    refuse(capsys, "run", tmp_path / "text.mp4", "-o", out)
    (tmp_path / "nothing.mp4").write_bytes(b"")
    refuse(capsys, "run", tmp_path / "nothing.mp4", "-o", out)
    refuse(capsys, "run", images(tmp_path / "one", 1), "-o", out)
    uneven = images(tmp_path / "uneven", 3)
    images(tmp_path / "other", 4, (40, 32))
    shutil.copy(tmp_path / "other" / "003.png", uneven)
    refuse(capsys, "run", uneven, "-o", out)
    assert not out.exists()


@pytest.mark.parametrize(("before", "now"), RENAMED.items())
def test_options_that_have_another_name_now(capsys, tmp_path, before, now):
    folder = images(tmp_path / "clip")
    told = refuse(capsys, "run", folder, "-o", tmp_path / "out", before, "1,1@0")
    assert told == f"Error: The option {before} is called {now} now."
    assert refuse(capsys, "run", folder, "-o", tmp_path / "out", f"{before}=1,1@0") == told
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("now", RENAMED.values())
def test_new_names_are_there(now):
    assert find_setting(now.replace("--no-", "--").replace(".no-", ".")) is not None


def test_options_that_do_not_exist(capsys, tmp_path):
    folder = images(tmp_path / "clip")
    assert "preset" in refuse(capsys, "run", folder, "-o", tmp_path / "out", "--preset", "best")
    assert "--train.itrations" in refuse(capsys, "run", folder, "-o", tmp_path / "out", "--train.itrations", "3")
    assert "--start" in refuse(capsys, "run", folder, "-o", tmp_path / "out", "--start", "soon")
    told = refuse(capsys, "render", folder, "--paths", "orbit")
    assert told == "Error: Unrecognized options: --paths, orbit. Perhaps you meant --path or --render.paths."
    assert "holdout" in refuse(capsys, "run", folder, "-o", tmp_path / "out", "--holdout", "1")
    refuse(capsys, "rum", folder)
    assert not (tmp_path / "out").exists()


def test_a_device_that_does_not_work_is_refused_by_every_command(capsys, tmp_path, scene, monkeypatch):
    from flowsplat.common import devices

    monkeypatch.setattr(devices, "gpu_problem", lambda: "nobody plugged it in")
    out, refused = tmp_path / "out", ("--device", "cuda")
    assert "nobody plugged it in" in refuse(capsys, "run", scene, "-o", out, *refused)
    assert not out.exists()
    call(capsys, "prepare", scene, "-o", out, "--priors", "true", *FAST)
    for command in ("train", "evaluate", "render", "view"):
        assert "nobody plugged it in" in refuse(capsys, command, out, *refused)
    assert json.loads((out / "run.json").read_text())["config"]["device"] == "auto"
    assert "nobody plugged it in" in refuse(capsys, "benchmark", "davis", tmp_path, "-o", out, *refused)


def test_folders_that_cannot_be_used(capsys, tmp_path, scene):
    folder = images(tmp_path / "clip")
    (tmp_path / "file").write_text("x")
    refuse(capsys, "run", folder, "-o", tmp_path / "file")
    assert "not the folder of a run" in refuse(capsys, "train", tmp_path / "clip")
    assert "neither" in refuse(capsys, "info", tmp_path / "clip")
    if os.geteuid() != 0:
        (tmp_path / "locked").mkdir(mode=0o500)
        assert "permission" in refuse(capsys, "run", folder, "-o", tmp_path / "locked" / "out")
    call(capsys, "prepare", scene, "-o", tmp_path / "out", "--priors", "true")
    assert "different input" in refuse(capsys, "run", folder, "-o", tmp_path / "out")


def test_what_an_earlier_version_wrote_is_refused_in_one_line(capsys, tmp_path, scene):
    out = tmp_path / "run"
    call(capsys, "run", scene, "-o", out, "--priors", "true", *FAST)
    render, export = ("render", out, "--render.paths", "orbit"), ("export", out, "--to", "ply")
    for names, version, commands in (
        (("run.json",), 1, (render, ("train", out), ("run", scene, "-o", out, "--priors", "true", *FAST))),
        (("model/model.json", "model_all_frames/model.json"), 4, (render, export)),
    ):
        before = {name: (out / name).read_text() for name in names if (out / name).exists()}
        for name, text in before.items():
            (out / name).write_text(json.dumps({**json.loads(text), "version": version}))
        for command in commands:
            assert "earlier flowsplat" in refuse(capsys, *command)
        for name, text in before.items():
            (out / name).write_text(text)


def test_scenes_that_are_damaged(capsys, tmp_path, scene):
    def damaged(name: str) -> Scene:
        shutil.copytree(scene, tmp_path / name)
        return Scene(tmp_path / name)

    newer = damaged("newer")
    (newer.folder / "scene.json").write_text(json.dumps({**newer.info.to_json(), "version": 99}))
    assert "newer" in refuse(capsys, "run", newer.folder, "-o", tmp_path / "a")
    camera = damaged("camera")
    truth = camera.truth
    values = json.loads((truth.folder / "cameras.json").read_text())
    values[2]["viewmat"][0][3] = 1e999
    (camera.folder / "cameras.json").write_text(json.dumps(values))
    camera.finish_prior("cameras", method="given")
    assert "not finite" in refuse(capsys, "run", camera.folder, "-o", tmp_path / "b")
    depth = damaged("depth")
    depth.write_cameras(truth.cameras)
    depth.finish_prior("cameras", method="given")
    for i in depth.train_frames:
        depth.write_depth(i, Depth(np.full((48, 64), np.nan if i == 3 else 1.0), np.ones((48, 64))))
        depth.write_mask(i, np.zeros((48, 64)))
    depth.finish_prior("depth", method="given")
    depth.finish_prior("masks", method="given")
    assert "not finite" in refuse(capsys, "run", depth.folder, "-o", tmp_path / "c", *FAST)


def test_a_truncated_checkpoint_is_one_line(capsys, tmp_path, scene, monkeypatch):
    from flowsplat.training.trainer import Trainer

    out, iterate = tmp_path / "out", Trainer.iterate

    def stop(self):
        if self.step == 5:
            raise KeyboardInterrupt
        return iterate(self)

    monkeypatch.setattr(Trainer, "iterate", stop)
    code, error = call(capsys, "run", scene, "-o", out, "--priors", "true", *FAST)
    assert code == 130
    assert "continues" in error
    checkpoint = next((out / "training").glob("step_*.safetensors"))
    checkpoint.write_bytes(checkpoint.read_bytes()[:500])
    assert "truncated" in refuse(capsys, "run", scene, "-o", out, "--priors", "true", *FAST)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_is_one_line(tmp_path):
    from flowsplat.common.errors import InputError
    from flowsplat.common.files import atomic_path

    def fill() -> None:
        with atomic_path(tmp_path / "x.bin"), open("/dev/full", "wb") as file:
            file.write(b"0" * 100_000)
            file.flush()

    with pytest.raises(InputError, match="disk is full"):
        fill()
    assert not list(tmp_path.iterdir())


def copy_kernels(folder: Path, *without: str) -> Path:
    """Compiled kernels as they are kept here, but for those of some modules, which a run then has to compile."""
    for module in {name.rpartition(".")[0] for name, _ in read_signatures()} - set(without):
        kept = kernels_folder() / f"{module}-{key_of(PACKAGE.joinpath(*module.split('.')).with_suffix('.py'))}"
        if kept.exists():
            shutil.copytree(kept, folder / kept.name)
    return folder


@pytest.mark.slow
def test_killed_in_every_stage_it_ends_with_the_same_figures(tmp_path, scene):
    """SIGKILL, wherever it hits, costs time and nothing else; nor does it matter whether kernels had to be compiled first."""
    kernels = copy_kernels(tmp_path / "kernels", "priors.tracks.agreement", "gaussians.culling.cpu")
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(kernels), "FLOWSPLAT_CACHE": str(tmp_path / "cache")}
    command = [sys.executable, "-m", "flowsplat.cli", "run", str(scene), "--priors", "own", *FAST]

    def metrics(out: Path) -> dict:
        value = json.loads((out / "metrics.json").read_text())
        return {name: v for name, v in value.items() if name not in ("seconds", "wall_seconds", "peak_memory_gib", "memory_gib")}

    subprocess.run([*command, "-o", str(tmp_path / "whole")], check=True, capture_output=True, timeout=1200, env=environment)
    out = tmp_path / "killed"
    signs = [
        out / "scene" / "cameras.json",  # while preparing
        out / "scene" / "depth" / "00005.npz",
        out / "training" / "latest.json",  # while training
        out / "evaluation" / "heldout" / "00009.png",  # while evaluating
        out / "renders" / "renders.json",  # while rendering
    ]
    for sign in signs:
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        process = subprocess.Popen([*command, "-o", str(out)], env=environment, **quiet)
        deadline = time.monotonic() + 300
        while process.poll() is None and not sign.exists() and time.monotonic() < deadline:
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
        process.wait()
    subprocess.run([*command, "-o", str(out)], check=True, capture_output=True, timeout=600, env=environment)
    assert metrics(out) == metrics(tmp_path / "whole")


def test_a_folder_where_a_file_is_wanted(capsys, tmp_path, scene):
    folder = tmp_path / "folder.json"
    folder.mkdir()
    assert "folder.json" in refuse(capsys, "run", scene, "-o", tmp_path / "out", "--priors", "true", "--render.camera-file", folder)
    assert "too long" in refuse(capsys, "run", scene, "-o", tmp_path / ("x" * 300), "--priors", "true")
