"""Gaussians fade beyond what the clip tells, and all stay where the clip's camera stood."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from flowsplat.common.errors import InputError
from flowsplat.gaussians.confidence_fade import (
    MAX_DIRECTION_DIFFERENCE,
    MAX_SPREADS,
    MIN_FADE_REACH,
    MIN_FRAMES,
    apply_confidence_fade,
    keep_all_seen,
    reach,
)
from flowsplat.gaussians.visibility import ASKED_FRAMES, with_seen
from flowsplat.training.checkpoint import load_model, save_model
from tests.output.small import LAST, small_cameras, small_model, small_times

SPREADS = (0.01, 0.02, 0.05, MAX_DIRECTION_DIFFERENCE)


def model_that_saw(frames: float):
    """All Gaussians at the middle of the view, with different spreads."""
    model = small_model()
    gaussians = model.gaussians
    seen = torch.tensor([(frames, SPREADS[k % len(SPREADS)]) for k in range(len(gaussians))])
    return replace(model, gaussians=replace(gaussians, seen=seen))


def test_how_far_each_may_be_looked_at():
    found = reach(
        torch.tensor([(MIN_FRAMES, 0.05), (MIN_FRAMES - 1, 0.05), (MIN_FRAMES, 0.0001), (30.0, MAX_DIRECTION_DIFFERENCE)])
    )
    np.testing.assert_allclose(found, [MAX_SPREADS * 0.05, MIN_FADE_REACH, MIN_FADE_REACH, MAX_SPREADS * MAX_DIRECTION_DIFFERENCE])


def test_what_one_frame_has_seen_may_be_looked_at_from_everywhere():
    found = reach(keep_all_seen(torch.tensor([(1.0, 0.0), (0.0, 0.05), (30.0, 0.01), (0.0, MAX_DIRECTION_DIFFERENCE)])))
    assert (found[[0, 2]] >= MAX_DIRECTION_DIFFERENCE).all()
    np.testing.assert_allclose(found[[1, 3]], MIN_FADE_REACH)


def test_opacities_fall_between_the_reach_and_twice_that():
    gaussians = model_that_saw(9).gaussians
    means, before = gaussians.params["means"].double(), torch.sigmoid(gaussians.params["logit_opacities"]).double()
    own, viewer = np.array([0.0, 0.0, -1.0]), np.array([0.7, 0.1, -0.8])
    assert torch.equal(apply_confidence_fade(gaussians, own, own).params["logit_opacities"], gaussians.params["logit_opacities"])
    after = torch.sigmoid(apply_confidence_fade(gaussians, viewer, own).params["logit_opacities"]).double()
    dynamic = gaussians.dynamic
    assert torch.equal(after[dynamic], before[dynamic]), "what moves is there in its own frames"
    for k, mean in enumerate(means[~dynamic].numpy()):
        rays = [(center - mean) / np.linalg.norm(center - mean) for center in (viewer, own)]
        kept = np.clip(2 - np.linalg.norm(rays[0] - rays[1]) / (MAX_SPREADS * SPREADS[k % len(SPREADS)]), 0, 1)
        assert float(after[k]) == pytest.approx(float(before[k]) * kept, abs=2e-6)
    assert (after < 1e-6).any()
    assert (after == before).any()


def test_what_moves_stays_however_short_it_is_there():
    """At the ends of the clip it is there in fewer frames than are asked for."""
    model, cameras, times = small_model(), small_cameras(small_model()), small_times()
    model.gaussians.params["log_lambdas"][model.gaussians.dynamic] = 7.0
    known = with_seen(model, cameras, times).gaussians
    short = known.dynamic & (known.seen[:, 0] < MIN_FRAMES)
    assert short.any()
    for gaussians in (known, replace(known, seen=keep_all_seen(known.seen))):
        faded = apply_confidence_fade(gaussians, np.array([0.8, 0.3, -0.5]), np.array([0.0, 0.0, -1.0]))
        assert torch.equal(faded.params["logit_opacities"][short], known.params["logit_opacities"][short])


def test_without_knowing_all_stay_and_a_scene_refuses():
    model = small_model()
    assert apply_confidence_fade(model.gaussians, np.ones(3), np.zeros(3)) is model.gaussians
    with pytest.raises(InputError, match="earlier flowsplat"):
        model.fade_by_confidence(small_times(), small_cameras(model))


def test_along_the_clip_nothing_changes_and_from_aside_something_goes():
    model, cameras = model_that_saw(2), small_cameras(small_model())
    confidence_fade = model.fade_by_confidence(small_times(), cameras)
    own, other = (each.render(cameras[-1], LAST) for each in (confidence_fade, model))
    np.testing.assert_array_equal(own.alpha, other.alpha)
    away = replace(cameras[-1], viewmat=cameras[-1].viewmat + np.array([[0, 0, 0, 0.5], *np.zeros((3, 4))]))
    assert confidence_fade.render(away, LAST).alpha.mean() < 0.5 * model.render(away, LAST).alpha.mean()
    assert (
        confidence_fade.part("background").render(away, LAST).alpha.mean()
        < model.part("background").render(away, LAST).alpha.mean()
    )


def test_what_a_clip_has_seen_of_a_trained_scene():
    model = small_model()
    found = with_seen(model, small_cameras(model), small_times()).gaussians
    asked = min(ASKED_FRAMES, len(small_times()))
    assert found.seen.shape == (len(found), 2)
    moving, resting = found.seen[found.dynamic], found.seen[~found.dynamic]
    assert (moving[:, 1] == MAX_DIRECTION_DIFFERENCE).all()
    assert (resting[:, 1] < 0.5).all()
    assert found.seen[:, 0].max() <= asked
    assert resting[:, 0].max() == asked, "the camera turns little, so that some Gaussian is seen by all"
    rows = torch.tensor([3, 1])
    assert torch.equal(found.select(rows).seen, found.seen[rows])


def test_it_is_kept_in_the_file_and_a_damaged_one_is_told(tmp_path):
    model = with_seen(small_model(), small_cameras(small_model()), small_times())
    save_model(tmp_path, model)
    assert torch.equal(load_model(tmp_path).gaussians.seen, model.gaussians.seen)
    for wrong in (float("nan"), -1.0, float("inf")):
        model.gaussians.seen[0, 1] = wrong
        save_model(tmp_path, model)
        with pytest.raises(InputError, match="what the clip has seen"):
            load_model(tmp_path)
    save_model(tmp_path, small_model())
    assert load_model(tmp_path).gaussians.seen is None
