"""What is looked at, while it changes."""

from __future__ import annotations

import os
import time
from dataclasses import replace

import numpy as np
import pytest

from flowsplat.output.viewer.source import Source
from flowsplat.pipeline import prepare, train
from flowsplat.pipeline.config import RunConfig
from flowsplat.scenes.synthetic import SyntheticScene, write_synthetic
from flowsplat.training.checkpoint import load_model
from flowsplat.training.trainer import Trainer
from tests.output.tiny import tiny_run


class Stopped(Exception):
    pass


def test_a_training_can_be_watched(tmp_path, monkeypatch):
    """A checkpoint is shown, then a newer one, then the trained model."""
    write_synthetic(tmp_path / "clip", SyntheticScene(width=48, height=32, frames=6, fps=6.0), holdout=None)
    config = RunConfig()
    settings = replace(config.train, iterations=9, checkpoint_every=3)
    config = replace(config, train=settings, priors=replace(config.priors, priors="true"))
    folder = prepare(tmp_path / "clip", tmp_path / "out", config)

    def until(step: int) -> None:
        iterate = Trainer.iterate

        def stopping(self, *arguments):
            if self.step == step:
                raise Stopped
            return iterate(self, *arguments)

        with monkeypatch.context() as patch:
            patch.setattr(Trainer, "iterate", stopping)
            with pytest.raises(Stopped):
                train(folder)

    until(4)
    source = Source(tmp_path / "out")
    assert source.loaded.state == "in training, step 3 of 9"
    assert not source.refresh()
    camera = source.path.at(0.5)
    before = source.loaded.part("all").render(camera, 0.5).color
    assert np.abs(before - source.frame(0.5) / 255).mean() < 0.2

    until(7)
    assert source.refresh()
    assert (source.loaded.state, source.loaded.number) == ("in training, step 6 of 9", 1)
    assert np.abs(source.loaded.part("all").render(camera, 0.5).color - before).max() > 0

    train(folder)
    assert source.refresh()
    assert source.loaded.state == "trained"
    expected = load_model(tmp_path / "out" / "model").render(camera, 0.5).color
    np.testing.assert_array_equal(source.loaded.part("all").render(camera, 0.5).color, expected)


def test_the_first_scene_is_shown_until_there_is_another(tmp_path):
    """It has a size, cameras and times of its own."""
    folder = tmp_path / "out"
    tiny_run(folder / "coarse", size=(32, 24))
    (folder / "coarse" / "run.json").rename(folder / "run.json")
    source = Source(folder)  # before the run has frames of its own
    assert (source.loaded.state, source.size) == ("a coarse scene", (32, 24))
    assert source.path.at(0.5).width == 32
    assert not source.refresh()
    other = tiny_run(tmp_path / "other")
    (other / "scene").rename(folder / "scene")
    assert not source.refresh()
    (other / "model").rename(folder / "model")
    assert source.refresh()
    assert (source.loaded.state, source.size) == ("trained", (64, 48))
    assert source.path.at(0.5).width == 64
    assert source.frame(0.5).shape == (48, 64, 3)


def test_the_clock_does_not_tell_what_is_newer(tmp_path):
    """It was set back by a year after the last checkpoint."""
    folder = tiny_run(tmp_path / "out")
    (folder / "training").mkdir()
    (folder / "training" / "latest.json").write_text("{}")
    year_ago = time.time() - 365 * 86_400
    for path in (folder / "model").iterdir():
        os.utime(path, (year_ago, year_ago))
    assert Source(folder).loaded.state == "trained"


def test_a_model_that_is_being_replaced_is_left_for_later(tmp_path):
    folder = tiny_run(tmp_path / "out")
    source = Source(folder)
    whole = (folder / "model" / "gaussians.safetensors").read_bytes()
    (folder / "model" / "gaussians.safetensors").write_bytes(whole[: len(whole) // 2])
    (folder / "model" / "model.json").touch()
    assert not source.refresh()
    (folder / "model" / "gaussians.safetensors").write_bytes(whole)
    assert source.refresh()
    (folder / "model" / "model.json").unlink()
    assert not source.refresh()
    assert source.loaded.number == 1


def test_a_model_that_has_no_room_changes_nothing(tmp_path, monkeypatch):
    folder = tiny_run(tmp_path / "out")
    source = Source(folder)
    loaded, scene = source.loaded, source.scene
    (folder / "model" / "model.json").touch()

    def ready(self, model):
        raise RuntimeError("out of memory")

    with monkeypatch.context() as patch:
        patch.setattr(Source, "_ready", ready)
        with pytest.raises(RuntimeError, match="out of memory"):
            source.refresh()
    assert source.loaded is loaded
    assert source.scene is scene
    assert source.refresh(), "it is looked for again"


def test_parts_and_frames(run_folder):
    source = Source(run_folder)
    loaded = source.loaded
    assert loaded.part("objects") is loaded.part("objects")
    counts = [len(loaded.part(part).gaussians) for part in ("all", "background", "objects")]
    assert counts[0] == counts[1] + counts[2]
    assert source.scene.heldout_frames == [4]
    for i, t in enumerate(source.scene.timestamps):
        assert source.frame_number(float(t) + 0.01) == i
        assert source.frame(float(t)).shape == (48, 64, 3)
