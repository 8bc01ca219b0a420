"""The Triton kernels round slicing and flow against their oracles, in Triton's interpreter where there is no GPU."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from flowsplat.gaussians import culling
from flowsplat.gaussians.culling import capacity as capacity_module
from flowsplat.gaussians.culling import reference as cull_reference
from flowsplat.gaussians.flow import FlowView, flow_features
from flowsplat.gaussians.gaussians4d import NEAR_PLANE, Active, Gaussians4D
from flowsplat.gaussians.slicing import Slice, reference
from flowsplat.geometry import Camera
from flowsplat.splatting import Projected, blend, project
from tests.common.compiling import compiled
from tests.gaussians.test_flow import assert_alike, camera, feature_inputs, feature_views, slice_of
from tests.gaussians.test_slicing import BASE, CASES, OUTPUTS, random_model
from tests.marks import slow

pytest.importorskip("triton", reason="Triton is not installed")
from flowsplat.gaussians.camera_buffer import CAMERA, pack_moment
from flowsplat.gaussians.culling import triton as cull_triton
from flowsplat.gaussians.flow import triton as flow_triton
from flowsplat.gaussians.slicing import triton
from flowsplat.gaussians.slopes import reference as slopes_reference
from flowsplat.gaussians.slopes import triton as slopes_triton

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


def cull_arguments(count, view, seed=0):
    g = torch.Generator().manual_seed(seed)
    gaussians = random_model(BASE, count)
    means = 3 * torch.randn(count, 3, generator=g)
    log_scales = torch.randn(count, 3, generator=g) - 3
    p = gaussians.params
    return [gaussians.at_rest, means, log_scales, p["times"], p["log_lambdas"] + 3, 0.4, 0.05, view, NEAR_PLANE]


def on_device(values):
    return [value.to(DEVICE) if isinstance(value, torch.Tensor) else value for value in values]


@pytest.mark.parametrize("count", [0, 1, 1000, slow(2500)])
@pytest.mark.parametrize("view", [None, Camera(np.eye(4), np.array([[40.0, 0, 20], [0, 40, 15], [0, 0, 1]]), 40, 30)])
def test_the_cull_keeps_what_its_oracle_and_the_cpu_keep(count, view):
    given = cull_arguments(count, view)
    rows, num_static = cull_triton.active_rows(*on_device(given))
    for expected, resting in (cull_reference.active_rows(*given), culling.active_rows(*given)):
        assert rows.cpu().tolist() == expected.tolist()
        assert num_static == resting
    assert count < 1000 or 0 < num_static < len(rows) < count


def test_the_cull_fills_buffers_of_a_fixed_size():
    given = cull_arguments(1500, None)
    rows, num_static = cull_triton.active_rows(*on_device(given))
    numbers, moment = torch.zeros(CAMERA.value), torch.tensor([given[5]])
    marked = cull_triton.Marked(*on_device([*given[:5], numbers, moment]), given[6], None, given[8])
    buffer = torch.full((num_static + 10 + len(rows) - num_static - 3,), -1, device=DEVICE)
    marked.collect(buffer, num_static + 10)
    assert buffer[:num_static].tolist() == rows[:num_static].tolist()
    assert buffer[num_static : num_static + 10].tolist() == [-1] * 10
    assert buffer[num_static + 10 :].tolist() == rows[num_static:-3].tolist()


@pytest.mark.parametrize("granule", [4, 2048])
def test_the_cull_fills_the_rows_and_says_how_many_it_needed(granule, monkeypatch):
    given = cull_arguments(1500, Camera(np.eye(4), np.array([[40.0, 0, 20], [0, 40, 15], [0, 0, 1]]), 40, 30))
    rows, num_static = cull_triton.active_rows(*on_device(given))
    monkeypatch.setattr(capacity_module, "GRANULE", granule)
    capacity = culling.RowCapacity()
    for attempt in range(2):
        padded, needed = culling.pad_active_rows(*on_device(given), capacity)
        assert needed.values() == [num_static, len(rows) - num_static]
        for places, chosen in ((padded[: capacity.at_rest], rows[:num_static]), (padded[capacity.at_rest :], rows[num_static:])):
            found = places[places >= 0]
            assert found.tolist() == chosen[: len(places)].tolist() == places[: len(found)].tolist()
        assert capacity.fits(needed.values()) == (granule == 2048 or attempt == 1)
        before = capacity.at_rest, capacity.moving
        capacity.grow(needed.values())
        assert granule == 4 or (capacity.at_rest, capacity.moving) == before
        assert (capacity.at_rest % granule, capacity.moving % granule) == (0, 0)


def differentiated(module, model, active, next_time, dtype, device):
    """Outputs and gradients of a slice under fixed random weights."""
    gradients = {}
    center = torch.tensor([0.1, 0.2, -3.0], dtype=dtype)
    sliced = module.slice_gaussians(model, active, center, next_time, gradients)
    g = torch.Generator().manual_seed(1)
    total, values = torch.zeros((), dtype=dtype, device=device), {}
    for name in OUTPUTS:
        value = getattr(sliced, name)
        if value is not None:
            values[name] = value.detach().cpu().double()
            weights = torch.randn(value.shape, generator=g, dtype=torch.float64).to(device, dtype)
            total = total + (value * weights).sum()
    total.backward()
    return values, {name: gradient.cpu().double() for name, gradient in gradients.items()}


@pytest.mark.parametrize(("config", "degree", "next_time"), [*CASES[:2], *(slow(*case) for case in CASES[2:])])
def test_slicing_matches_its_oracle(config, degree, next_time):
    gaussians = random_model(config, 150)  # more than a block, so that one rests, one is mixed
    gaussians.sh_degree = degree
    active = gaussians.active(0.4)
    exact = Gaussians4D({name: v.double() for name, v in gaussians.params.items()}, gaussians.dynamic, config, degree)
    expected, expected_gradients = differentiated(reference, exact, active, next_time, torch.float64, "cpu")
    there = Active(active.rows.to(DEVICE), active.num_static, active.t)
    found, gradients = differentiated(triton, gaussians.to(DEVICE), there, next_time, torch.float32, DEVICE)
    assert set(found) == set(expected)
    for name, value in expected.items():
        torch.testing.assert_close(found[name], value, atol=2e-5, rtol=2e-5, msg=name)
    for name, gradient in expected_gradients.items():
        torch.testing.assert_close(gradients[name], gradient, atol=2e-4, rtol=2e-4, msg=name)


@pytest.mark.parametrize("dynamic", [True, False])
def test_slicing_where_all_move_or_all_rest_or_there_are_none(dynamic):
    gaussians = random_model(BASE).to(DEVICE)
    gaussians.dynamic[:] = dynamic
    for active in (gaussians.active(0.5), Active(torch.empty(0, dtype=torch.int64, device=DEVICE), 0, 0.5)):
        gradients = {}
        sliced = triton.slice_gaussians(gaussians, active, torch.zeros(3), 0.6, gradients)
        sliced.colors.sum().backward()
        assert len(sliced.velocities) == (len(active.rows) if dynamic else 0)
        assert {name: len(g) for name, g in gradients.items()} == {
            name: len(gaussians.rows_of(name, active)) for name in gaussians.params
        }
    assert not triton.slice_gaussians(gaussians, active, torch.zeros(3), None, None).means.requires_grad


def test_padding_rows_have_no_opacity_and_the_others_are_as_without_them():
    gaussians = random_model(BASE).to(DEVICE)
    active = gaussians.active(0.5)
    n, padding = active.num_static, torch.full((7,), -1, device=DEVICE)
    moment = torch.from_numpy(pack_moment(gaussians.config.gains, 0.5, np.zeros(3), 0.6)).to(DEVICE)
    alone = triton.slice_rows(gaussians, active.rows, n, moment, True)
    rows = torch.cat([active.rows[:n], padding, active.rows[n:], padding])
    padded = triton.slice_rows(gaussians, rows, n + 7, moment, True)
    for value, with_padding in zip(alone, padded, strict=True):
        assert torch.isfinite(with_padding).all()
        chosen = (rows if len(with_padding) == len(rows) else rows[n + 7 :]) >= 0
        assert torch.equal(with_padding[chosen], value)
    assert float(padded[3][rows < 0].abs().max()) == 0


@pytest.mark.parametrize("next_time", [None, 0.6])
@pytest.mark.parametrize("any_rows", [True, False])
def test_padding_has_no_gradient_whatever_arrives_and_the_others_have_theirs(next_time, any_rows):
    gaussians = random_model(BASE).to(DEVICE)
    active = gaussians.active(0.5)
    if not any_rows:
        active = Active(active.rows[:0], 0, 0.5)
    n, padding = active.num_static, torch.full((7,), -1, device=DEVICE)
    padded = Active(torch.cat([active.rows[:n], padding, active.rows[n:], padding]), n + 7, 0.5)
    found = []
    for case in (active, padded):
        gradients = {}
        sliced = triton.slice_gaussians(gaussians, case, torch.tensor([0.1, 0.2, -3.0]), next_time, gradients)
        outputs = [value for value in (getattr(sliced, name) for name in OUTPUTS) if value is not None]
        g, arriving = torch.Generator().manual_seed(1), []
        for value in outputs:
            chosen = (case.rows if len(value) == len(case.rows) else case.rows[case.num_static :]) >= 0
            gradient = torch.full_like(value, torch.nan)
            gradient[chosen] = torch.randn(value[chosen].shape, generator=g).to(DEVICE)
            arriving.append(gradient)
        torch.autograd.backward(outputs, arriving)
        found.append(gradients)
    for name, expected in found[0].items():
        there, ours = gaussians.rows_of(name, padded) >= 0, found[1][name]
        assert torch.equal(ours[there], expected), name
        assert not ours[~there].count_nonzero(), name


@pytest.mark.parametrize("features_of", [flow_triton.blend_displacement, flow_triton.blend_affine])
def test_padding_is_not_drawn(features_of):
    gaussians = random_model(BASE).to(DEVICE)
    padding, view, gradients = Active(torch.full((20,), -1, device=DEVICE), 9, 0.5), camera(), {}
    sliced = triton.slice_gaussians(gaussians, padding, torch.zeros(3), 0.6, gradients)
    given = sliced.means, sliced.quats, sliced.scales, sliced.opacities, *view.tensors(device=DEVICE)
    projected = project(*given, view.width, view.height, backend="triton")
    views = (view, view) if features_of is flow_triton.blend_affine else (view,)
    image, alpha = blend(projected, sliced.opacities, features_of(sliced, projected, *views), view.width, view.height)
    (image.sum() + alpha.sum()).backward()
    assert not projected.visible.any()
    assert not image.count_nonzero()
    assert not alpha.count_nonzero()
    assert len(gradients) == len(gaussians.params)
    assert all(not gradient.count_nonzero() for gradient in gradients.values())


def test_hostile_gaussians_are_sliced_as_the_oracle_does():
    gaussians = random_model(BASE, 12)
    params = gaussians.params
    params["quats"][0] = 0
    params["log_lambdas"][1], params["times"][1] = 60.0, 0.4
    params["logit_opacities"][2], params["logit_opacities"][3] = 80.0, -80.0
    params["means"][4] = torch.tensor([0.1, 0.2, -3.0])  # in the camera's center
    params["sh"][5] = -5.0
    active = gaussians.active(0.4)
    expected, expected_gradients = differentiated(reference, gaussians, active, 0.5, torch.float32, "cpu")
    there = Active(active.rows.to(DEVICE), active.num_static, active.t)
    found, gradients = differentiated(triton, gaussians.to(DEVICE), there, 0.5, torch.float32, DEVICE)
    for name, value in expected.items():
        torch.testing.assert_close(found[name], value, atol=1e-4, rtol=1e-4, msg=name)
    for name, gradient in expected_gradients.items():
        assert torch.isfinite(gradients[name]).all(), name
        torch.testing.assert_close(gradients[name], gradient, atol=1e-3, rtol=1e-3, msg=name)


@pytest.mark.parametrize("behind", [False, True])
@pytest.mark.parametrize("model", ["displacement", "affine"])
def test_the_features_match_their_oracle(model, behind):
    view, other = feature_views(behind)
    inputs = feature_inputs()
    inputs["scales"][3, :2] = 1e-6  # a needle
    found = []
    for dtype, device in ((torch.float64, "cpu"), (torch.float32, DEVICE)):
        leaves = {name: value.to(device, dtype).requires_grad_() for name, value in inputs.items()}
        sliced = slice_of(leaves)
        radii = torch.ones_like(leaves["means2d"])
        projected = Projected(leaves["means2d"], leaves["means2d"], leaves["depths"], radii, None, "reference")
        if dtype == torch.float64:
            flow = FlowView(model, other, 0.1)
            cameras = *view.tensors(dtype), *other.tensors(dtype)
            features, front = flow_features(model, sliced, projected, flow.dt, *cameras, view.width, view.height)
            unseen = (~front).to(dtype)[:, None]
            features = torch.cat([sliced.colors, projected.depths[:, None], features, unseen], 1)
        elif model == "displacement":
            features = flow_triton.blend_displacement(sliced, projected, other)
        else:
            features = flow_triton.blend_affine(sliced, projected, view, other)
        weights = torch.randn(features.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        (features * weights.to(features)).sum().backward()
        gradients = [torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for leaf in leaves.values()]
        found.append([value.cpu().double() for value in (features.detach(), *gradients)])
    assert bool(found[0][0][:, -1].any()) == behind
    for name, exact, ours in zip(["features", *inputs], *found, strict=True):
        assert_alike(name, ours, exact, 2e-4)


def test_no_gaussians_have_no_features():
    view = camera()
    empty = torch.zeros(0, 3, device=DEVICE, requires_grad=True)
    quats = torch.zeros(0, 4, device=DEVICE)
    sliced = Slice(empty, quats, empty, None, empty[:, 0], empty, empty, empty, quats)
    projected = Projected(empty[:, :2], empty, empty[:, 0], empty[:, :2], None, "triton")
    displacement = flow_triton.blend_displacement(sliced, projected, view)
    affine = flow_triton.blend_affine(sliced, projected, view, view)
    for features in (displacement, affine):
        features.sum().backward()
        assert len(features) == 0


def test_slopes_in_the_image_match_their_oracle():
    count, g = 90, torch.Generator().manual_seed(0)
    view = camera()
    values = {
        "means": torch.rand(count, 3, generator=g) * torch.tensor([2.4, 1.8, 2]) - torch.tensor([1.2, 0.9, -1.0]),
        "quats": torch.randn(count, 4, generator=g), "scales": 0.15 * torch.rand(count, 3, generator=g) + 0.02,
        "opacities": 0.8 * torch.rand(count, generator=g) + 0.1,
    }  # fmt: skip
    values["means"][0] = torch.tensor([0.0, 0, -1])  # behind the camera
    slopes, weights = torch.rand(count, 2, generator=g) - 0.5, torch.randn(count, 2, generator=g)
    found = []
    for slopes_of, dtype, device in ((slopes_reference, torch.float64, "cpu"), (slopes_triton, torch.float32, DEVICE)):
        means, quats, scales, opacities = (value.to(device, dtype) for value in values.values())
        leaf = slopes.to(device, dtype).requires_grad_()
        projected = project(means, quats, scales, opacities, *view.tensors(dtype, device), view.width, view.height)
        sliced = Slice(means, quats, scales, None, opacities, means, means, None, None, leaf)
        seen = slopes_of.image_slopes(sliced, projected, view)
        (seen * weights.to(seen)).sum().backward()
        found.append([seen.detach().cpu().double(), leaf.grad.cpu().double()])
    assert not found[1][0][0].any(), "what is behind the camera has none"
    assert int(found[0][0].any(1).sum()) > count // 4
    for name, exact, ours in zip(("slopes in the image", "gradient"), *found, strict=True):
        assert_alike(name, ours, exact, 2e-4)


def test_no_gaussians_have_no_slopes():
    empty = torch.zeros(0, 3, device=DEVICE)
    leaf = torch.zeros(0, 2, device=DEVICE, requires_grad=True)
    sliced = Slice(empty, torch.zeros(0, 4, device=DEVICE), empty, None, empty[:, 0], empty, empty, None, None, leaf)
    projected = Projected(empty[:, :2], empty, empty[:, 0], empty[:, :2], None, "triton")
    seen = slopes_triton.image_slopes(sliced, projected, camera())
    seen.sum().backward()
    assert seen.shape == (0, 2)


@pytest.mark.slow
def test_every_kernel_compiles_for_gpus_that_are_not_there():
    kernels = compiled("""
from dataclasses import replace
from flowsplat.gaussians.camera_buffer import camera_numbers
from flowsplat.gaussians.culling import triton as culling
from flowsplat.gaussians.flow import triton as flow
from flowsplat.gaussians.slicing import Slice, triton as slicing
from flowsplat.gaussians.slopes import triton as slopes
from flowsplat.splatting import Projected
from tests.common.compiling import compiled
from tests.gaussians.test_flow import camera
from tests.gaussians.test_slicing import BASE, random_model

small = replace(BASE, sh_degree=2, mean_poly=3, mean_fourier=1, quat_poly=1, quat_fourier=0)
for config, degree, next_time, size in ((small, 0, None, None), (small, 2, 0.7, (64, 48))):
    gaussians = random_model(config, 200)
    gaussians.sh_degree, p = degree, gaussians.params
    numbers, moment = torch.from_numpy(camera_numbers(camera())[0]), torch.tensor([0.5])
    given = gaussians.at_rest, p["means"], p["log_scales"], p["times"], p["log_lambdas"], numbers, moment
    culling.Marked(*given, 0.05, size, 0.02).collect(torch.empty(200, dtype=torch.int64), 100)
    sliced = slicing.slice_gaussians(gaussians, gaussians.active(0.5), torch.zeros(3), next_time, {})
    (sliced.means.sum() + sliced.quats.sum()).backward()
leaves = [torch.rand(50, size, requires_grad=True) for size in (3, 4, 3, 3, 3, 4, 2)]
means, quats, scales, colors, next_means, next_quats, means2d = leaves
sliced = Slice(means, quats, scales, None, means[:, 0], colors, means, next_means, next_quats)
projected = Projected(means2d, means, means[:, 0], means2d, None, "triton")
flow.blend_displacement(sliced, projected, camera()).sum().backward()
flow.blend_affine(sliced, projected, camera(), camera()).sum().backward()
sliced = replace(sliced, slopes=torch.rand(50, 2, requires_grad=True))
slopes.image_slopes(sliced, projected, camera()).sum().backward()
""")
    assert set(kernels) == {"_mark", "_collect", "_forward", "_backward"}
    assert all({"80", "90"} <= targets for targets in kernels.values())
