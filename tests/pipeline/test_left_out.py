"""A run of a long clip says what it left out, and what all frames would cost; one of a short clip says nothing of that."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from flowsplat.common.settings import with_settings
from flowsplat.pipeline.config import RunConfig
from flowsplat.pipeline.fitting import train
from flowsplat.pipeline.folder import RunFolder
from flowsplat.pipeline.left_out import measure_object_step, word_left_out, word_left_out_after
from flowsplat.pipeline.speed import Speed, estimate_seconds, estimate_seconds_with
from flowsplat.scenes import Scene
from flowsplat.scenes.clip import InputOptions
from flowsplat.scenes.ingest import ingest, open_clip
from flowsplat.scenes.layers import Flow, write_image
from flowsplat.training import clip_length


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A clip of 60 frames at 24 a second."""
    path, rng = tmp_path_factory.mktemp("long") / "images", np.random.default_rng(0)
    path.mkdir()
    for i in range(60):
        write_image(path / f"{i:03d}.png", rng.integers(0, 255, (48, 64, 3), dtype=np.uint8))
    return path


def test_frames_that_are_left_out_are_said_with_their_price(folder, tmp_path):
    options = InputOptions(max_frames=20)
    scene = ingest(open_clip(folder, options), tmp_path / "scene", options)
    config = with_settings(RunConfig(), {"input.max_frames": 20})
    assert json.loads((tmp_path / "scene" / "scene.json").read_text())["input_frames"] == 60
    said = word_left_out(Scene(scene.folder), config, Speed("cpu"))
    assert said is not None
    assert re.fullmatch(r"Used 20 of 60 frames, 8 a second: --max-frames 60 takes about .+ and 0\.\d GiB here\.", said)
    every = with_settings(RunConfig(), {"input.max_frames": 20, "input.every": 3})
    assert "--every 1 --max-frames 60 takes" in str(word_left_out(scene, every, Speed("cpu")))


def test_a_measured_run_tells_by_what_it_took(folder, tmp_path):
    options = InputOptions(max_frames=20)
    scene = ingest(open_clip(folder, options), tmp_path / "scene", options)
    config = RunConfig()
    longer = sum(estimate_seconds_with(scene, config, 60).values()) / sum(estimate_seconds(scene, config).values())
    assert longer > 1
    said = word_left_out_after(scene, config, {"seconds": {"train": 500.0, "flow": 100.0}})
    assert f"takes about {600 * longer / 60:.0f} minutes" in str(said)
    assert word_left_out_after(scene, config, {}) is None


def test_how_far_what_moves_goes_is_said(folder, tmp_path):
    options = InputOptions(max_frames=20)
    scene = ingest(open_clip(folder, options), tmp_path / "scene", options)
    assert measure_object_step(scene) is None
    frames, measured = scene.train_frames, {"seconds": {"train": 500.0}}
    mask, flow = np.zeros((48, 64), np.uint8), np.full((48, 64, 2), (-2, 1), np.float32)
    mask[10:20, 10:30] = 1
    flow[mask > 0] += (3, 4)
    for i, j in pairwise(frames):
        scene.write_flow(Flow(i, j, flow, np.ones((48, 64), np.float32)))
    assert measure_object_step(scene) is None, "there are no masks"
    for i in frames:
        scene.write_mask(i, mask)
    assert measure_object_step(scene) == pytest.approx(5, abs=0.05)
    assert "8 a second; what moves goes 5 pixels from one to the next: --max-frames 60" in str(
        word_left_out_after(scene, RunConfig(), measured)
    )
    for i in frames:
        scene.write_mask(i, mask * 0)
    assert measure_object_step(scene) is None, "nothing moves"


def test_nothing_is_said_where_all_frames_are_used(folder, tmp_path):
    options = InputOptions()
    scene = ingest(open_clip(folder, options), tmp_path / "scene", options)
    assert "input_frames" not in json.loads((tmp_path / "scene" / "scene.json").read_text())
    assert word_left_out(scene, RunConfig(), Speed("cpu")) is None
    assert word_left_out_after(scene, RunConfig(), {"seconds": {"train": 10.0}}) is None


def test_the_same_number_of_frames_costs_the_same(folder, tmp_path):
    options = InputOptions(max_frames=20)
    scene = ingest(open_clip(folder, options), tmp_path / "scene", options)
    assert estimate_seconds_with(scene, RunConfig(), 20) == estimate_seconds(scene, RunConfig())


def test_a_long_clip_takes_more_steps(finished, tmp_path, monkeypatch):
    shutil.copytree(finished, tmp_path / "run")
    folder = RunFolder(tmp_path / "run")
    scene, settings = Scene(folder.scene_path), folder.config.train
    monkeypatch.setattr(clip_length, "FULL_FRAMES", scene.num_frames / 2)
    of_steps = replace(folder.config, train=replace(settings, iterations=8, adapt_to_length=False))
    folder.config = replace(folder.config, train=replace(settings, iterations=4, adapt_to_length=True))
    assert estimate_seconds(scene, folder.config) == estimate_seconds(scene, of_steps)
    folder.save()
    train(folder)
    assert json.loads((tmp_path / "run" / "training" / "history.json").read_text())[-1]["step"] == 8
