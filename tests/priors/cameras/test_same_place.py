"""Two clips of one place lie to each other as they should; clips of two places do not."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from flowsplat.geometry import Similarity
from flowsplat.priors.cameras.same_place import find_same_place
from flowsplat.scenes import Scene
from flowsplat.scenes.layers import Depth
from flowsplat.scenes.synthetic import StreetScene, SyntheticScene

WIDTH, HEIGHT, COUNT = 320, 180, 6


def write_clip(folder, spec: SyntheticScene | StreetScene, begin: int, moved: Similarity, error: float = 0.0) -> Scene:
    """Some frames with their true masks and depth, in coordinates of their own."""
    scene = Scene.create(
        folder, name="clip", source="clip", width=WIDTH, height=HEIGHT, timestamps=[i / 8 for i in range(COUNT)], holdout=None,
        source_fps=8.0,
    )  # fmt: skip
    cameras, rng = [], np.random.default_rng(begin)
    for k in range(COUNT):
        camera, time = spec.camera(begin + 3 * k), spec.timestamps[begin + 3 * k]
        view = spec.render(camera, time)
        scene.write_frame(k, view.image)
        scene.write_mask(k, view.mask)
        noise = np.exp(error * rng.normal(size=view.depth.shape)).astype(np.float32)
        scene.write_depth(k, Depth(view.depth * np.float32(moved.scale) * noise, np.ones_like(view.depth)))
        cameras.append(moved.camera(camera))
    scene.write_cameras(cameras)
    scene.finish_prior("depth", method="multi-view")
    return scene


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    spec = SyntheticScene(width=WIDTH, height=HEIGHT, frames=60)
    moved = Similarity(2.5, cv2.Rodrigues(np.array([0.3, -0.8, 0.2]))[0], np.array([4.0, -1.0, 2.0]))
    folder = tmp_path_factory.mktemp("clips")
    first = write_clip(folder / "a", spec, 0, Similarity())
    second = write_clip(folder / "b", spec, 16, moved, error=0.02)
    other = write_clip(folder / "c", StreetScene(width=WIDTH, height=HEIGHT, frames=60), 16, Similarity())
    return first, second, other, moved


def test_one_place(clips):
    first, second, _, moved = clips
    found = find_same_place(first, second)
    assert found is not None
    assert found.matches > 100
    assert found.pixels < 1.5
    assert found.split_pixels < 1.5
    assert found.similarity.scale == pytest.approx(moved.scale, rel=0.02)
    np.testing.assert_allclose(found.similarity.rotation, moved.rotation, atol=0.01)


def test_two_places(clips):
    first, second, other, _ = clips
    assert find_same_place(first, other) is None
    assert find_same_place(other, second) is None


def test_depth_that_is_a_guess_tells_nothing(clips):
    first, second, *_ = clips
    first.amend_prior("depth", method="guess")
    assert find_same_place(first, second) is None
