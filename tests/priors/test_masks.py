"""Masks of movers: found under a moving and a resting camera, empty where nothing moves, numbered over time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flowsplat.priors.flow import flow_stage
from flowsplat.priors.masks import _number, mask_stage
from flowsplat.scenes import Flow, Scene

from .planes import HEIGHT, WIDTH, write_planes


def overlap(scene: Scene, i: int) -> float:
    found, true = scene.mask(i) > 0, scene.truth.mask(i) > 0
    return float((found & true).sum() / (found | true).sum())


@pytest.mark.parametrize("step", [2, 0])
def test_the_square_is_found(tmp_path: Path, step: int):
    scene = write_planes(tmp_path, step=step, square=True, holdout=5)
    flow_stage(scene)
    mask_stage(scene)
    assert np.mean([overlap(scene, i) for i in scene.train_frames]) > 0.6
    assert {int(n) for i in scene.train_frames for n in np.unique(scene.mask(i))} == {0, 1}
    how = scene.prior("masks")
    assert how["method"] == "motion"
    assert how["objects"] == 1
    assert not any(scene.has_mask(i) for i in scene.heldout_frames)


@pytest.mark.parametrize("step", [2, 0])
def test_where_nothing_moves_masks_are_empty(tmp_path: Path, step: int):
    scene = write_planes(tmp_path, step=step, square=False)
    flow_stage(scene)
    mask_stage(scene)
    assert not any(scene.mask(i).any() for i in scene.train_frames)
    assert scene.prior("masks")["verdict"] == "nothing moves"


def test_given_masks_stay(tmp_path: Path):
    scene = write_planes(tmp_path, step=2, square=True)
    for i in scene.train_frames:
        scene.write_mask(i, np.full((HEIGHT, WIDTH), 7, np.uint8))
    scene.finish_prior("masks", method="given")
    mask_stage(scene)
    assert (scene.mask(3) == 7).all()


def test_numbers_follow_the_flow_and_parting_objects_part(tmp_path: Path):
    scene = write_planes(tmp_path, step=0, square=False)
    steps = {(i, j): np.full((HEIGHT, WIDTH, 2), [6.0 * (j - i), 0], np.float32) for i in range(12) for j in (i - 1, i + 1)}
    for (i, j), flow in steps.items():
        if 0 <= j < 12:
            scene.write_flow(Flow(i, j, flow, np.ones((HEIGHT, WIDTH), np.float32)))
    for i in scene.train_frames:
        mask = np.zeros((HEIGHT, WIDTH), np.uint8)
        mask[10:20, 6 * i + 4 : 6 * i + 14] = 1
        mask[20:30, 6 * i + 4 : 6 * i + 14] = i < 6
        mask[32:44, 6 * i + 4 : 6 * i + 14] = i >= 6
        mask[60:70, 6 * i + 4 : 6 * i + 14] = 1
        scene.write_mask(i, mask)
    objects, share = _number(scene)
    assert (objects, scene.mask(5)[15, 36], scene.mask(5)[65, 36]) == (3, 1, 2)
    assert scene.mask(11)[15, 72] == 1
    assert scene.mask(11)[38, 72] == 3
    assert scene.mask(11)[65, 72] == 2
    assert share == pytest.approx(310 / (HEIGHT * WIDTH), rel=0.05)
