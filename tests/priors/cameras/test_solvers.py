from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flowsplat.priors.cameras import solvers
from flowsplat.priors.cameras.estimate import CameraEstimate, estimate
from flowsplat.priors.cameras.observations import Observations
from flowsplat.priors.cameras.solvers import find_jumps, judge, keep_back, prefer, solve
from tests.priors.cameras.worlds import HEIGHT, WIDTH, observed, path, world


@pytest.fixture(scope="module")
def tracks() -> Observations:
    return Observations.of(observed(path(20), world(500), 0.1))


@pytest.fixture(scope="module")
def good(tracks) -> CameraEstimate:
    return estimate(keep_back(tracks)[0], WIDTH, HEIGHT, None)


def damaged(found: CameraEstimate, turn: float, frame: int) -> CameraEstimate:
    """With one camera turned by so many degrees."""
    rotations = found.fit.state.rotations.copy()
    rotations[frame] = Rotation.from_rotvec([0, np.radians(turn), 0]).as_matrix() @ rotations[frame]
    return replace(found, fit=replace(found.fit, state=replace(found.fit.state, rotations=rotations)))


def bent(found: CameraEstimate) -> CameraEstimate:
    """With a focal length that is wrong, and poses that do not know it."""
    return replace(found, fit=replace(found.fit, state=replace(found.fit.state, focal=1.4 * found.fit.state.focal)))


def judged(found: CameraEstimate, tracks: Observations) -> solvers.Judgment:
    return judge("own", found, keep_back(tracks)[1], WIDTH, HEIGHT)


def test_judges_are_no_tracks_of_the_adjustment_and_few_are_left_alone():
    seen = np.ones((800, 10), bool)
    seen[::3, 2:] = False
    numbers = np.repeat(np.arange(800.0)[:, None], 10, 1)
    used, kept = keep_back(Observations.of(np.stack([numbers, numbers], -1), seen))
    assert not set(used.uv[:, 0]) & set(kept.uv[:, 0])
    assert sorted({*used.uv[:, 0], *kept.uv[:, 0]}) == list(range(800))
    assert kept.counts.min() >= solvers.MIN_JUDGE_VIEWS
    assert used.points + kept.points == 800
    assert keep_back(Observations.of(np.zeros((60, 10, 2)), seen[:60]))[1].points == 0


def test_good_cameras_are_not_poor(tracks, good):
    judgment = judged(good, tracks)
    assert judgment.sane
    assert not judgment.poor
    assert judgment.pixels < 0.2


def test_wrong_cameras_are_poor_although_all_frames_have_one(tracks, good):
    judgment = judged(bent(good), tracks)
    assert bent(good).unplaced == []
    assert judgment.poor
    assert judgment.pixels > 1


@pytest.mark.parametrize("frame", [0, 7, 19])
def test_a_camera_that_looks_elsewhere_is_a_jump(good, frame):
    assert find_jumps(good) == []
    jumps = find_jumps(damaged(good, 91, frame))
    assert jumps
    assert abs(jumps[0] - frame) <= 1
    assert find_jumps(damaged(good, 0.2, frame)) == []


def test_jumps_are_named_by_the_frames_of_the_clip(good, tracks):
    broken = damaged(good, 91, 7)
    kept = keep_back(tracks)[1]
    numbers = [k + 30 for k in range(tracks.cameras)]
    plain, shifted = (judge("own", broken, kept, WIDTH, HEIGHT, frames) for frames in (None, numbers))
    assert plain.jumps
    assert shifted.jumps == [t + 30 for t in plain.jumps]
    assert f"jumps before frame {shifted.jumps[0]}" in shifted.describe_errors(1.0)


def test_a_fast_pan_is_no_jump(good):
    pan = Rotation.from_rotvec(np.radians(8.0) * np.arange(20)[:, None] * [0, 1, 0]).as_matrix()
    state = replace(good.fit.state, rotations=pan @ good.fit.state.rotations)
    assert find_jumps(replace(good, motion="rotation", fit=replace(good.fit, state=state))) == []


def test_frames_that_are_left_out_are_no_jump(good):
    pan = Rotation.from_rotvec(np.radians(4.0) * np.arange(20)[:, None] * [0, 1, 0]).as_matrix()
    kept = [*range(8), *range(15, 20)]
    centers = np.linspace([0.0, 0, 0], [3, 0, 0], 20)
    state = replace(good.fit.state, rotations=pan[kept], translations=-np.einsum("tij,tj->ti", pan, centers)[kept])
    found = replace(good, fit=replace(good.fit, state=state))
    assert find_jumps(found) != []
    assert find_jumps(found, kept) == []


def test_the_sane_are_preferred_and_then_the_better(tracks, good):
    fine, wrong, jumps = judged(good, tracks), judged(bent(good), tracks), judged(damaged(good, 91, 0), tracks)
    assert prefer(fine, wrong)
    assert not prefer(wrong, fine)
    assert prefer(wrong, jumps)
    assert not prefer(fine, fine)


def test_the_second_solver_is_asked_where_the_first_one_fails(tracks, good, monkeypatch):
    asked = []

    def broken(positions, width, height, focal, solver):
        asked.append(solver)
        return bent(good) if solver == "own" else good

    monkeypatch.setattr(solvers, "estimate", broken)
    solved = solve(tracks, WIDTH, HEIGHT, None, "auto")
    assert asked == ["own", "global"]
    assert solved.found is good
    assert [judgment.solver for judgment in solved.judgments] == ["global", "own"]
    assert "the global one was taken: it misses kept-back tracks by 0.1" in solved.reason(1.0)
    solved = solve(tracks, WIDTH, HEIGHT, None, "own")
    assert solved.judgments[0].poor
    assert solved.reason(1.0) == ""


def test_the_second_solver_is_not_asked_where_the_first_one_does(tracks, monkeypatch):
    asked = []

    def noted(positions, width, height, focal, solver):
        asked.append(solver)
        return estimate(positions, width, height, focal, solver)

    monkeypatch.setattr(solvers, "estimate", noted)
    assert solve(tracks, WIDTH, HEIGHT, None, "auto").judgments[0].solver == "own"
    assert asked == ["own"]
