"""Steps along rays: their axes, how long they are, and that training takes them for what rests alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from flowsplat.training.adam import RowAdam
from flowsplat.training.ray_preconditioning import HALF_PARALLAX, PathSpread, ray_axes, reference, step_along_rays
from flowsplat.training.trainer import Trainer
from tests.training.handful import a_few, seen, tiny


def travel(meters: float, frames: int = 9) -> torch.Tensor:
    """[F, 3] of a camera that goes sideways."""
    return torch.stack([torch.linspace(-meters, meters, frames), torch.zeros(frames), torch.zeros(frames)], 1)


def test_axes_are_those_of_the_ray():
    positions = torch.from_numpy(np.random.default_rng(0).normal(0, 3, (200, 3)).astype(np.float32))
    axes, factors = ray_axes(positions, PathSpread.of(travel(0.3)), 400.0, 15.0)
    torch.testing.assert_close(axes @ axes.mT, torch.eye(3).expand(200, 3, 3), rtol=0, atol=1e-5)
    torch.testing.assert_close(axes[:, 2], positions / positions.norm(dim=1, keepdim=True))
    assert float(factors.min()) >= 1
    assert float(factors.max()) <= 15


@pytest.mark.parametrize("distance", [1.0, 3.0, 20.0])
def test_factors_are_half_of_what_parallax_lacks(distance):
    centers = travel(0.3)
    std = float(centers[:, 0].std(correction=0))
    _, (factor,) = ray_axes(torch.tensor([[0.0, 0.0, distance]]), PathSpread.of(centers), 400.0, 15.0)
    seen_pixels = (400 * std / distance) ** 2
    share = seen_pixels / (seen_pixels + HALF_PARALLAX**2)
    assert float(factor) == pytest.approx(1 + share * (min(max(distance / (2 * std), 1), 15) - 1), rel=1e-4)


def test_what_lies_ahead_of_a_camera_that_goes_there_has_no_parallax():
    forward = travel(0.3)[:, [1, 2, 0]]
    _, factors = ray_axes(torch.tensor([[0.0, 0.0, 5.0], [5.0, 0.0, 0.0]]), PathSpread.of(forward), 400.0, 15.0)
    assert float(factors[0]) == pytest.approx(1, abs=1e-3)
    assert float(factors[1]) > 5


def test_a_camera_that_stands_changes_nothing():
    axes, factors = ray_axes(torch.randn(50, 3), PathSpread.of(torch.zeros(5, 3)), 400.0, 15.0)
    assert torch.isfinite(axes).all()
    assert (factors == 1).all()


@pytest.mark.parametrize("resting", [True, False])
def test_only_what_rests_steps_farther_along_its_ray(resting, monkeypatch):
    monkeypatch.setattr(reference, "HALF_PARALLAX", 0.01)  # the images are tiny
    config = replace(tiny("default"), iterations=1)
    start = a_few(config)
    chosen = start.select(torch.nonzero(start.dynamic != resting)[:, 0])
    observations = seen(start)
    moved = {}
    for most in (1.0, 15.0):
        settings, copy = replace(config, rates=replace(config.rates, along_ray=most)), chosen.select(torch.arange(len(chosen)))
        trained = Trainer(observations, None, settings, start=copy).run()
        moved[most] = (trained.params["means"] - chosen.params["means"]).norm(dim=1)
    assert (moved[1.0] > 0).any()
    if resting:
        assert float(moved[15.0].max()) > 1.2 * float(moved[1.0].max())
    else:
        torch.testing.assert_close(moved[15.0], moved[1.0], rtol=0, atol=0)


@pytest.mark.parametrize("meters", [0.3, 0.0])
def test_the_kernel_matches_its_oracle(meters):
    g = torch.Generator().manual_seed(0)
    start, rows = 3 * torch.randn(300, 3, generator=g), torch.arange(20, 280)
    start[30], start[40] = torch.tensor([0.0, 0.0, 2.0]), torch.zeros(3)  # along an axis, and in the middle of the path
    found = []
    for step in (step_along_rays, reference.step_along_rays):
        value, adam = start.clone(), RowAdam({"means": start})
        g.manual_seed(1)
        for _ in range(3):
            stepped = torch.rand(len(rows), generator=g) < 0.7
            adam.begin_step(rows, stepped)
            gradient = torch.randn(len(rows), 3, generator=g)
            step(
                adam,
                "means",
                value,
                rows,
                stepped,
                gradient,
                torch.tensor([0.1, 0.2, 0.3]),
                PathSpread.of(travel(meters)),
                400.0,
                15.0,
            )
        found.append((value, *adam.moments("means")))
    for ours, oracle in zip(*found, strict=True):
        torch.testing.assert_close(ours, oracle, atol=2e-4, rtol=2e-4)
    assert torch.equal(found[0][0][280:], start[280:])
    assert float((found[0][0][20:280] - start[20:280]).abs().max()) > 0.1
