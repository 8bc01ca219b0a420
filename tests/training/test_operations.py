"""The colour loss and Adam: kernels against their oracles, and against torch's own Adam. The other losses."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from flowsplat.training.adam import RowAdam, cpu, reference
from flowsplat.training.losses import depth_loss, flow_loss, rigid_loss, rigid_neighbours
from flowsplat.training.ssim import colour_loss
from flowsplat.training.ssim import cpu as ssim_cpu
from flowsplat.training.ssim import reference as ssim_reference


@pytest.mark.parametrize(("height", "width"), [(40, 50), (1, 1), (7, 3), (12, 33)])
@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_the_colour_loss_matches_its_oracle(height, width, weight):
    g = torch.Generator().manual_seed(0)
    image, target = torch.rand(height, width, 3, generator=g, requires_grad=True), torch.rand(height, width, 3, generator=g)
    expected = ssim_reference.colour_loss(image.double(), target.double(), weight)
    (gradient,) = torch.autograd.grad(expected, image)
    found = ssim_cpu.colour_loss(image, target, weight)
    assert float(found.detach()) == pytest.approx(float(expected.detach()), abs=1e-5)
    torch.testing.assert_close(torch.autograd.grad(found, image)[0], gradient, atol=2e-6, rtol=1e-4)


def test_the_colour_loss_of_equal_pictures_is_zero():
    image = torch.rand(20, 20, 3)
    assert abs(float(colour_loss(image, image.clone(), 0.2))) < 1e-6


def test_the_oracle_of_the_colour_loss_differentiates():
    image, target = torch.rand(4, 5, 3, dtype=torch.float64, requires_grad=True), torch.rand(4, 5, 3, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda x: ssim_reference.colour_loss(x, target, 0.3), image)


def test_with_all_rows_active_it_is_torchs_adam():
    ours, theirs = torch.randn(30, 4, 3), None
    theirs = ours.clone().requires_grad_()
    optimizer = torch.optim.Adam([theirs], lr=0.01, eps=1e-15)
    adam, rows = RowAdam({"p": ours}), torch.arange(30)
    for _ in range(20):
        gradient = torch.randn(30, 4, 3)
        theirs.grad = gradient.clone()
        optimizer.step()
        adam.begin_step(rows)
        adam.step("p", ours, rows, gradient, torch.full((12,), 0.01))
    torch.testing.assert_close(ours, theirs.detach(), atol=1e-5, rtol=1e-5)


def test_the_row_kernel_matches_its_oracle_and_leaves_other_rows_alone():
    value = torch.randn(20, 6)
    states = [(value.clone(), torch.zeros(20, 6), torch.zeros(20, 6)) for _ in range(2)]
    counts, rates = torch.zeros(20, dtype=torch.int32), torch.rand(6)
    g = torch.Generator().manual_seed(1)
    for _ in range(10):
        rows = torch.nonzero(torch.rand(20, generator=g) < 0.4).squeeze(1)
        rows = rows[rows < 15]
        counts[rows] += 1
        gradient = torch.randn(len(rows), 6, generator=g)
        for module, state in zip((cpu, reference), states, strict=True):
            module.step_rows(*state, counts, rows, gradient, rates)
    for ours, oracle in zip(*states, strict=True):
        torch.testing.assert_close(ours, oracle, atol=1e-4, rtol=1e-4)
    assert torch.equal(states[0][0][15:], value[15:])


def test_moments_follow_density_control():
    value = torch.randn(4, 2)
    adam = RowAdam({"p": value})
    adam.begin_step(torch.arange(4))
    adam.step("p", value, torch.arange(4), torch.arange(8.0).view(4, 2) + 1, torch.ones(2))
    before = adam.means["p"].clone()
    adam.follow(torch.tensor([2, 0, 0]), torch.tensor([False, False, True]))
    assert torch.equal(adam.means["p"][:2], before[[2, 0]])
    assert float(adam.means["p"][2].abs().max()) == 0
    assert adam.counts.tolist() == [1, 1, 0]


def test_flow_loss_by_alpha_ignores_the_transparent_and_is_unbiased():
    target, alpha = torch.full((4, 4, 2), 3.0), torch.full((4, 4), 0.8)
    alpha[0] = 0.3
    valid = torch.ones(4, 4, dtype=torch.bool)
    premultiplied = target * alpha[..., None]
    assert float(flow_loss(premultiplied, alpha, target, valid, True)) == pytest.approx(0, abs=1e-6)
    assert float(flow_loss(premultiplied, alpha, target, valid, False)) > 0.5
    assert float(flow_loss(premultiplied, alpha, target, valid & False, True)) == 0


def test_depth_loss_is_relative():
    alpha, valid = torch.ones(4, 4), torch.ones(4, 4, dtype=torch.bool)
    assert float(depth_loss(torch.full((4, 4), 2.2), alpha, torch.full((4, 4), 2.0), valid)) == pytest.approx(0.1)


def test_rigid_loss_is_zero_for_a_common_motion_and_safe_at_rest():
    rng = np.random.default_rng(0)
    means = rng.normal(size=(30, 3)) * 0.01
    neighbours, weights = rigid_neighbours(means, 5, 100.0)
    assert neighbours.shape == (30, 5)
    assert not (neighbours == torch.arange(30)[:, None]).any()
    velocities = torch.ones(30, 3, requires_grad=True)
    loss = rigid_loss(velocities, neighbours, weights, 30)
    loss.backward()
    assert float(loss.detach()) < 1e-5
    assert torch.isfinite(velocities.grad).all()
    g = torch.Generator().manual_seed(0)
    start = torch.randn(30, 3, generator=g, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda v: rigid_loss(v, neighbours, weights.double(), 30), start)
    different = torch.ones(30, 3)
    different[:15] = 0
    assert float(rigid_loss(different, neighbours, weights, 30)) > 0.01
    assert float(rigid_loss(different, neighbours, weights, 60)) == pytest.approx(
        0.5 * float(rigid_loss(different, neighbours, weights, 30)), rel=1e-5
    )
