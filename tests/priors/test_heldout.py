"""Flow of held-out frames goes to a place of its own."""

from __future__ import annotations

import numpy as np
import pytest

from flowsplat.priors.heldout import heldout_flow
from flowsplat.scenes import Scene
from flowsplat.scenes.layers import Layers
from flowsplat.scenes.synthetic import SyntheticScene, write_synthetic


@pytest.fixture
def scene(tmp_path) -> Scene:
    write_synthetic(tmp_path / "scene", SyntheticScene(width=64, height=48, frames=6, fps=6.0), holdout=3)
    return Scene(tmp_path / "scene")


def test_flow_of_heldout_frames_is_beside_the_scene_and_near_the_truth(scene, tmp_path):
    before = sorted((path, path.stat().st_mtime_ns) for path in scene.folder.rglob("*"))
    layers = Layers(tmp_path / "priors", scene.width, scene.height)
    assert scene.heldout_frames == [2]
    heldout_flow(scene, layers)
    assert layers.flow_pairs == [(1, 2), (2, 1), (2, 3), (3, 2)]
    assert sorted((path, path.stat().st_mtime_ns) for path in scene.folder.rglob("*")) == before
    true, found = scene.truth.flow(1, 2), layers.flow(1, 2)
    error = np.linalg.norm(found.flow - true.flow, axis=-1)[found.trusted & true.trusted]
    assert np.median(error) < 0.5


def test_what_is_there_is_kept_and_a_cut_is_not_crossed(scene, tmp_path):
    layers = Layers(tmp_path / "priors", scene.width, scene.height)
    scene.finish_prior("cameras", method="own", breaks=[3])
    heldout_flow(scene, layers)
    assert all(not layers.flow(*pair).trusted.any() for pair in layers.flow_pairs)
    heldout_flow(scene, layers, lambda a, b, guess=None: pytest.fail("computed again"))


def test_the_folder_of_the_scene_is_refused(scene):
    with pytest.raises(AssertionError):
        heldout_flow(scene, Layers(scene.folder, scene.width, scene.height))
