"""The Triton kernels of training against their oracles, in Triton's interpreter where there is no GPU."""

from __future__ import annotations

from dataclasses import asdict, replace

import pytest
import torch

from flowsplat.training.adam import RowAdam
from flowsplat.training.adam import reference as adam_reference
from flowsplat.training.photometric_loss import PhotometricTargets, PhotometricWeights
from flowsplat.training.photometric_loss import reference as photometric_reference
from flowsplat.training.ray_preconditioning import PathSpread
from flowsplat.training.ray_preconditioning import reference as rays_reference
from flowsplat.training.rigidity import Neighbors, find_neighbors
from flowsplat.training.rigidity import reference as rigid_reference
from tests.common.compiling import compiled
from tests.training.test_operations import image_case, moving_model

pytest.importorskip("triton", reason="Triton is not installed")
from flowsplat.training.adam import triton as adam_triton
from flowsplat.training.photometric_loss import triton as photometric_triton
from flowsplat.training.ray_preconditioning import triton as rays_triton
from flowsplat.training.rigidity import triton as rigid_triton

DEVICE = torch.device("cuda", 0) if torch.cuda.is_available() else torch.device("cpu")


@pytest.mark.parametrize(
    ("size", "ssim", "channels", "flow_channels", "by_alpha"),
    [
        ((40, 50), 0.2, 6, 2, True),
        ((12, 33), 0.2, 11, 6, True),
        ((7, 3), 1.0, 10, 6, False),
        ((1, 1), 0.2, 7, 2, True),
        ((9, 14), 0.0, 4, 0, True),
        ((5, 60), 0.3, 7, 2, False),
    ],
)
def test_the_photometric_loss_matches_its_oracle(size, ssim, channels, flow_channels, by_alpha):
    image, alpha, targets = image_case(*size, channels)
    if flow_channels == 0:
        targets = replace(targets, flow=None, flow_trusted=None)
    weights = PhotometricWeights(ssim, 0.3, 0.7, by_alpha)
    found = []
    for module, dtype, device in ((photometric_reference, torch.float64, "cpu"), (photometric_triton, torch.float32, DEVICE)):
        leaves = image.to(device, dtype).requires_grad_(), alpha.to(device, dtype).requires_grad_()
        loss, figures = module.photometric_loss(*leaves, flow_channels, targets, weights)
        (2 * loss).backward()
        parts = {name: float(part) for name, part in asdict(figures).items()}
        found.append((float(loss.detach()), parts, [leaf.grad.cpu().double() for leaf in leaves]))
    (expected, figures, gradients), (loss, ours, our_gradients) = found
    assert loss == pytest.approx(expected, abs=1e-5, rel=1e-5)
    assert ours == pytest.approx(figures, abs=1e-5, rel=1e-5)
    for exact, gradient in zip(gradients, our_gradients, strict=True):
        torch.testing.assert_close(gradient, exact, atol=5e-6, rtol=1e-3)


def test_the_photometric_loss_of_targets_without_anything_to_trust():
    image, alpha, targets = image_case(9, 8, 6)
    image, alpha = image.to(DEVICE).requires_grad_(), alpha.to(DEVICE)
    nothing = replace(targets, flow_trusted=targets.flow_trusted & False, depth_trusted=targets.depth_trusted & False).to(DEVICE)
    all_on = PhotometricWeights(0.2, 1.0, 1.0)
    cases = [(nothing, all_on), (PhotometricTargets(targets.color), all_on), (targets, PhotometricWeights())]
    for case, weights in cases:
        loss, figures = photometric_triton.photometric_loss(image, alpha, 2, case, weights)
        image.grad = None
        loss.backward()
        assert float(figures.flow) == float(figures.depth) == 0
        assert torch.isfinite(image.grad).all()
        assert float(image.grad[..., 3:].abs().max()) == 0


def test_a_step_of_adam_matches_its_oracle_and_leaves_other_rows_alone():
    g = torch.Generator().manual_seed(1)
    value = torch.randn(20, 6, generator=g)
    states = [[value.clone().to(d), torch.zeros(20, 6, device=d), torch.zeros(20, 6, device=d)] for d in (DEVICE, "cpu")]
    counts, rates = torch.zeros(20, dtype=torch.int32), torch.rand(6, generator=g)
    counts[3] = 50_000  # more than the table holds
    for _ in range(4):
        rows = torch.nonzero(torch.rand(20, generator=g) < 0.4).squeeze(1)
        rows = rows[rows < 18]
        stepped = rows < 15
        counts[rows[stepped]] += 1
        gradient = torch.randn(len(rows), 6, generator=g)
        gradient[0] = 0
        for module, state in zip((adam_triton, adam_reference), states, strict=True):
            device = state[0].device
            module.step_rows(*state, *(t.to(device) for t in (counts, rows, stepped, gradient, rates)))
    for ours, oracle in zip(*states, strict=True):
        torch.testing.assert_close(ours.cpu(), oracle, atol=1e-5, rtol=1e-4)
    assert torch.equal(states[0][0][15:].cpu(), value[15:])


def test_adam_leaves_padding_rows_out():
    g = torch.Generator().manual_seed(1)
    value, gradient, rates = torch.randn(5, 4, generator=g), torch.randn(4, 4, generator=g), torch.ones(4)
    states = [[value.clone().to(DEVICE), torch.zeros(5, 4, device=DEVICE), torch.zeros(5, 4, device=DEVICE)] for _ in range(2)]
    counts, rows, stepped = torch.ones(5, dtype=torch.int32), torch.tensor([3, -1, 0, -1]), torch.tensor([True, False, True, False])
    for state, kept in zip(states, ([0, 1, 2, 3], [0, 2]), strict=True):
        adam_triton.step_rows(*state, *(t.to(DEVICE) for t in (counts, rows[kept], stepped[kept], gradient[kept], rates)))
    for ours, expected in zip(*states, strict=True):
        assert torch.equal(ours, expected)
    assert torch.equal(states[0][0][4].cpu(), value[4])


@pytest.mark.parametrize("dynamic_only", [True, False])
def test_the_rigid_loss_matches_its_oracle(dynamic_only):
    gaussians, times = moving_model()
    neighbors = find_neighbors(gaussians, times, 5, 10.0, dynamic_only)
    active = gaussians.active(times[1])
    rows = active.rows[active.num_static :]
    start = torch.randn(len(rows), 3, generator=torch.Generator().manual_seed(1))
    start[1] = start[0]
    found = []
    for module, dtype, device in ((rigid_reference, torch.float64, "cpu"), (rigid_triton, torch.float32, DEVICE)):
        velocities = start.to(device, dtype).requires_grad_()
        there = Neighbors(neighbors.indices.to(device), neighbors.weights.to(device))
        loss = module.rigid_loss(velocities, rows.to(device), there, 17)
        (3 * loss).backward()
        found.append((float(loss.detach()), velocities.grad.cpu().double()))
    assert found[1][0] == pytest.approx(found[0][0], rel=1e-5)
    assert found[0][0] > 0.01
    torch.testing.assert_close(found[1][1], found[0][1], atol=1e-6, rtol=1e-4)


def test_padding_rows_pull_no_gaussian():
    gaussians, times = moving_model()
    neighbors = find_neighbors(gaussians, times, 5, 10.0, True)
    active = gaussians.active(times[1])
    rows = active.rows[active.num_static :].to(DEVICE)
    velocities = torch.randn(len(rows), 3, generator=torch.Generator().manual_seed(1)).to(DEVICE)
    there = Neighbors(neighbors.indices.to(DEVICE), neighbors.weights.to(DEVICE))
    there.indices[0], there.weights[0] = rows[1:6].to(torch.int32), 1.0  # which padding might be taken for
    padding = torch.full((9,), -1, device=DEVICE)
    found = []
    for places in (rows, torch.cat([rows, padding]), padding):
        own = torch.ones(len(places), 3, device=DEVICE)
        own[: len(rows)] = velocities[: len(places)]
        loss = rigid_triton.rigid_loss(own.requires_grad_(), places, there, torch.tensor(17, device=DEVICE))
        loss.backward()
        found.append((float(loss.detach()), own.grad))
    (expected, gradient), (padded, ours), (nothing, none) = found
    assert padded == pytest.approx(expected, rel=1e-6)
    assert torch.equal(ours[: len(rows)], gradient)
    assert not ours[len(rows) :].count_nonzero()
    assert nothing == 0
    assert not none.count_nonzero()


def test_no_gaussians_have_no_rigid_loss():
    neighbors = Neighbors(torch.full((4, 3), -1, dtype=torch.int32, device=DEVICE), torch.zeros(4, 3, device=DEVICE))
    for rows in ([], [0, 2]):
        velocities = torch.ones(len(rows), 3, device=DEVICE, requires_grad=True)
        loss = rigid_triton.rigid_loss(velocities, torch.tensor(rows, dtype=torch.int64, device=DEVICE), neighbors, 1)
        loss.backward()
        assert float(loss.detach()) == 0
        assert velocities.grad is None or float(velocities.grad.abs().sum()) == 0


@pytest.mark.parametrize("meters", [0.3, 0.0])
def test_steps_along_rays_match_their_oracle(meters):
    g = torch.Generator().manual_seed(0)
    start, rows = 3 * torch.randn(60, 3, generator=g), torch.arange(5, 55)
    start[10], start[20] = torch.tensor([0.0, 0.0, 2.0]), torch.zeros(3)  # along an axis, and in the middle of the path
    centers = torch.outer(torch.linspace(-1, 1, 9), torch.tensor([meters, 0.0, 0.02]))
    path, rates = PathSpread.of(centers), torch.tensor([0.1, 0.2, 0.3])
    values = {device: start.clone().to(device) for device in ("cpu", DEVICE)}
    ours, adam = (RowAdam({"means": values[device].clone()}) for device in (DEVICE, "cpu"))
    expected, value = values["cpu"].clone(), values[DEVICE].clone()
    for _ in range(3):
        stepped, gradient = torch.rand(len(rows), generator=g) < 0.7, torch.randn(len(rows), 3, generator=g)
        for each, device in ((ours, DEVICE), (adam, "cpu")):
            each.begin_step(rows.to(device), stepped.to(device))
        rays_reference.step_along_rays(adam, "means", expected, rows, stepped, gradient, rates, path, 400.0, 15.0)
        on_device = (rows, stepped, gradient, rates)
        there = PathSpread.of(centers, DEVICE)
        rays_triton.step_rows(value, *ours.moments("means"), *(t.to(DEVICE) for t in on_device), there, 400.0, 15.0)
    for found, oracle in zip((value, *ours.moments("means")), (expected, *adam.moments("means")), strict=True):
        torch.testing.assert_close(found.cpu(), oracle, atol=2e-4, rtol=2e-4)
    assert float((expected - start).abs().max()) > 0.1


@pytest.mark.slow
def test_every_kernel_compiles_for_gpus_that_are_not_there():
    kernels = compiled("""
from dataclasses import replace
from flowsplat.training.adam import triton as adam
from flowsplat.training.photometric_loss import PhotometricWeights, triton as photometric_loss
from flowsplat.training.ray_preconditioning import PathSpread, triton as rays
from flowsplat.training.rigidity import find_neighbors, triton as rigidity
from tests.common.compiling import compiled
from tests.training.test_operations import moving_model, image_case

for channels, flow_channels, by_alpha in ((4, 0, True), (7, 2, True), (11, 6, False)):
    image, alpha, targets = image_case(9, 8, channels)
    if flow_channels == 0:
        targets = replace(targets, flow=None, flow_trusted=None)
    weights = PhotometricWeights(0.2, 0.3, 0.7, by_alpha)
    photometric_loss.photometric_loss(image.requires_grad_(), alpha, flow_channels, targets, weights)[0].backward()
rows = torch.arange(20)
for size in (1, 4, 48):
    state = torch.zeros(20, size), torch.zeros(20, size), torch.zeros(20, size), torch.zeros(20, dtype=torch.int32)
    adam.step_rows(*state, rows, rows > 3, torch.zeros(20, size), torch.zeros(size))
path = PathSpread.of(torch.rand(5, 3))
state = torch.zeros(20, 3), torch.zeros(20, 3), torch.zeros(20, 3), torch.zeros(20, dtype=torch.int32)
rays.step_rows(*state, rows, rows > 3, torch.zeros(20, 3), torch.zeros(3), path, 400.0, 15.0)
model, times = moving_model()
rows = model.active(times[1]).rows
velocities = torch.zeros(len(rows), 3, requires_grad=True)
rigidity.rigid_loss(velocities, rows, find_neighbors(model, times, 5, 10.0, True), 3).backward()
""")
    assert {"_step", "_loss_and_gradient", "_blur_products", "_derivatives", "_blur_derivatives", "_color_gradient", "_count_flow",
            "_other_gradients"} == set(kernels)  # fmt: skip
    assert all({"80", "90"} <= targets for targets in kernels.values())
