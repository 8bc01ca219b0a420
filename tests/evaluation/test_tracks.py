"""Tracks out of a model against true points."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from flowsplat.evaluation.tracks import track_errors
from flowsplat.geometry import Similarity
from flowsplat.scenes import Scene, Tracks
from tests.gaussians import spinning

OFFSETS = np.array([[-0.2, 0.1], [0.0, 0.0], [0.25, -0.15], [0.1, 0.3]])
STATIC = np.array([[-1.6, -1.2, spinning.WALL], [1.7, 1.1, spinning.WALL]])


def build(folder: Path, scale: float = 1.0, with_tracks: bool = True) -> Scene:
    """The spinning plate's truth; ``scale``: of the coordinates that the cameras were estimated in."""
    times = spinning.timestamps()
    scene = Scene.create(
        folder, name="plate", source="test", width=96, height=72, timestamps=times.tolist(), holdout=None, source_fps=8
    )  # fmt: skip
    scene.write_cameras([Similarity(scale).camera(camera) for camera in spinning.cameras()])
    scene.finish_prior("cameras", method="truth" if scale == 1 else "tracks")
    truth = scene.create_truth()
    truth.write_cameras(spinning.cameras())
    if with_tracks:
        moving = np.stack([spinning.on_plate(OFFSETS, t / spinning.LAST) for t in times], 1)
        points = np.concatenate([moving, np.repeat(STATIC[:, None], len(times), 1)])
        visible = np.ones(points.shape[:2], bool)
        visible[0, :3] = False
        truth.write_tracks(Tracks(points, visible, visible.astype(np.float32), np.arange(len(points)) < len(OFFSETS)))
    return Scene(folder)


def test_exact_motion_has_hardly_an_error(tmp_path):
    found = track_errors(spinning.model(), build(tmp_path / "scene"))
    assert found is not None
    assert found["all"]["points"] == 6
    assert found["moving"]["points"] == 4
    for region in ("moving", "static"):
        assert found[region]["median"] < 0.5
        assert found[region]["last"] < 0.7
        assert found[region]["within_5"] == found[region]["followed"] == 100
        assert found[region]["seen"] > 90


def test_a_scale_of_the_cameras_does_not_count(tmp_path):
    model = spinning.model()
    model.similarity = replace(model.similarity, scale=model.similarity.scale / 3)
    exact = track_errors(spinning.model(), build(tmp_path / "exact"))
    scaled = track_errors(model, build(tmp_path / "scaled", scale=3.0))
    assert exact is not None
    assert scaled is not None
    assert scaled["moving"]["median"] == pytest.approx(exact["moving"]["median"], rel=1e-3)


def test_a_model_that_rests_is_wrong_by_the_way_of_the_points(tmp_path):
    model = spinning.model(centers=2, life=5.0)
    for name in ("mean_cos", "mean_sin", "quat_cos", "quat_sin"):
        model.gaussians.params[name] = torch.zeros_like(model.gaussians.params[name])
    # Only those of the beginning: asked for there, they stay where they are.
    keep = torch.nonzero(model.gaussians.params["times"] == 0).squeeze(1)
    model.gaussians = model.gaussians.select(keep)
    births = np.array([0, 0, 0, 0, -1, 0])
    found = track_errors(model, build(tmp_path / "scene"), births)
    assert found is not None
    assert found["all"]["points"] == 5
    start = spinning.on_plate(OFFSETS, 0)
    true = [np.linalg.norm(spinning.on_plate(OFFSETS, i / 12) - start, axis=1) / spinning.PLATE for i in range(1, 13)]
    samples = np.array(true).T
    expected = np.concatenate([samples[0, 2:], samples[1:].ravel()])  # the first point is seen from frame 3 on
    assert found["moving"]["median"] == pytest.approx(100 * np.median(expected), rel=0.03)
    assert found["moving"]["last"] == pytest.approx(100 * np.median(samples[:, 11]), rel=0.03)
    assert found["static"]["median"] < 0.01


def test_births_near_the_end_are_followed_backwards(tmp_path):
    scene = build(tmp_path / "scene")
    births = np.full(6, 12)
    found = track_errors(spinning.model(until=0.4), scene, births)
    assert found is not None
    assert found["moving"] is not None
    assert found["moving"]["median"] > 40  # there is only the wall where the plate should be at the end
    assert found["static"]["median"] < 0.01


def test_a_clip_shorter_than_the_span_counts_what_there_is(tmp_path):
    found = track_errors(spinning.model(), build(tmp_path / "scene"), np.array([3, 2, 2, 2, 0, 12]))
    assert found is not None
    assert found["moving"]["median"] < 0.5
    assert found["static"]["median"] < 0.5
    assert found["moving"]["last"] is None


def test_nothing_to_compare_with(tmp_path):
    assert track_errors(spinning.model(), build(tmp_path / "scene", with_tracks=False)) is None
    other = build(tmp_path / "other")
    assert track_errors(spinning.model(), other, np.full(6, -1)) is None
