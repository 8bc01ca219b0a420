from __future__ import annotations

import numpy as np

from flowsplat.priors.flow import flow_stage
from flowsplat.priors.tracks import follow_queries, stage, tracks_stage
from flowsplat.scenes import Flow


def test_tracks_follow_both_motions_and_leave_held_out_frames_alone(scene):
    scene.finish_prior("masks", method="given")
    flow_stage(scene)
    tracks_stage(scene)
    tracks = scene.tracks
    assert scene.heldout_frames == [3]
    assert not tracks.visible[:, 3].any()
    assert np.isfinite(tracks.points).all()
    assert tracks.moving.sum() > 50
    assert (~tracks.moving).sum() > 50
    frames = np.array(scene.train_frames)
    for moving, velocity in ((True, (-2, 1)), (False, (1.5, 0.5))):
        chosen = np.flatnonzero((tracks.moving == moving) & tracks.visible[:, frames].all(1))
        assert len(chosen) > 10
        traveled = tracks.points[chosen, 7] - tracks.points[chosen, 0]
        assert np.median(np.linalg.norm(traveled - 7 * np.array(velocity), axis=1)) < 0.3
    assert scene.prior("tracks")["moving"] == tracks.moving.sum()


def test_without_masks_nothing_is_called_moving(scene):
    flow_stage(scene)
    tracks_stage(scene)
    assert len(scene.tracks.points) > 100
    assert not scene.tracks.moving.any()


def test_points_that_are_asked_for_are_followed_both_ways(scene):
    scene.finish_prior("masks", method="given")
    flow_stage(scene)
    asked = np.array([[40.0, 60.3], [78.2, 38.0], [30.0, 20.0]])
    tracks = follow_queries(scene, np.array([4, 4, 5]), asked)
    frames = np.array(scene.train_frames)
    for n, (velocity, birth) in enumerate([((1.5, 0.5), 4), ((-2, 1), 4), ((1.5, 0.5), 5)]):
        seen = frames[tracks.visible[n, frames]]
        assert len(seen) > 4
        assert birth in seen
        error = tracks.points[n, seen] - asked[n] - (seen - birth)[:, None] * np.array(velocity)
        assert np.abs(error).max() < 0.5
    assert not tracks.visible[:, 3].any()
    assert ((tracks.confidence >= 0.5) == tracks.visible).all()
    assert follow_queries(scene, np.zeros(0, int), np.zeros((0, 2))).points.shape == (0, 8, 2)


def test_wrong_flow_between_two_frames_is_survived(scene):
    """Points go where their velocity leads and their texture is, and flow that says otherwise changes nothing."""
    scene.finish_prior("masks", method="given")
    flow_stage(scene)
    flow = scene.flow(4, 5)
    scene.write_flow(Flow(4, 5, flow.flow + np.float32([5, 5]), flow.confidence))
    tracks_stage(scene)
    tracks = scene.tracks
    chosen = np.flatnonzero(tracks.visible[:, [1, 2, 4, 5, 6, 7]].all(1) & ~tracks.moving)
    assert len(chosen) > 30
    traveled = tracks.points[chosen, 7] - tracks.points[chosen, 1]
    assert np.median(np.linalg.norm(traveled - 6 * np.array([1.5, 0.5]), axis=1)) < 0.3


def test_a_scene_holds_no_more_tracks_than_it_can_read(scene, monkeypatch):
    flow_stage(scene)
    monkeypatch.setattr(stage, "MAX_TRACK_PLACES", 200 * scene.num_frames)
    tracks_stage(scene)
    assert len(scene.tracks.points) == 200
