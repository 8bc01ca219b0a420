"""The final fit: what is shown has seen all frames, and what is measured has not."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest

import flowsplat
from flowsplat.common.settings import from_plain, to_plain
from flowsplat.output.viewer.source import Source
from flowsplat.pipeline import RunConfig, evaluate_run, fitting, prepare, run, stages, train
from flowsplat.pipeline.folder import RunFolder
from flowsplat.scenes import Scene
from flowsplat.scenes.synthetic import SyntheticScene, write_synthetic
from flowsplat.training.trainer import Trainer
from flowsplat_benchmarks.datasets.cases import protocol_config
from tests.shared import small_config


@pytest.fixture(scope="module")
def without(tiny_scene, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("without") / "out"
    run(tiny_scene, out, replace(small_config(), final_fit=False))
    return out


def files_of(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def figures_of(out: Path) -> dict:
    metrics = json.loads((out / "metrics.json").read_text())
    return {
        name: value
        for name, value in metrics.items()
        if name not in ("seconds", "wall_seconds", "peak_memory_gib", "memory_gib", "shown")
    }


def psnr(model, scene: Scene, i: int) -> float:
    rendered = model.render(scene.cameras[i], float(scene.timestamps[i])).color
    return float(-10 * np.log10(np.mean((rendered - scene.any_frame(i) / 255) ** 2)))


def video_of(out: Path) -> np.ndarray:
    """[T, H, W, 3] float: the images of the video along the clip's path."""
    with av.open(str(out / "renders" / "input_path_color.mp4")) as opened:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in opened.decode(video=0)]).astype(float)


def test_what_is_measured_is_the_same_to_the_bit(finished, without):
    assert figures_of(finished) == figures_of(without)
    for part in ("model", "scene", "evaluation", "training"):
        assert files_of(finished / part) == files_of(without / part), part
    assert not (without / "model_all_frames").exists()
    shown = [json.loads((out / "metrics.json").read_text())["shown"] for out in (finished, without)]
    assert shown == ["model_all_frames", "model"]
    assert figures_of(finished)["measured"] == "model"


def test_what_is_shown_has_seen_the_heldout_frames(finished, without):
    scene = Scene(finished / "scene")
    measured, shown = flowsplat.load(finished / "model"), flowsplat.load(finished)
    assert all((model.gaussians.seen[:, 0] > 0).any() for model in (measured, shown)), "what the clip has seen is known"
    (i,) = scene.heldout_frames
    assert psnr(shown, scene, i) > psnr(measured, scene, i) + 0.3
    others = [np.mean([psnr(model, scene, k) for k in scene.train_frames]) for model in (shown, measured)]
    assert others[0] > others[1] - 0.3
    assert (finished / "renders" / "input_path.mp4").read_bytes() != (without / "renders" / "input_path.mp4").read_bytes()
    assert "which has not seen them" in (finished / "report.html").read_text()
    assert "which has not seen them" not in (without / "report.html").read_text()
    viewed = Source(finished).loaded.part("all").gaussians.params
    assert all((viewed[name] == value).all() for name, value in shown.gaussians.params.items())


def test_nothing_is_fitted_before_everything_is_measured(tiny_scene, tmp_path, monkeypatch):
    def stop(*arguments, **named):
        raise RuntimeError("stopped in the evaluation")

    monkeypatch.setattr(stages, "evaluate", stop)
    monkeypatch.setattr(fitting, "heldout_flow", lambda *arguments: pytest.fail("too early"))
    with pytest.raises(RuntimeError, match="in the evaluation"):
        run(tiny_scene, tmp_path / "out", small_config())
    assert not (tmp_path / "out" / "model_all_frames").exists()


def test_heldout_pixels_reach_what_is_shown_and_nothing_else(tiny_scene, finished, tmp_path):
    other = tmp_path / "scene"
    shutil.copytree(tiny_scene, other)
    Scene(other).write_frame(9, np.zeros((48, 64, 3), np.uint8))
    run(other, tmp_path / "out", small_config())
    assert files_of(tmp_path / "out" / "model") == files_of(finished / "model")
    assert files_of(tmp_path / "out" / "model_all_frames") != files_of(finished / "model_all_frames")
    for prior in ("depth", "flow", "masks"):
        assert files_of(tmp_path / "out" / "scene" / prior) == files_of(finished / "scene" / prior)


def test_a_final_fit_that_was_stopped_ends_at_the_same_bits(tiny_scene, finished, tmp_path, monkeypatch):
    iterate, config = Trainer.iterate, small_config()
    config = replace(config, train=replace(config.train, checkpoint_every=2))

    def stop(self):
        if self.step == 37:  # of 40, begun at 32
            raise RuntimeError("stopped")
        return iterate(self)

    monkeypatch.setattr(Trainer, "iterate", stop)
    with pytest.raises(RuntimeError, match="stopped"):
        run(tiny_scene, tmp_path / "out", config)
    assert (tmp_path / "out" / "model_all_frames" / "latest.json").exists()
    assert flowsplat.load(tmp_path / "out").render is not None  # the measured model, as long as there is no other
    monkeypatch.setattr(Trainer, "iterate", iterate)
    run(tiny_scene, tmp_path / "out", config)
    name = "model_all_frames/gaussians.safetensors"
    assert (tmp_path / "out" / name).read_bytes() == (finished / name).read_bytes()


def test_it_can_be_left_out_afterwards(tiny_scene, finished, without, tmp_path, monkeypatch):
    shutil.copytree(finished, tmp_path / "out")
    monkeypatch.setattr(Trainer, "run", lambda self: pytest.fail("trained again"))
    run(tiny_scene, tmp_path / "out", replace(small_config(), final_fit=False))
    assert not (tmp_path / "out" / "model_all_frames").exists()
    again, first, final = (video_of(out) for out in (tmp_path / "out", without, finished))
    # The encoder does not give the same bits twice.
    assert np.abs(again - first).mean() < 0.6 * np.abs(again - final).mean()
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["shown"] == "model"


def test_another_training_forgets_it(tiny_scene, finished, tmp_path):
    shutil.copytree(finished, tmp_path / "out")
    folder = prepare(tiny_scene, tmp_path / "out", small_config(seed=5))
    train(folder)
    assert not (tmp_path / "out" / "model_all_frames").exists()
    evaluate_run(folder)
    assert not (tmp_path / "out" / "model_all_frames").exists(), "the measurement alone fits nothing"


def test_without_heldout_frames_there_is_nothing_to_do(tmp_path):
    write_synthetic(tmp_path / "scene", SyntheticScene(width=48, height=32, frames=4), holdout=None)
    run(tmp_path / "scene", tmp_path / "out", small_config())
    assert not (tmp_path / "out" / "model_all_frames").exists()


def test_runs_do_it_and_benchmarks_never(finished):
    assert RunConfig().final_fit
    assert RunFolder(finished).config.final_fit
    assert from_plain(RunConfig, to_plain(replace(RunConfig(), final_fit=False))) == replace(RunConfig(), final_fit=False)
    config, _ = protocol_config("fast", None, 10)
    assert not config.final_fit
