"""SAM 2, SAM 3 and EdgeTAM, tiny and random: the true loading and following, on training frames alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from flowsplat.common.errors import InputError
from flowsplat.priors.learned.sam import load_segmenter, prompts_from_masks, sam_stage
from flowsplat.priors.learned.weights import ModelOptions
from flowsplat.priors.prompts import Prompt
from flowsplat.scenes import Scene

from ..planes import HEIGHT, SIDE, WIDTH, square_at, write_planes
from .conftest import import_transformers

CPU = torch.device("cpu")


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return write_planes(tmp_path, step=2, square=True, holdout=5)


@pytest.mark.parametrize("name", ["sam2", "sam3", "edgetam"])
def test_objects_are_followed_from_where_they_are_shown(scene: Scene, name: str, request):
    folder = request.getfixturevalue(name)
    segmenter = load_segmenter(name, ModelOptions(**{name: str(folder)}), CPU)
    assert segmenter.network.dtype == torch.float32
    prompts = [
        Prompt(3, ((40.5, 30.5),), (29, 18, 57, 46), number=1), Prompt(0, ((100.0, 30.0),), number=2),
        Prompt(3, (), (80, 10, 120, 50), number=3),
    ]  # fmt: skip
    sam_stage(scene, segmenter, prompts, "clicks and boxes")
    found = [scene.mask(i) for i in scene.train_frames]
    assert all(mask.shape == (HEIGHT, WIDTH) for mask in found)
    assert set(np.unique(found)) <= {0, 1, 2, 3}
    assert np.max(found) > 0
    assert not any(scene.has_mask(i) for i in scene.heldout_frames)
    how = scene.prior("masks")
    assert how["method"] == name
    assert how["objects"] == 3
    assert str(folder) in how["verdict"]


def test_without_prompts_masks_are_empty(scene: Scene, sam2: Path):
    sam_stage(scene, load_segmenter("sam2", ModelOptions(sam2=str(sam2)), CPU), [], "motion")
    assert not any(scene.mask(i).any() for i in scene.train_frames)


def test_masks_become_prompts_where_an_object_is_largest(scene: Scene):
    for i in scene.train_frames:
        mask = scene.truth.mask(i)
        if i != 5:
            mask[: square_at(i)[1] + 6] = 0
        scene.write_mask(i, 2 * mask)
    (prompt,) = prompts_from_masks(scene)
    x, y = square_at(5)
    assert prompt.frame == 5
    assert prompt.box == (x, y, x + SIDE, y + SIDE)
    assert abs(prompt.clicks[0][0] - (x + SIDE / 2)) <= 1
    assert abs(prompt.clicks[0][1] - (y + SIDE / 2)) <= 1


def test_an_absent_model_says_how_to_get_it():
    import_transformers()
    with pytest.raises(InputError, match="--masks sam2: the model facebook/") as caught:
        load_segmenter("sam2", ModelOptions(), CPU)
    message = str(caught.value)
    assert "hf download facebook/sam2.1-hiera-tiny" in message
    assert "--models.sam2 FOLDER" in message
    assert "--masks motion" in message
    assert "\n" not in message


def test_another_network_is_refused(depth_anything: Path):
    with pytest.raises(InputError, match="--masks sam2: ") as caught:
        load_segmenter("sam2", ModelOptions(sam2=str(depth_anything)), CPU)
    assert "\n" not in str(caught.value)


def test_edgetam_needs_the_package_of_its_backbone(monkeypatch):
    import_transformers()
    monkeypatch.setitem(__import__("sys").modules, "timm", None)
    with pytest.raises(InputError, match=r"--masks edgetam needs timm.*pip install timm.*--masks motion"):
        load_segmenter("edgetam", ModelOptions(), CPU)


def test_without_transformers_there_is_a_reason(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "transformers", None)
    with pytest.raises(InputError, match=r"--masks sam3 needs transformers.*\.\[learned\].*--masks motion"):
        load_segmenter("sam3", ModelOptions(), CPU)
