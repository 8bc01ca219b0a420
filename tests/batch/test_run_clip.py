"""How a clip is run again for which memory ran short."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from flowsplat.batch.clips import BatchClip
from flowsplat.batch.run_clip import fewer_gaussians, run_clip
from flowsplat.common.errors import InputError
from flowsplat.pipeline.config import RunConfig
from flowsplat.scenes import Scene
from tests.shared import SCENE, made_before, make_scene, small_config

ATTEMPT = SimpleNamespace(fewer=False, needs=lambda gib: None)


def test_a_clip_that_ran_out_of_memory_begins_with_half_as_many_gaussians():
    config = RunConfig()
    half = fewer_gaussians(config).train
    assert half.density.max_gaussians == config.train.density.max_gaussians // 2
    assert half.gaussians == 0
    budget = replace(config, train=replace(config.train, gaussians=100_000))
    assert fewer_gaussians(budget).train.most_at_start == budget.train.most_at_start // 2


def test_a_clip_that_changed_is_done_anew(tmp_path, capsys):
    shared = made_before(SCENE) or make_scene(tmp_path / "shared")
    scenes = [Scene(shutil.copytree(shared, tmp_path / name)) for name in ("scene", "other")]
    config = small_config()
    config = replace(config, final_fit=False, train=replace(config.train, iterations=3))
    clip = BatchClip("clip", scenes[0].folder, config)
    first = run_clip(clip, tmp_path, None, ATTEMPT)
    (tmp_path / "clip" / "export").mkdir()
    assert run_clip(clip, tmp_path, None, ATTEMPT)["psnr"] == first["psnr"]
    assert "begins anew" not in capsys.readouterr().err
    scenes[0].write_frame(0, 255 - scenes[0].frame(0))
    second = run_clip(clip, tmp_path, None, ATTEMPT)
    assert "scene is not what it was" in capsys.readouterr().err
    assert second["fingerprint"] != first["fingerprint"]
    assert not (tmp_path / "clip" / "export").exists()
    assert not list(tmp_path.glob(".*.before"))
    made = (tmp_path / "clip" / "metrics.json").read_bytes()
    scenes[0].write_frame(0, 255 - scenes[0].frame(0))
    wrong = replace(config, render=replace(config.render, bullet_time=1e6))
    with pytest.raises(InputError, match="bullet"):
        run_clip(replace(clip, config=wrong), tmp_path, None, ATTEMPT)
    assert (tmp_path / "clip" / "metrics.json").read_bytes() == made, "what cannot be done anew costs nothing"
    with pytest.raises(InputError, match="belongs to a different input"):  # and not because another clip is called so
        run_clip(replace(clip, path=scenes[1].folder), tmp_path, None, ATTEMPT)
    assert Path(tmp_path / "clip" / "metrics.json").exists()
