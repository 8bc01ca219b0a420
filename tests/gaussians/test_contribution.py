"""By how much images change without single Gaussians: against images without them."""

from __future__ import annotations

import pytest
import torch

from flowsplat.gaussians.contribution import compute_contributions, sum_contributions
from flowsplat.gaussians.render import render
from flowsplat.splatting.rules import ALPHA_MIN
from tests.output.small import LINEAR, OURS, five_pairs, small_model


def measure(model, views) -> torch.Tensor:
    """[N] the true changes."""
    count = len(model.gaussians)
    total = torch.zeros(count)
    for camera, t in views:
        whole = render(model.gaussians, camera, t).color
        for i in range(count):
            rest = model.gaussians.select(torch.cat([torch.arange(i), torch.arange(i + 1, count)]))
            total[i] += float(((render(rest, camera, t).color - whole) ** 2).sum())
    return total


@pytest.mark.parametrize(("config", "draws", "tolerance"), [(OURS, 200, 0.06), (LINEAR, 150, 0.08)])
def test_the_mean_of_many_estimates_is_what_images_lose(config, draws, tolerance):
    model = small_model(config, resting=30, moving=14, is_thin=True)
    views = [(model.similarity.camera(camera), model.clip_time(t)) for camera, t in five_pairs(model)[:3]]
    expected, generator = measure(model, views), torch.Generator().manual_seed(0)
    found = torch.stack([sum_contributions(model.gaussians, views, generator) for _ in range(draws)])
    is_seen = expected > 1e-3
    assert 25 < int(is_seen.sum()) < 44, "some are hidden, or there at no such time"
    ratio = found.mean(0)[is_seen] / expected[is_seen]
    assert float(ratio.mean()) == pytest.approx(1, abs=tolerance)
    assert float((ratio - 1).abs().max()) < 6 / draws**0.5, "four standard deviations of such a mean"
    assert float(found.mean(0)[~is_seen].max()) < 2e-3
    assert float((found.std(0) / found.mean(0))[is_seen].max()) < 1.9, "about what the docstring says"


def test_it_nearly_holds_for_the_opaque():
    """Alpha is clamped next to 1, and behind it nothing more may be drawn."""
    model = small_model(resting=30, moving=14)
    model.gaussians.params["logit_opacities"] += 4
    views = [(model.similarity.camera(camera), model.clip_time(t)) for camera, t in five_pairs(model)[:2]]
    expected, generator = measure(model, views), torch.Generator().manual_seed(0)
    found = torch.stack([sum_contributions(model.gaussians, views, generator) for _ in range(100)]).mean(0)
    is_seen = expected > 1e-3
    assert float((found[is_seen] / expected[is_seen]).median()) == pytest.approx(0.97, abs=0.08)


def test_pixels_that_do_not_count_change_nothing():
    model = small_model(resting=30, moving=14)
    camera, t = five_pairs(model)[0]
    camera, t = model.similarity.camera(camera), model.clip_time(t)
    left = torch.arange(camera.width).expand(camera.height, -1) < camera.width // 2
    sides = [compute_contributions(model.gaussians, camera, t, torch.Generator().manual_seed(3), side) for side in (left, ~left)]
    on_left, on_right = (each.changes > 1e-6 for each in sides)
    assert int((on_left & ~on_right).sum()) > 5
    assert int((on_right & ~on_left).sum()) > 5
    none = compute_contributions(model.gaussians, camera, t, torch.Generator(), left & ~left)
    assert not none.changes.any()


def test_what_nobody_sees_changes_nothing():
    model = small_model(resting=20, moving=6)
    gaussians = model.gaussians
    gaussians.params["logit_opacities"][3] = torch.logit(torch.tensor(ALPHA_MIN / 2))
    gaussians.params["means"][4, 2] = -1  # behind every camera
    views = [(model.similarity.camera(camera), model.clip_time(t)) for camera, t in five_pairs(model)]
    changes = sum_contributions(gaussians, views, torch.Generator().manual_seed(0))
    assert changes[3] == changes[4] == 0
    assert float(changes.max()) > 0.1


def test_the_same_signs_give_the_same_numbers():
    model = small_model(resting=20, moving=6)
    views = [(model.similarity.camera(camera), model.clip_time(t)) for camera, t in five_pairs(model)]
    first, again = (sum_contributions(model.gaussians, views, torch.Generator().manual_seed(5)) for _ in range(2))
    assert torch.equal(first, again)
    assert torch.equal(sum_contributions(model.gaussians, [], torch.Generator()), torch.zeros(26))
