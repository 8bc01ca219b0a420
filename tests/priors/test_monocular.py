"""Monocular depth: a robust line finds scale and shift, objects get their depth, and a tripod says that its scale is free."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flowsplat.priors.background.monocular_maps import Monocular, fit_line
from flowsplat.priors.flow import flow_stage
from flowsplat.priors.monocular import monocular_stage
from flowsplat.scenes import Scene

from .planes import HEIGHT, WALL, WIDTH, write_planes


def test_a_line_is_found_although_a_third_is_off_it():
    rng = np.random.default_rng(0)
    x = rng.uniform(0, 1, 900)
    y = 0.3 * x + 0.1 + rng.normal(0, 0.002, 900)
    y[::3] = rng.uniform(0.2, 0.9, 300)
    a, b = fit_line(x, y, np.ones(900), 0.5)
    assert a == pytest.approx(0.3, rel=0.03)
    assert b == pytest.approx(0.1, rel=0.03)


def test_weights_decide_which_line():
    x = np.tile(np.linspace(1, 2, 50), 2)
    y = np.concatenate([2 * x[:50], 5 * x[50:]])
    a, b = fit_line(x, y, np.repeat([1.0, 0.01], 50), 0.5)
    assert a == pytest.approx(2, rel=0.02)
    assert b == pytest.approx(0, abs=0.05)


@pytest.mark.parametrize("x", [np.full(100, 0.5), np.linspace(1, 0, 100)])
def test_what_is_flat_or_runs_against_the_scene_gets_a_scale_alone(x):
    a, b = fit_line(x, np.linspace(1, 3, 100), np.ones(100), 0.5)
    assert a * np.median(x) + b == pytest.approx(2, rel=0.1)
    assert a > 0
    assert abs(b) < 0.1


def test_what_cannot_be_told_apart_is_scale_and_not_shift():
    rng = np.random.default_rng(0)
    x = 0.5 + rng.normal(0, 0.001, 2000)
    a, b = fit_line(x, 0.25 + rng.normal(0, 0.003, 2000), np.ones(2000), 0.05)
    assert a == pytest.approx(0.5, rel=0.1)
    assert b == pytest.approx(0, abs=0.02)


def test_a_line_never_turns_depth_round():
    a, b = fit_line(np.full(10, -1.0), np.ones(10), np.ones(10), 0.5)
    assert a >= 0
    assert b - a == pytest.approx(1, abs=0.1)


def slanted_truth(scene: Scene, i: int) -> np.ndarray:
    """Inverse depth as a network might see it: exact on wall and square, with a little detail so that lines can be fitted."""
    rows = np.linspace(-1, 1, HEIGHT, dtype=np.float32)[:, None]
    return 1 / scene.truth.depth(i).depth * (1 + 0.002 * rows)


def network(scene: Scene, relative: bool, asked: list[int] | None = None) -> Monocular:
    """The truth under another scale and, where ``relative``, shift in every frame."""

    def inverse(i: int) -> tuple[np.ndarray, np.ndarray]:
        if asked is not None:
            asked.append(i)
        rng = np.random.default_rng(i)
        scale, shift = rng.uniform(2, 5), rng.uniform(-1, 1) * relative
        return scale * slanted_truth(scene, i) + shift, np.ones((HEIGHT, WIDTH), np.float32)

    return Monocular("depth-anything", "a test", relative, inverse)


@pytest.fixture(scope="module")
def moving(tmp_path_factory) -> Scene:
    scene = write_planes(tmp_path_factory.mktemp("moving"), step=2, square=True, holdout=5)
    flow_stage(scene)
    for i in scene.train_frames:
        scene.write_mask(i, scene.truth.mask(i))
    scene.finish_prior("masks", method="truth")
    return scene


def test_scale_alone_gives_objects_the_depth_that_matches_cannot(moving: Scene):
    asked: list[int] = []
    monocular_stage(moving, network(moving, relative=False, asked=asked))
    assert asked == moving.train_frames
    for i in moving.train_frames:
        mask, found = moving.mask(i) > 0, moving.depth(i)
        assert np.median(np.abs(found.depth[~mask] / WALL - 1)) < 0.02
        assert np.median(np.abs(found.depth[mask] / (WALL / 2) - 1)) < 0.05
        assert found.trusted[mask].all()
        assert found.trusted.mean() > 0.9
    how = moving.prior("depth")
    assert how["method"] == "depth-anything"
    assert "scale and shift of every frame fitted to the cameras" in how["verdict"]
    assert how["misfit"] < 0.05
    assert not (moving.folder / "monocular").exists()


def test_nonsense_leaves_the_wall_and_is_not_trusted(moving: Scene):
    def noise(i: int) -> tuple[np.ndarray, np.ndarray]:
        blobs = np.random.default_rng(i).uniform(0, 1, (HEIGHT // 8, WIDTH // 8)).astype(np.float32)
        return np.kron(blobs, np.ones((8, 8), np.float32)), np.zeros((HEIGHT, WIDTH), np.float32)

    monocular_stage(moving, Monocular("given", "noise", False, noise))
    i = moving.train_frames[3]
    mask, found = moving.mask(i) > 0, moving.depth(i)
    assert np.median(np.abs(found.depth[~mask] / WALL - 1)) < 0.05
    assert not found.trusted[mask].any()
    assert (found.depth[mask] < WALL * 1.05).all()


@pytest.mark.parametrize("relative", [True, False])
def test_on_a_tripod_frames_agree_and_the_scale_is_free(tmp_path: Path, relative: bool):
    scene = write_planes(tmp_path, step=0, square=True, holdout=5)
    flow_stage(scene)
    for i in scene.train_frames:
        scene.write_mask(i, scene.truth.mask(i))
    monocular_stage(scene, network(scene, relative))
    depths = [scene.depth(i) for i in scene.train_frames]
    # Where the source does not know infinity, the wall's detail becomes its shape offset: other parts have another median.
    always = np.all([scene.mask(i) == 0 for i in scene.train_frames], axis=0)
    walls = [float(np.median(d.depth[always])) for d in depths]
    bodies = [float(np.median(d.depth[scene.mask(i) > 0])) for d, i in zip(depths, scene.train_frames, strict=True)]
    np.testing.assert_allclose(walls, walls[0], rtol=0.01)
    assert (np.array(bodies) < np.array(walls)).all()
    if not relative:
        np.testing.assert_allclose(np.array(walls) / bodies, 2, rtol=0.1)
    how = scene.prior("depth")
    assert "scale and shift are free" in how["verdict"]
    assert all(d.trusted.all() for d in depths)


def test_what_comes_after_a_cut_is_as_far_away_as_what_came_before(tmp_path: Path):
    scene = write_planes(tmp_path, step=0, square=False)
    scene.finish_prior("cameras", method="test", breaks=[6])
    flow_stage(scene)

    def inverse(i: int) -> tuple[np.ndarray, np.ndarray]:
        values = slanted_truth(scene, i) if i < 6 else 3 * slanted_truth(scene, i) - 0.2
        return values, np.ones((HEIGHT, WIDTH), np.float32)

    monocular_stage(scene, Monocular("given", "a test", True, inverse))
    medians = [np.median(scene.depth(i).depth) for i in scene.train_frames]
    np.testing.assert_allclose(medians, medians[0], rtol=0.01)


def test_frames_with_nothing_to_fit_borrow_from_their_neighbors(moving: Scene):
    def inverse(i: int) -> tuple[np.ndarray, np.ndarray]:
        known = np.ones((HEIGHT, WIDTH), np.float32)
        if i == moving.train_frames[4]:
            known[moving.mask(i) == 0] = 0
        return 3 * slanted_truth(moving, i), known

    monocular_stage(moving, Monocular("given", "a test", False, inverse))
    i = moving.train_frames[4]
    mask = moving.mask(i) > 0
    assert np.median(moving.depth(i).depth[mask]) == pytest.approx(WALL / 2, rel=0.05)
    assert np.median(moving.depth(i).depth[~mask]) == pytest.approx(WALL, rel=0.02)
