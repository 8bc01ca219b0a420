"""The figures: perfect priors give perfect ones, and known errors come out as they went in."""

from __future__ import annotations

import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.geometry import Similarity
from flowsplat.priors.prepare import use_truth
from flowsplat.scenes import Depth, Flow, Scene, Tracks
from flowsplat.scenes.clip import InputOptions
from flowsplat.scenes.ingest import ingest, open_clip
from flowsplat_benchmarks.priors import measure as measuring
from flowsplat_benchmarks.priors.measure import (
    camera_figures,
    compute_pooled_iou,
    depth_figures,
    flow_figures,
    measure,
    read_true_flow,
    track_figures,
    tracks_on,
    true_mask,
)
from flowsplat_benchmarks.priors.scenes import choose_scenes


@pytest.fixture
def scene(data_root, tmp_path) -> Scene:
    """The rig scene with its truth as priors."""
    options = InputOptions(holdout=None)
    scene = ingest(open_clip(data_root / "rig" / "tiny", options), tmp_path / "scene", options)
    use_truth(scene)
    return scene


def test_perfect_priors_have_no_errors(data_root, scene):
    figures = measure(choose_scenes(data_root, ["tiny"])[0], scene)
    for name in ("flow.epe", "flow.epe_objects", "cameras.path", "cameras.focal", "depth.static", "depth.objects"):
        assert figures[name] == pytest.approx(0, abs=0.01), name
    assert figures["cameras.rotation"] == pytest.approx(0, abs=0.01)
    assert figures["flow.kept"] == figures["flow.right"] == 100
    assert figures["masks.iou"] == 1
    assert figures["tracks.life"] > 60
    assert figures["tracks.within"] > 80
    assert figures["tracks.objects"] == pytest.approx(scene.tracks.moving.sum(), abs=5)


def test_flow_errors_are_pooled_over_pixels():
    shape = (2, 4)
    matched, kept, objects = (np.zeros(shape, np.float32) for _ in range(3))
    matched[:, :3], kept[:, 1:], objects[0] = 1, 1, 1
    found = np.zeros((*shape, 2), np.float32)
    found[0, :, 0], found[1, 3] = 2, (3, 4)
    estimated, true = Flow(0, 1, found, kept), Flow(0, 1, np.zeros_like(found), matched)
    figures = flow_figures([(estimated, true, objects > 0)])
    assert figures["flow.epe"] == pytest.approx((4 * 2 + 5) / 8)
    assert figures["flow.epe_objects"] == 2
    assert figures["flow.epe_matched"] == pytest.approx(3 * 2 / 6)
    assert figures["flow.kept"] == pytest.approx(100 * 4 / 6)
    assert figures["flow.right"] == pytest.approx(100 * 2 / 6)
    # Measured flow: what is not known does not count.
    figures = flow_figures([(estimated, true, None)])
    assert figures["flow.epe"] == pytest.approx(3 * 2 / 6)
    assert "flow.epe_objects" not in figures


def test_cameras_and_depth_are_compared_in_any_frame_of_reference(scene):
    similarity = Similarity(3.0, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([1.0, 2, 3]))
    truth = scene.truth
    scene.write_cameras([similarity.camera(camera) for camera in truth.cameras])
    scene.finish_prior("cameras", method="tracks")
    for i in scene.train_frames:
        true, moving = truth.depth(i).depth, truth.mask(i) > 0
        scene.write_depth(i, Depth(3 * true * np.where(moving, 1.2, 0.99), np.ones_like(true)))
    figures = {**camera_figures(scene, truth), **depth_figures(scene, truth)}
    assert figures["cameras.path"] == pytest.approx(0, abs=1e-4)
    assert figures["depth.static"] == pytest.approx(1, abs=0.01)
    assert figures["depth.objects"] == pytest.approx(20, abs=0.01)


def test_masks_are_pooled_over_frames():
    small, large = np.zeros((4, 4), np.uint8), np.zeros((4, 4), np.uint8)
    small[0, 0], large[:2] = 2, 1
    assert compute_pooled_iou([(small, large), (large, large)]) == 9 / 16
    assert compute_pooled_iou([(0 * small, 0 * small)]) == 1


def test_tracks_are_asked_at_their_births(scene, monkeypatch):
    """One visible frame in four is lost; every second sample is three pixels off; half of the hidden ones are called visible."""
    truth = scene.truth
    births = truth.tracks.visible.argmax(1)
    asked = np.flatnonzero(truth.tracks.visible.sum(1) > 1)
    pixels = np.stack([camera.project(truth.tracks.points[:, i])[0] for i, camera in enumerate(truth.cameras)], 1)[asked]
    seen, births_asked = truth.tracks.visible[asked], births[asked]

    def follow(scene, frames, points):
        assert (frames == births_asked).all()
        np.testing.assert_allclose(points, pixels[np.arange(len(asked)), frames], atol=1e-3)
        number = np.arange(seen.shape[1])
        alive = np.where(seen, number % 4 != 3, number % 2 == 0)
        return Tracks(pixels + 3 * (number % 2)[:, None], alive, alive.astype(float), np.zeros(len(asked), bool))

    monkeypatch.setattr(measuring, "follow_queries", follow)
    figures = track_figures(scene, truth, births)
    others = np.ones_like(seen)
    others[np.arange(len(asked)), births_asked] = False
    number = np.broadcast_to(np.arange(seen.shape[1]), seen.shape)
    alive = np.where(seen, number % 4 != 3, number % 2 == 0) & others
    assert 60 < figures["tracks.life"] < 90
    assert figures["tracks.within"] == pytest.approx(100 * (number % 2 == 0)[alive].mean())
    assert figures["tracks.unseen"] == pytest.approx(100 * (~seen)[alive].mean())


def test_tracks_on_objects_are_counted_by_the_true_masks(scene):
    count = int(scene.tracks.moving.sum())
    tracks = scene.tracks
    scene.write_tracks(Tracks(tracks.points, tracks.visible, tracks.confidence, ~tracks.moving))
    assert tracks_on(scene, scene.truth) == pytest.approx(count, abs=5)  # true points are rounded to pixels


def test_truth_that_lies_beside_the_scene(data_root, tmp_path):
    pair, clip = choose_scenes(data_root, ["pair", "clip"])[::-1]
    options = InputOptions(resize=0)
    scene = ingest(open_clip(pair.source, options), tmp_path / "pair", options)
    flow = read_true_flow(pair, scene)
    assert flow.flow[5, 5].tolist() == [2, -1]
    assert flow.flow[5, 0].tolist() == [0, 0]
    assert flow.trusted[5, :2].tolist() == [False, True]
    scene = ingest(open_clip(clip.source, InputOptions()), tmp_path / "clip", InputOptions())
    assert scene.name == "clip"
    assert scene.prior("masks") is None
    assert 0 < true_mask(clip, scene, 3).sum() < 96 * 64
    other = Scene.create(tmp_path / "o", name="o", source="", width=60, height=40, timestamps=[0, 1], holdout=None, source_fps=1)
    with pytest.raises(InputError, match="8 masks, 8 images, 2 of them prepared"):
        true_mask(clip, other, 0)
    with pytest.raises(InputError, match="flow of 60x40 pixels"):
        read_true_flow(pair, other)
