"""Losses and Adam: kernels against their oracles, and against torch's own Adam."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np
import pytest
import torch

from flowsplat.gaussians.gaussians4d import Gaussians4D, parameter_shapes
from flowsplat.gaussians.model_config import ModelConfig
from flowsplat.training.adam import RowAdam, cpu, reference
from flowsplat.training.photometric_loss import PhotometricTargets, PhotometricWeights, photometric_loss
from flowsplat.training.photometric_loss import cpu as photometric_cpu
from flowsplat.training.photometric_loss import reference as photometric_reference
from flowsplat.training.rigidity import cpu as rigid_cpu
from flowsplat.training.rigidity import find_neighbors, rigid_loss
from flowsplat.training.rigidity import reference as rigid_reference


def image_case(height, width, channels, seed=0):
    """A rendered image, its alpha, and what it should show; errors are never exactly zero."""
    rng = np.random.default_rng(seed)
    image = torch.from_numpy(rng.normal(0.5, 0.4, (height, width, channels)).astype(np.float32))
    alpha = torch.from_numpy(rng.uniform(0.2, 1, (height, width)).astype(np.float32))
    if channels in (7, 11):
        image[..., -1] = alpha * torch.from_numpy(rng.choice([0.0, 0.04, 0.2], (height, width)).astype(np.float32))
    targets = PhotometricTargets(
        color=rng.integers(0, 256, (height, width, 3), dtype=np.uint8),
        depth=rng.uniform(0.5, 2, (height, width)).astype(np.float32),
        depth_trusted=rng.random((height, width)) < 0.7,
        flow=rng.normal(0, 3, (height, width, 2)).astype(np.float32),
        flow_trusted=rng.random((height, width)) < 0.7,
    )
    return image, alpha, targets


@pytest.mark.parametrize(("height", "width"), [(40, 50), (1, 1), (7, 3), (12, 33)])
@pytest.mark.parametrize("ssim", [0.0, 0.2, 1.0])
@pytest.mark.parametrize(("channels", "flow_channels"), [(4, 0), (6, 2), (7, 2), (10, 6), (11, 6)])
@pytest.mark.parametrize("by_alpha", [True, False])
def test_the_photometric_loss_matches_its_oracle(height, width, ssim, channels, flow_channels, by_alpha):
    image, alpha, targets = image_case(height, width, channels)
    if flow_channels == 0:
        targets = replace(targets, flow=None, flow_trusted=None)
    weights = PhotometricWeights(ssim, 0.3, 0.7, by_alpha)
    found = []
    for module, dtype in ((photometric_reference, torch.float64), (photometric_cpu, torch.float32)):
        leaves = image.to(dtype).requires_grad_(), alpha.to(dtype).requires_grad_()
        loss, figures = module.photometric_loss(*leaves, flow_channels, targets, weights)
        (2 * loss).backward()
        found.append((float(loss.detach()), figures, [leaf.grad for leaf in leaves]))
    (expected, figures, gradients), (loss, ours, our_gradients) = found
    assert loss == pytest.approx(expected, abs=1e-5, rel=1e-5)
    assert asdict(ours) == pytest.approx(asdict(figures), abs=1e-5, rel=1e-5)
    for exact, gradient in zip(gradients, our_gradients, strict=True):
        torch.testing.assert_close(gradient.double(), exact, atol=5e-6, rtol=1e-3)


def test_a_part_of_weight_zero_is_not_computed():
    image, alpha, targets = image_case(9, 8, 6)
    for module in (photometric_cpu, photometric_reference):
        _, figures = module.photometric_loss(image, alpha, 2, targets, PhotometricWeights())
        assert figures.flow == figures.depth == 0


def test_a_perfect_image_costs_nothing():
    targets = image_case(20, 20, 6)[2]
    image = torch.cat(
        [torch.from_numpy(targets.color) / 255, torch.from_numpy(targets.depth)[..., None], torch.from_numpy(targets.flow)], -1
    )
    loss, figures = photometric_loss(image, torch.ones(20, 20), 2, targets, PhotometricWeights(0.2, 1.0, 1.0))
    assert abs(float(loss)) < 1e-5
    assert figures.squared_error < 1e-12


def test_the_oracle_of_the_color_loss_differentiates():
    image, target = torch.rand(4, 5, 3, dtype=torch.float64, requires_grad=True), torch.rand(4, 5, 3, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda x: photometric_reference.color_loss(x, target, 0.3), image)


def test_with_all_rows_active_it_is_torchs_adam():
    ours, theirs = torch.randn(30, 4, 3), None
    theirs = ours.clone().requires_grad_()
    optimizer = torch.optim.Adam([theirs], lr=0.01, eps=1e-15)
    adam, rows = RowAdam({"p": ours}), torch.arange(30)
    for _ in range(20):
        gradient = torch.randn(30, 4, 3)
        theirs.grad = gradient.clone()
        optimizer.step()
        adam.begin_step(rows, torch.ones(30, dtype=torch.bool))
        adam.step("p", ours, rows, torch.ones(30, dtype=torch.bool), gradient, torch.full((12,), 0.01))
    torch.testing.assert_close(ours, theirs.detach(), atol=1e-5, rtol=1e-5)


def test_the_row_kernel_matches_its_oracle_and_leaves_other_rows_alone():
    value = torch.randn(20, 6)
    states = [(value.clone(), torch.zeros(20, 6), torch.zeros(20, 6)) for _ in range(2)]
    counts, rates = torch.zeros(20, dtype=torch.int32), torch.rand(6)
    g = torch.Generator().manual_seed(1)
    for _ in range(10):
        rows = torch.nonzero(torch.rand(20, generator=g) < 0.4).squeeze(1)
        rows = rows[rows < 18]
        stepped = rows < 15
        counts[rows[stepped]] += 1
        gradient = torch.randn(len(rows), 6, generator=g)
        for module, state in zip((cpu, reference), states, strict=True):
            module.step_rows(*state, counts, rows, stepped, gradient, rates)
    for ours, oracle in zip(*states, strict=True):
        torch.testing.assert_close(ours, oracle, atol=1e-4, rtol=1e-4)
    assert torch.equal(states[0][0][15:], value[15:])


def test_moments_follow_density_control():
    value = torch.randn(4, 2)
    adam = RowAdam({"p": value})
    every = torch.ones(4, dtype=torch.bool)
    adam.begin_step(torch.arange(4), every)
    adam.step("p", value, torch.arange(4), every, torch.arange(8.0).view(4, 2) + 1, torch.ones(2))
    before = adam.means["p"].clone()
    adam.reindex(torch.tensor([2, 0, 0]), torch.tensor([False, False, True]))
    assert torch.equal(adam.means["p"][:2], before[[2, 0]])
    assert float(adam.means["p"][2].abs().max()) == 0
    assert adam.counts.tolist() == [1, 1, 0]


def test_flow_loss_by_alpha_ignores_the_transparent_and_is_unbiased():
    target, alpha = torch.full((4, 4, 2), 3.0), torch.full((4, 4), 0.8)
    alpha[0] = 0.3
    valid = torch.ones(4, 4, dtype=torch.bool)
    premultiplied = target * alpha[..., None]
    flow_loss = photometric_reference.flow_loss
    assert float(flow_loss(premultiplied, alpha, target, valid, True)) == pytest.approx(0, abs=1e-6)
    assert float(flow_loss(premultiplied, alpha, target, valid, False)) > 0.5
    assert float(flow_loss(premultiplied, alpha, target, valid & False, True)) == 0


def test_depth_loss_is_relative():
    alpha, valid = torch.ones(4, 4), torch.ones(4, 4, dtype=torch.bool)
    loss = photometric_reference.depth_loss(torch.full((4, 4), 2.2), alpha, torch.full((4, 4), 2.0), valid)
    assert float(loss) == pytest.approx(0.1)


def moving_model(count=60, frames=4):
    """Gaussians about the times of some frames, each alive in a few of them; a third are background."""
    g = torch.Generator().manual_seed(0)
    config = ModelConfig(mean_poly=1, mean_fourier=0, quat_poly=0, quat_fourier=0, sh_degree=0, freeze_background=True)
    params = {name: torch.zeros(count, *shape) for name, shape in parameter_shapes(config).items()}
    params["means"] = 0.1 * torch.randn(count, 3, generator=g)
    params["times"] = torch.randint(frames, (count,), generator=g) / (frames - 1)
    params["log_lambdas"] += np.log((frames / 1.5) ** 2)
    return Gaussians4D(params, torch.arange(count) % 3 > 0, config), [k / (frames - 1) for k in range(frames)]


def test_neighbors_are_the_nearest_of_those_alive_at_the_center_time():
    gaussians, times = moving_model()
    neighbors = find_neighbors(gaussians, times, 5, 10.0, dynamic_only=True)
    assert (neighbors.indices[~gaussians.dynamic] == -1).all()
    for i in torch.nonzero(gaussians.dynamic).squeeze(1).tolist():
        alive = gaussians.active(float(gaussians.params["times"][i])).rows
        alive = alive[gaussians.dynamic[alive] & (alive != i)]
        distance = (gaussians.params["means"][alive] - gaussians.params["means"][i]).norm(dim=1)
        order = distance.argsort()[:5]
        assert neighbors.indices[i].tolist() == alive[order].tolist()
        torch.testing.assert_close(neighbors.weights[i], torch.exp(-10 * distance[order]))


def test_neighbors_follow_density_control():
    gaussians, times = moving_model()
    neighbors = find_neighbors(gaussians, times, 5, 10.0, dynamic_only=True)
    index = torch.tensor([*range(10, 60), 20, 20])  # ten are removed, one is cloned twice
    reindexed = neighbors.reindex(index)
    for i in range(52):
        expected = [j - 10 if j >= 10 else -1 for j in neighbors.indices[index[i]].tolist()]
        assert reindexed.indices[i].tolist() == expected
    assert (reindexed.weights[reindexed.indices < 0] == 0).all()


@pytest.mark.parametrize("dynamic_only", [True, False])
def test_the_rigid_loss_matches_its_oracle(dynamic_only):
    gaussians, times = moving_model()
    neighbors = find_neighbors(gaussians, times, 5, 10.0, dynamic_only)
    active = gaussians.active(times[1])
    rows = active.rows[active.num_static :]
    start = torch.randn(len(rows), 3, generator=torch.Generator().manual_seed(1))
    found = []
    for module, dtype in ((rigid_reference, torch.float64), (rigid_cpu, torch.float32)):
        velocities = start.to(dtype).requires_grad_()
        loss = module.rigid_loss(velocities, rows, neighbors, 17)
        (3 * loss).backward()
        found.append((float(loss.detach()), velocities.grad))
    assert found[1][0] == pytest.approx(found[0][0], rel=1e-5)
    assert found[0][0] > 0.01
    torch.testing.assert_close(found[1][1].double(), found[0][1], atol=1e-6, rtol=1e-4)


def test_the_rigid_loss_is_zero_for_a_common_motion_and_safe_at_rest():
    gaussians, times = moving_model()
    neighbors = find_neighbors(gaussians, times, 5, 10.0, dynamic_only=True)
    rows = gaussians.active(times[1]).rows
    for value in (0.0, 1.0):
        velocities = torch.full((len(rows), 3), value, requires_grad=True)
        loss = rigid_loss(velocities, rows, neighbors, len(rows))
        loss.backward()
        assert float(loss.detach()) < 1e-5
        assert torch.isfinite(velocities.grad).all()


def test_who_lies_where_its_twin_does_has_the_twin_as_neighbor():
    gaussians, times = moving_model()
    twice = gaussians.select(torch.cat([torch.arange(60), torch.arange(60)]))
    neighbors = find_neighbors(twice, times, 5, 10.0, dynamic_only=True)
    own = torch.arange(120)
    moving = torch.nonzero(twice.dynamic).squeeze(1)
    assert not (neighbors.indices == own[:, None]).any()
    assert (neighbors.indices[moving] == ((own + 60) % 120)[moving, None]).any(1).all()
