"""Depth: objects stand before what they hide, a tripod gets a guess."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest

from flowsplat.common.threads import set_thread_count, thread_count
from flowsplat.geometry import Similarity
from flowsplat.priors.background import refined
from flowsplat.priors.background.matched_clip import MatchedClip
from flowsplat.priors.depth import depth_stage
from flowsplat.priors.flow import flow_stage
from flowsplat.priors.objects import objects_stage
from flowsplat.priors.tracks import tracks_stage
from flowsplat.scenes import Scene

from .planes import HEIGHT, WALL, WIDTH, write_planes


@pytest.fixture(scope="module")
def moving(tmp_path_factory) -> Scene:
    scene = write_planes(tmp_path_factory.mktemp("moving"), step=2, square=True)
    flow_stage(scene)
    for i in scene.train_frames:
        scene.write_mask(i, scene.truth.mask(i))
    scene.finish_prior("masks", method="truth")
    tracks_stage(scene)
    objects_stage(scene)
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
    assert 0.85 < how["trusted_static"] < how["trusted"] < 1, "objects, which are trusted everywhere, do not count"
    assert f"{how['trusted_static']:.0%} of the still scene trusted; distances of objects: " in how["verdict"]


def test_the_stage_resumes_where_it_stopped(moving: Scene):
    files = sorted((moving.folder / "depth").glob("*.npz"))
    before = [path.read_bytes() for path in files]
    files[3].unlink()
    times = [path.stat().st_mtime_ns for path in files if path.exists()]
    depth_stage(moving)
    assert [path.read_bytes() for path in files] == before
    assert [path.stat().st_mtime_ns for path in files if path != files[3]] == times


@pytest.mark.all_cores
def test_with_one_thread_it_is_the_same(moving: Scene):
    files, threads = sorted((moving.folder / "depth").glob("*.npz")), thread_count()
    before = [path.read_bytes() for path in files]
    for path in files:
        path.unlink()
    try:
        set_thread_count(1 if threads > 1 else threads)
        depth_stage(moving)
    finally:
        set_thread_count(threads)
    assert [path.read_bytes() for path in files] == before


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


def test_a_long_clip_refines_every_frame_once_a_round(monkeypatch):
    """Frames ask for others far before and after them: what is kept of these must reach, however long the clip is."""
    asked: list[tuple[int, bool]] = []

    class Edges:
        def __init__(self, *_: object): ...

        def __call__(self, k: int, inverse: np.ndarray, doubted: np.ndarray | None) -> np.ndarray:
            asked.append((k, doubted is not None))
            return inverse

    monkeypatch.setattr(refined, "EdgeRefiner", Edges)
    monkeypatch.setattr(refined, "vote_on_depth", lambda inverse, *_: (inverse, np.ones_like(inverse)))
    plain = np.ones((HEIGHT, WIDTH), np.float32)
    monkeypatch.setattr(refined.RefinedDepth, "_coarse", lambda self, k: (plain, plain, plain))
    monkeypatch.setattr(refined.RefinedDepth, "_camera", lambda self, k: None)
    continuity = SimpleNamespace(same_piece=lambda k, j: True)
    scene = SimpleNamespace(width=WIDTH, height=HEIGHT)
    clip = MagicMock(scene=scene, has_parallax=True, continuity=continuity, __len__=lambda self: 150)
    depth = refined.RefinedDepth(clip, MagicMock(), has_masks=False)
    done = []
    for work in depth.walk(lambda k: done.append(depth(k)), range(150)):
        work()
    assert len(done) == 150
    assert sorted(asked) == sorted((k, later) for k in range(150) for later in (False, True))
