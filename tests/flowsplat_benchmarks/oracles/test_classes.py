"""Kinds of pixels: boxes before a wall, where each kind is known; and the figures that are made of them."""

from __future__ import annotations

import numpy as np
import pytest

from flowsplat.geometry import Camera
from flowsplat.scenes import Scene
from flowsplat.scenes.layers import write_image
from flowsplat_benchmarks.oracles import classes
from flowsplat_benchmarks.oracles.classes import (
    CLASSES,
    MIN_WITNESSES,
    PixelClasses,
    gains,
    psnr_by_class,
    static_depth_errors,
    view_errors,
)
from tests.flowsplat_benchmarks.oracles.conftest import STATIC

SIZE = (80, 120)


def kinds_of(depth: np.ndarray, **given: np.ndarray) -> np.ndarray:
    texture = np.random.default_rng(0).integers(0, 255, (*SIZE, 3), np.uint8)
    values = {
        "image": texture, "moves": np.zeros(SIZE, bool), "seen": np.full(SIZE, 9), "near_border": np.zeros(SIZE, bool), **given,
    }  # fmt: skip
    found = classes._classes(depth=depth.astype(np.float32), **values)
    return np.array(CLASSES)[found]


def test_slopes_have_no_edges_and_steps_have_two_sides():
    slope = 1 / np.linspace(0.05, 1.0, SIZE[0])[:, None] * np.ones(SIZE)
    assert (kinds_of(slope) == "rest").all(), "inverse depth of a floor is linear in the image"
    step = np.full(SIZE, 4.0)
    step[:, 60:] = 2.0
    found = kinds_of(step)
    assert (found[:, 56:60] == "behind edges").all()
    assert (found[:, 60:64] == "before edges").all()
    assert (found[:, :50] == "rest").all()
    assert (found[:, 70:] == "rest").all()


def test_what_is_narrow_is_thin_and_what_is_even_is_dull():
    pole = np.full(SIZE, 4.0)
    pole[:, 60:65] = 2.0
    assert (kinds_of(pole)[:, 60:65] == "thin").all()
    even = np.full((*SIZE, 3), 128, np.uint8)
    assert (kinds_of(np.full(SIZE, 4.0), image=even) == "dull").all()


def test_the_first_that_holds_counts():
    moves, seen, near_border = np.zeros(SIZE, bool), np.full(SIZE, MIN_WITNESSES), np.zeros(SIZE, bool)
    moves[20:30, 20:30] = True
    seen[:, 90:] = MIN_WITNESSES - 1
    seen[:, 100:] = 0
    near_border[:4] = True
    found = kinds_of(np.full(SIZE, 4.0), moves=moves, seen=seen, near_border=near_border)
    assert found[25, 25] == "moves"
    assert found[25, 33] == "near objects"
    assert found[0, 0] == "border"
    assert found[0, 95] == "few frames"
    assert found[0, 105] == "never seen"
    assert found[60, 60] == "rest"


def test_of_a_scene(wrong_scene, tmp_path):
    """Of the built-in scene all is seen by its own frames; a view from its own place is the frame."""
    scene = Scene(wrong_scene)
    found = PixelClasses(scene)
    frame = found.of_frame(scene.train_frames[2])
    moves = CLASSES.index("moves")
    assert ((frame == moves) == (scene.truth.mask(scene.train_frames[2]) > 0)).all()
    assert (frame == CLASSES.index("never seen")).sum() == 0
    static = static_depth_errors(scene)
    assert len(static) == len(CLASSES) + 1
    assert static[moves]["pixels"] == 0
    assert static[-1]["median"] == pytest.approx(np.exp(STATIC) - 1, rel=1e-3)
    assert static[-1]["pixels"] == sum(each["pixels"] for each in static[:-1])


def test_errors_of_views_are_shared_out(wrong_scene, tmp_path):
    scene = Scene(wrong_scene)
    assert scene.views, "the built-in scene has held-out views"
    for k, view in enumerate(scene.views):
        image = scene.view_image(view).astype(int)
        write_image(tmp_path / f"{view.name}.png", np.clip(image + 10 * (k + 1), 0, 255).astype(np.uint8))
    errors = view_errors(scene, tmp_path)
    assert errors["views"] == [view.name for view in scene.views]
    first = scene.views[0]
    image = scene.view_image(first).astype(int)
    total = ((np.clip(image + 10, 0, 255) - image) ** 2).sum() / 3 / 255**2
    assert sum(errors["squared"][0]) == pytest.approx(total, abs=1e-2)
    assert sum(errors["pixels"][0]) == first.camera.width * first.camera.height
    assert view_errors(scene, tmp_path / "nothing") is None


def test_gains_are_of_one_class_alone():
    count = len(CLASSES)
    own = {"pixels": [[10] * count] * 2, "squared": [[1.0] * count] * 2}
    better = {"pixels": [[10] * count] * 2, "squared": [[0.0] + [1.0] * (count - 1)] * 2}
    assert gains(own, better) == pytest.approx([-10 * np.log10((count - 1) / count)] + [0.0] * (count - 1))
    assert psnr_by_class(own)[0] == pytest.approx(10.0)
    assert psnr_by_class({"pixels": [[0] + [1] * (count - 1)], "squared": [[0.0] * count]})[0] is None


def test_a_camera_behind_a_point_did_not_see_it():
    nearest = np.full(16, np.inf)
    camera = Camera(np.eye(4), np.array([[4.0, 0, 2], [0, 4, 2], [0, 0, 1]]), 4, 4)
    classes._splat(nearest, camera, np.array([[0.0, 0, -1], [0, 0, 2], [0, 0, 3]]))
    found = nearest.reshape(4, 4)
    assert (found[1:3, 1:3] == 2).all()
    assert np.isinf(found).sum() == 12
