"""Flow of objects is searched again where nothing else is seen."""

from __future__ import annotations

import numpy as np
import pytest

from flowsplat.priors.flow import flow_stage
from flowsplat.priors.object_flow import object_flow_stage
from flowsplat.scenes import Scene
from tests.priors.planes import texture

WIDTH, HEIGHT, STEP, THICK, LONG = 128, 80, 9, 6, 44
"""A bar goes so many pixels a frame to the right."""


@pytest.fixture
def scene(tmp_path) -> Scene:
    scene = Scene.create(
        tmp_path / "scene", name="bar", source="", width=WIDTH, height=HEIGHT, timestamps=range(6), holdout=5, source_fps=1
    )
    wall, bar = texture(0, WIDTH, HEIGHT), texture(1, THICK, LONG)
    for i in range(6):
        image, mask = wall.copy(), np.zeros((HEIGHT, WIDTH), np.uint8)
        there = np.s_[18 : 18 + LONG, 20 + STEP * i : 20 + STEP * i + THICK]
        image[there], mask[there] = bar, 1
        scene.write_frame(i, image)
        if i in scene.train_frames:
            scene.write_mask(i, mask)
    scene.finish_prior("masks", method="given")
    flow_stage(scene)
    return scene


def test_a_thin_bar_that_is_fast_is_found_and_what_rests_stays(scene):
    before = {pair: scene.flow(*pair) for pair in scene.flow_pairs}
    object_flow_stage(scene)
    assert scene.prior("flow")["method"] == "dis"
    assert scene.prior("flow")["objects"]
    errors = []
    for (i, j), earlier in before.items():
        mask, found = scene.mask(i) > 0, scene.flow(i, j)
        np.testing.assert_array_equal(found.flow[~mask], earlier.flow[~mask])
        np.testing.assert_array_equal(found.confidence[~mask], earlier.confidence[~mask])
        true = np.array([STEP * (j - i), 0.0])
        errors.append([np.median(np.linalg.norm(each.flow[mask] - true, axis=-1)) for each in (earlier, found)])
    earlier, found = np.array(errors).T
    assert np.median(found) < 0.5
    assert found.mean() < 0.5 * earlier.mean()


def test_no_masks_no_search(scene, tmp_path):
    for i in scene.train_frames:
        scene.write_mask(i, np.zeros((HEIGHT, WIDTH), np.uint8))
    before = {pair: scene.flow(*pair).flow for pair in scene.flow_pairs}
    object_flow_stage(scene)
    for pair, flow in before.items():
        np.testing.assert_array_equal(scene.flow(*pair).flow, flow)
