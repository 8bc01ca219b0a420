"""Flow splatting: camera-only flow against depth reprojection, the affine model against Monte Carlo, compositing."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from flowsplat.gaussians.flow import FlowView, affine_gradient, blend_features, flow_features, flow_image
from flowsplat.gaussians.gaussians4d import Gaussians4D, parameter_shapes
from flowsplat.gaussians.model_config import ModelConfig
from flowsplat.gaussians.render import render, render_active
from flowsplat.gaussians.slicing import Slice
from flowsplat.geometry import Camera
from flowsplat.geometry.cameras import pixel_grid
from flowsplat.geometry.rotations import quats_to_rotations
from flowsplat.splatting import Projected
from flowsplat.splatting.rules import EPS2D
from tests.geometry.still import camera_flow

CONFIG = ModelConfig(mean_poly=2, mean_fourier=1, quat_poly=2, quat_fourier=0, sh_degree=0)


def make(means, config=CONFIG, scale=0.02, dynamic=True, **params):
    count = len(means)
    values = {name: torch.zeros(count, *shape) for name, shape in parameter_shapes(config).items()}
    values["means"] = torch.as_tensor(means, dtype=torch.float32)
    values["quats"][:, 0] = 1
    values["log_scales"][:] = np.log(scale)
    values["logit_opacities"][:] = 4.0
    values |= {name: torch.as_tensor(value, dtype=torch.float32) for name, value in params.items()}
    return Gaussians4D(values, torch.full((count,), dynamic), config)


def camera(shift=(0.0, 0, 0), turn=(0.0, 0, 0), width=64, height=48):
    viewmat = np.eye(4)
    viewmat[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    viewmat[:3, 3] = shift
    return Camera(viewmat, np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]), width, height)


def wall(view, spacing=1):
    """Gaussians on a slanted wall, one a pixel; and its depth."""
    grid = pixel_grid(view.width, view.height)
    depth = 1.0 + 0.004 * grid[..., 0]
    return view.unproject(grid[::spacing, ::spacing].reshape(-1, 2), depth[::spacing, ::spacing].ravel()), depth


@pytest.mark.parametrize("model", ["mean", "displacement", "affine"])
def test_a_still_scene_flows_as_its_depth_and_cameras_say(model):
    view, other = camera(), camera((0.05, -0.02, 0.04), (0.01, 0.03, -0.01))
    points, depth = wall(view)
    gaussians = make(points, scale=0.012)
    frame = render(gaussians, view, 0.0, flow_to=(other, 0.1), flow_model=model)
    flow = (frame.flow / frame.alpha[..., None]).numpy()
    error = np.linalg.norm(flow - camera_flow(depth, view, other), axis=-1)[6:-6, 6:-6]
    assert float(frame.alpha[6:-6, 6:-6].min()) > 0.9
    assert error.max() < 0.15
    assert np.median(error) < 0.05  # half transparent spheres on a slant show a little of what lies behind


def test_the_displacement_over_any_gap_and_the_velocity_over_a_small_one():
    view = camera()
    poly = torch.zeros(1, 2, 3)
    poly[0, 0], poly[0, 1] = torch.tensor([0.3, -0.1, 0.2]), torch.tensor([0.5, 0.4, 0.0])
    gaussians = make([[0.05, 0.02, 1.0]], scale=0.05, mean_poly=poly)
    for dt in (0.3, 0.01):
        moved = gaussians.motion.state(gaussians.params, dt).means[0].numpy()
        expected = view.project(moved)[0] - view.project(np.array([0.05, 0.02, 1.0]))[0]
        for model in ("displacement", "mean"):
            frame = render(gaussians, view, 0.0, flow_to=(view, dt), flow_model=model)
            y, x = np.unravel_index(frame.alpha.argmax(), frame.alpha.shape)
            flow = (frame.flow[y, x] / frame.alpha[y, x]).numpy()
            tolerance = 1e-3 if model == "displacement" else 0.05 if dt == 0.01 else np.inf
            assert np.abs(flow - expected).max() < tolerance, (model, dt)


def affine_case(angle: float):
    """One large rotating Gaussian and two cameras, float64."""
    view, other = camera((0.1, 0, 0), (0.02, -0.05, 0)), camera((0.13, 0.02, -0.05), (0.0, -0.02, 0.03))
    quats = torch.tensor([Rotation.from_rotvec([0.4, -0.3, 0.7]).as_quat(scalar_first=True)])
    turn = Rotation.from_rotvec(angle * np.array([0.36, 0.48, 0.8]))
    turned = turn * Rotation.from_quat(quats[0].numpy(), scalar_first=True)
    next_quats = torch.tensor([turned.as_quat(scalar_first=True)])
    means, scales = torch.tensor([[0.1, -0.05, 1.2], [0.02, 0.012, 0.006]], dtype=torch.float64).split(1)
    next_means = means + torch.tensor([[0.03, 0.01, -0.02]])
    sliced = Slice(means, quats, scales, None, torch.ones(1), torch.zeros(1, 3), torch.zeros(1, 3), next_means, next_quats)
    return sliced, view, other


@pytest.mark.parametrize("angle", [0.06, 0.5])
def test_affine_flow_matches_monte_carlo_of_a_rotating_gaussian(angle):
    sliced, view, other = affine_case(angle)
    viewmat, K = view.tensors(torch.float64)
    next_viewmat, next_K = other.tensors(torch.float64)
    B = affine_gradient(sliced, viewmat, K, next_viewmat, next_K, view.width, view.height)[0].numpy()
    rng = np.random.default_rng(0)
    R, R_next = (quats_to_rotations(q)[0].numpy() for q in (sliced.quats, sliced.next_quats))
    local = rng.normal(size=(400_000, 3)) * sliced.scales.numpy()
    first = view.project(sliced.means.numpy() + local @ R.T)[0]
    second = other.project(sliced.next_means.numpy() + local @ R_next.T)[0]
    # The rasterizer draws with a blur: what it shows at a pixel is the mean over points that the blur may have brought there.
    seen = first + rng.normal(size=first.shape) * np.sqrt(EPS2D)
    centered = seen - seen.mean(0)
    flow = second - first
    slope = np.linalg.solve(centered.T @ centered, centered.T @ (flow - flow.mean(0))).T
    np.testing.assert_allclose(B, slope, atol=0.012)
    assert np.abs(B).max() > 0.04


def test_affine_beats_mean_on_few_large_rotating_gaussians():
    """The paper says that splatting cannot render the rotational part; affine flow does (docs/method/flow.md, "Affine flow")."""
    config = ModelConfig(mean_poly=1, mean_fourier=0, quat_poly=1, quat_fourier=0, sh_degree=0)
    view, dt, spin = camera(), 0.04, np.array([0.0, 0.0, 6.0])
    rng = np.random.default_rng(1)
    offsets = rng.uniform(-0.25, 0.25, (8, 2))
    means = np.concatenate([offsets, np.full((8, 1), 1.0)], 1)
    # All turn together about the optical axis: v = spin x position, q' = spin q / 2.
    velocity = np.cross(spin, means - [0, 0, 1])
    rate = np.zeros((8, 1, 4))
    rate[:, 0, 3] = spin[2] / 2
    gaussians = make(
        means, config, 0.12, mean_poly=velocity[:, None], quat_poly=rate, logit_opacities=np.full(8, 6.0),
        log_scales=np.log(np.tile([[0.12, 0.12, 0.001]], (8, 1))),
    )  # fmt: skip
    pixels = pixel_grid(view.width, view.height) - [32, 24]
    angle = spin[2] * dt
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    truth = pixels @ turn.T - pixels
    errors = {}
    for model in ("mean", "displacement", "affine"):
        frame = render(gaussians, view, 0.0, flow_to=(view, dt), flow_model=model)
        covered = frame.alpha.numpy() > 0.8
        flow = (frame.flow / frame.alpha[..., None].clamp(min=1e-6)).numpy()
        errors[model] = np.linalg.norm(flow - truth, axis=-1)[covered].mean()
        assert covered.sum() > 300
    assert errors["affine"] < 0.35 * errors["mean"], errors
    assert errors["affine"] < 0.35 * errors["displacement"], errors


def test_a_gaussian_behind_the_other_camera_has_no_flow_but_is_reported():
    view, other = camera(), camera((0, 0, -2.0))
    frame = render(make([[0.0, 0, 1]], scale=0.2), view, 0.0, flow_to=(other, 0.1))
    assert float(frame.flow.abs().max()) == 0
    assert float(frame.image[..., 4 + frame.flow_channels].max()) > 0.5
    seen = render(make([[0.0, 0, 3]], scale=0.2), view, 0.0, flow_to=(other, 0.1))
    assert seen.image.shape[2] == 4 + seen.flow_channels


def test_flow_has_gradients_to_all_that_moves():
    view, other = camera(), camera((0.02, 0, 0))
    gaussians = make([[0.0, 0, 1], [0.1, 0.05, 1.1]], scale=0.1)
    active = gaussians.active(0.1)
    gradients = {}
    frame = render_active(gaussians, active, view, flow_to=(other, 0.3), flow_model="affine", gradients=gradients)
    frame.flow.sum().backward()
    for name in ("means", "mean_poly", "mean_cos", "mean_sin", "quat_poly", "log_scales", "logit_opacities"):
        assert torch.isfinite(gradients[name]).all(), name
        assert float(gradients[name].abs().max()) > 0, name


def feature_views(behind: bool) -> tuple[Camera, Camera]:
    """A camera, and another one that some Gaussians of ``feature_inputs`` may be behind."""
    return camera(), camera((0.05, -0.02, -1.0 if behind else 0.04), (0.01, 0.03, -0.01))


def feature_inputs(count: int = 60) -> dict[str, torch.Tensor]:
    """What features depend on, by name; random."""
    g = torch.Generator().manual_seed(0)
    depths = torch.rand(count, generator=g) + 0.7
    depths[:2] = 0.03  # nearer than where Jacobians are held
    means = torch.cat([0.6 * torch.randn(count, 2, generator=g), depths[:, None]], 1)  # some beyond the border
    inputs = {
        "colors": torch.rand(count, 3, generator=g), "depths": depths, "means2d": 30 * torch.rand(count, 2, generator=g),
        "means": means, "quats": torch.randn(count, 4, generator=g), "scales": 0.2 * torch.rand(count, 3, generator=g) + 0.01,
        "next_means": means + 0.1 * torch.randn(count, 3, generator=g), "next_quats": torch.randn(count, 4, generator=g),
    }  # fmt: skip
    inputs["next_means"][:2, 2] = 0.2
    return inputs


def slice_of(leaves: dict[str, torch.Tensor]) -> Slice:
    """The slice whose features these are."""
    return Slice(
        leaves["means"], leaves["quats"], leaves["scales"], None, leaves["depths"], leaves["colors"],
        leaves["next_means"][:0], leaves["next_means"], leaves["next_quats"],
    )  # fmt: skip


def assert_alike(name: str, ours: torch.Tensor, exact: torch.Tensor, tolerance: float) -> None:
    """Float64 tensors [N, ...]: every row to a thousandth of itself or of the largest's thousandth, the whole to ``tolerance``."""
    scale, error = (value.abs().reshape(len(exact), -1).sum(1) for value in (exact, ours - exact))
    assert float((error / (scale + 1e-3 * scale.max() + 1e-12)).max()) < 1e-3, name
    assert float((ours - exact).norm()) <= tolerance * float(exact.norm()), name


@pytest.mark.parametrize("behind", [False, True])
@pytest.mark.parametrize("model", ["displacement", "affine"])
def test_the_kernels_of_the_features_match_their_oracle(model, behind):
    view, other = feature_views(behind)
    inputs = feature_inputs()
    found = []
    for dtype in (torch.float64, torch.float32):
        leaves = {name: value.to(dtype).requires_grad_() for name, value in inputs.items()}
        sliced = slice_of(leaves)
        radii = torch.ones(len(leaves["depths"]), 2, dtype=torch.int32)
        projected = Projected(leaves["means2d"], leaves["means2d"], leaves["depths"], radii, None, "cpu")
        features = blend_features(sliced, projected, view, FlowView(model, other, 0.1))
        weights = torch.randn(len(features), 11, generator=torch.Generator().manual_seed(1)).to(dtype)
        (features * weights[:, : features.shape[1]]).sum().backward()
        gradients = [torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for leaf in leaves.values()]
        found.append([features.detach(), *gradients])
    assert found[0][0].shape[1] == {"displacement": 6, "affine": 10}[model] + behind
    for name, exact, ours in zip(["features", *inputs], *found, strict=True):
        assert_alike(name, ours.double(), exact, 5e-5)
    used = sum(float(exact.norm()) > 0 for exact in found[0])
    assert used == {"displacement": 5, "affine": 9}[model]


@pytest.mark.parametrize("changed", ["means2d", "means", "quats", "scales", "next_means", "next_quats", "colors", "depths"])
@pytest.mark.parametrize("model", ["displacement", "affine"])
def test_features_of_what_was_changed_in_place_have_no_wrong_gradient(model, changed):
    """It is that of what they were made of, or torch refuses it."""
    view, other = feature_views(False)
    found, refused = [], False
    for change in (False, True):
        leaves = {name: value.requires_grad_() for name, value in feature_inputs().items()}
        radii = torch.ones(len(leaves["depths"]), 2, dtype=torch.int32)
        projected = Projected(leaves["means2d"], leaves["means2d"], leaves["depths"], radii, None, "cpu")
        features = blend_features(slice_of(leaves), projected, view, FlowView(model, other, 0.1))
        if change:
            with torch.no_grad():
                leaves[changed].mul_(1.5)
        try:
            (features**2).sum().backward()
        except RuntimeError as error:
            refused = "inplace" in str(error)
        found.append([leaf.grad for leaf in leaves.values()])
    read_later = {"displacement": ["next_means"], "affine": ["means2d", "means", "quats", "scales", "next_means", "next_quats"]}
    assert refused == (changed in read_later[model])
    if not refused:
        for a, b in zip(*found, strict=True):
            assert (a is None and b is None) or torch.equal(a, b)


def test_flow_image_of_affine_features_is_linear_in_the_pixel():
    features = torch.zeros(4, 6, 6)
    features[..., 0], features[..., 3] = 1.0, 2.0
    flow = flow_image(features)
    assert flow[1, 2].tolist() == [1 + 2 * (1.5 - 2), 0]


def test_mean_flow_needs_no_second_slice():
    view, other = camera(), camera((0.02, 0, 0))
    sliced = Slice(torch.tensor([[0.0, 0, 1]]), None, None, None, torch.ones(1), torch.zeros(1, 3), torch.zeros(1, 3), None, None)
    projected = Projected(torch.tensor([[32.0, 24]]), torch.ones(1, 3), torch.ones(1), torch.ones(1, 2), None, "reference")
    flow, front = flow_features("mean", sliced, projected, 0.1, *view.tensors(), *other.tensors(), 64, 48)
    assert flow[0].tolist() == pytest.approx([1.2, 0.0], abs=1e-5)
    assert front.tolist() == [True]
