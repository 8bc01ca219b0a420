"""Depth Anything and Depth Pro, tiny and random, through the true loading code."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from flowsplat.common.errors import InputError
from flowsplat.priors.learned.depth import predict_depth
from flowsplat.priors.learned.weights import ModelOptions
from flowsplat.scenes import Scene

from .conftest import import_transformers

CPU = torch.device("cpu")


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    scene = Scene.create(
        tmp_path / "scene", name="s", source="", width=60, height=40, timestamps=range(2), holdout=None, source_fps=1
    )
    for i in range(2):
        scene.write_frame(i, np.random.default_rng(i).integers(0, 255, (40, 60, 3)).astype(np.uint8))
    return scene


def test_depth_anything_says_inverse_depth_up_to_a_shift(scene: Scene, depth_anything: Path):
    source = predict_depth("depth-anything", scene, ModelOptions(depth_anything=str(depth_anything)), CPU)
    inverse, confidence = source.inverse(0)
    assert source.relative
    assert str(depth_anything) in source.source
    assert inverse.shape == confidence.shape == (40, 60)
    assert inverse.std() > 0
    assert (confidence == 1).all()
    np.testing.assert_array_equal(source.inverse(0)[0], inverse)
    assert np.abs(source.inverse(1)[0] - inverse).max() > 0


def test_its_metric_variants_say_depth(scene: Scene, depth_anything: Path, tmp_path: Path):
    folder = tmp_path / "metric"
    shutil.copytree(depth_anything, folder)
    config = (folder / "config.json").read_text()
    (folder / "config.json").write_text(config.replace('"relative"', '"metric"').replace('"max_depth": null', '"max_depth": 20'))
    source = predict_depth("depth-anything", scene, ModelOptions(depth_anything=str(folder)), CPU)
    inverse, confidence = source.inverse(0)
    assert not source.relative
    assert np.isfinite(inverse).all()
    assert (inverse[confidence > 0] >= 1 / 20 - 1e-6).all()


def test_depth_pro_says_depth(scene: Scene, depth_pro: Path):
    source = predict_depth("depth-pro", scene, ModelOptions(depth_pro=str(depth_pro)), CPU)
    inverse, confidence = source.inverse(0)
    assert not source.relative
    assert inverse.shape == (40, 60)
    assert (inverse > 0).all()
    assert (confidence == 1).all()


@pytest.mark.parametrize("source", ["no-such-owner/no-such-model", "/nowhere/at/all"])
def test_an_absent_model_says_how_to_get_it(scene: Scene, source: str):
    import_transformers()
    with pytest.raises(InputError, match=rf"--depth depth-pro: .*{source}.*--models.depth-pro FOLDER.*--depth multiview") as caught:
        predict_depth("depth-pro", scene, ModelOptions(depth_pro=source), CPU)
    assert "\n" not in str(caught.value)
    assert ("hf download" in str(caught.value)) == (source == "no-such-owner/no-such-model")


def test_an_incomplete_checkpoint_is_refused(scene: Scene, depth_anything: Path, tmp_path: Path):
    folder = tmp_path / "half"
    shutil.copytree(depth_anything, folder)
    weights = load_file(folder / "model.safetensors")
    save_file(
        {name: values for name, values in weights.items() if "head" not in name}, folder / "model.safetensors", {"format": "pt"}
    )
    with pytest.raises(InputError, match="lacks 6 of its weights"):
        predict_depth("depth-anything", scene, ModelOptions(depth_anything=str(folder)), CPU)


def test_a_truncated_checkpoint_is_refused(scene: Scene, depth_anything: Path, tmp_path: Path):
    folder = tmp_path / "cut"
    shutil.copytree(depth_anything, folder)
    whole = (folder / "model.safetensors").read_bytes()
    (folder / "model.safetensors").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="--depth depth-anything: ") as caught:
        predict_depth("depth-anything", scene, ModelOptions(depth_anything=str(folder)), CPU)
    assert "\n" not in str(caught.value)
