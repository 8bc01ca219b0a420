"""Depth: movers stand before what they hide, a tripod gets a guess."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flowsplat.geometry import Similarity
from flowsplat.priors.background.matched_clip import MatchedClip
from flowsplat.priors.depth import depth_stage
from flowsplat.priors.depth.movers import card, growth, smooth_cards
from flowsplat.priors.flow import flow_stage
from flowsplat.scenes import Scene

from .planes import HEIGHT, WALL, WIDTH, write_planes


def test_a_card_stands_on_the_ground_at_its_feet():
    plate = np.linspace(0.1, 1, 40, dtype=np.float32)[:, None] * np.ones((1, 30), np.float32)
    mask = np.zeros((40, 30), bool)
    mask[8:30, 10:16] = True
    assert card(mask, plate) >= plate[29, 0] * 0.99
    assert card(mask, plate) < plate[34, 0]


def test_cards_are_smooth_and_stay_near():
    cards, still = np.full(40, 0.5), np.zeros(40)
    cards[10:13] = np.nan
    cards[20] = 5.0
    smooth = smooth_cards(cards, still, still)
    assert np.isnan(smooth[10:13]).all()
    np.testing.assert_allclose(smooth[np.isfinite(smooth)], 0.5)
    assert smooth_cards(np.where(np.arange(40) % 2, 0.5, 0.7), still, still)[20] > 0.65
    assert np.isnan(smooth_cards(np.full(5, np.nan), still[:5], still[:5])).all()


def test_cards_do_not_reach_across_a_cut():
    halves = np.repeat([1.5, 0.5], 40)
    np.testing.assert_allclose(smooth_cards(halves, np.zeros(80), np.repeat([0, 1], 40)), halves)


def test_what_grows_comes_nearer():
    nearness = smooth_cards(np.full(40, 0.5), np.full(40, 0.01), np.zeros(40))
    np.testing.assert_allclose(np.diff(np.log(nearness)), 0.007, atol=2e-3)


@pytest.mark.parametrize("factor", [0.9, 1.0, 1.2])
def test_growth_is_that_of_the_object_and_not_of_what_is_near_it(factor):
    rows, columns = np.mgrid[:60, :80].astype(np.float32)
    mask = np.zeros((60, 80), bool)
    mask[15:45, 20:60] = True
    flow = np.stack([(factor - 1) * (columns - 40) + 3, (factor - 1) * (rows - 30)], -1)
    flow[15:25, 20:30] = 9
    flow[~mask] = 0
    assert growth(mask, flow, np.ones((60, 80), np.float32)) == pytest.approx(np.log(factor), abs=0.02)
    assert growth(mask, flow, np.zeros((60, 80), np.float32)) == 0


@pytest.fixture(scope="module")
def moving(tmp_path_factory) -> Scene:
    scene = write_planes(tmp_path_factory.mktemp("moving"), step=2, square=True)
    flow_stage(scene)
    for i in scene.train_frames:
        scene.write_mask(i, scene.truth.mask(i))
    scene.finish_prior("masks", method="truth")
    depth_stage(scene)
    return scene


def test_the_stage_finds_the_wall_and_puts_the_square_before_it(moving: Scene):
    for i in moving.train_frames:
        mask, result = moving.mask(i) > 0, moving.depth(i)
        assert np.median(np.abs(result.depth[~mask] / WALL - 1)) < 0.02
        assert (result.depth[mask] < WALL).all()
        assert result.depth[mask].min() > WALL / 2
        assert result.trusted[mask].all()
        assert result.trusted.mean() > 0.85
    how = moving.prior("depth")
    assert how["method"] == "multi-view"
    assert how["objects"] == 1


def test_the_stage_resumes_where_it_stopped(moving: Scene):
    files = sorted((moving.folder / "depth").glob("*.npz"))
    before = [path.read_bytes() for path in files]
    files[3].unlink()
    times = [path.stat().st_mtime_ns for path in files if path.exists()]
    depth_stage(moving)
    assert [path.read_bytes() for path in files] == before
    assert [path.stat().st_mtime_ns for path in files if path != files[3]] == times


def test_other_cameras_are_solved_anew(moving: Scene):
    median = MatchedClip(moving).median
    cameras = moving.cameras
    twice = [Similarity(2.0).camera(camera) for camera in cameras]
    moving.write_cameras(twice)
    assert MatchedClip(moving).median == pytest.approx(median / 2, rel=1e-3)
    moving.write_cameras(cameras)


def test_a_tripod_gets_a_guess_that_says_so(tmp_path: Path):
    scene = write_planes(tmp_path, step=0, square=True)
    flow_stage(scene)
    depth_stage(scene)
    how = scene.prior("depth")
    assert how["method"] == "guess"
    assert "guess" in how["verdict"]
    result = scene.depth(5)
    assert 0.5 <= result.confidence.min() <= result.confidence.max() <= 0.6
    assert (np.diff(result.depth.mean(1)) <= 1e-6).all()
    assert result.depth.shape == (HEIGHT, WIDTH)
    assert np.median(result.depth) == pytest.approx(1, rel=0.1)
