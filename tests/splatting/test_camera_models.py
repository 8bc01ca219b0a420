"""Orthographic and fisheye cameras: against gsplat's torch reference, OpenCV, finite differences and the backends each other."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from flowsplat.geometry.rotations import covariances
from flowsplat.splatting import project, rasterization
from flowsplat.splatting.camera_models import CAMERA_MODELS, project_in_camera
from tests.splatting.test_gsplat_api import GRADIENTS, HEIGHT, WIDTH, functional, leaves_of, make, relative

COEFFICIENTS = torch.tensor([0.08, -0.03, 0.012, -0.004], dtype=torch.float64)


@pytest.fixture(scope="module")
def reference():
    pytest.importorskip("gsplat", reason="gsplat is not installed")
    from gsplat.cuda import _torch_impl

    return _torch_impl


def points_in_front(count: int = 50) -> torch.Tensor:
    g = torch.Generator().manual_seed(5)
    points = torch.randn(count, 3, generator=g, dtype=torch.float64)
    points[:, 2] = points[:, 2].abs() + 0.2
    points[0, :2] = 0  # on the axis
    return points


def seen_by(model: str) -> dict[str, torch.Tensor]:
    values = make(cameras=2, count=120)
    if model == "ortho":
        values["Ks"][:, :2, :2] /= 3
    return values


@pytest.mark.parametrize("model", ["ortho", "fisheye"])
def test_projection_is_that_of_gsplat(reference, model):
    values = seen_by(model)
    theirs, ours = leaves_of(values, torch.float64), leaves_of(values, torch.float64)
    covars = covariances(theirs["quats"], theirs["scales"])
    radii, means2d, depths, conics, compensations = reference._fully_fused_projection(
        theirs["means"], covars, theirs["viewmats"], theirs["Ks"], WIDTH, HEIGHT, calc_compensations=True, camera_model=model
    )
    _, _, meta = rasterization(
        **ours, width=WIDTH, height=HEIGHT, packed=False, rasterize_mode="antialiased", camera_model=model, backend="reference"
    )
    visible = (meta["radii"] > 0).all(-1)
    assert int(visible.sum()) > 60
    assert bool((radii[visible] > 0).all())
    expected = [x[visible] for x in (means2d, depths, conics, theirs["opacities"] * compensations)]
    found = [meta[name][visible] for name in ("means2d", "depths", "conics", "opacities")]
    for a, b in zip(found, expected, strict=True):
        assert relative(a, b) < 1e-5
    functional(*expected).backward()
    functional(*found).backward()
    for name in ("means", "quats", "scales", "opacities", "viewmats", "Ks"):
        assert relative(ours[name].grad, theirs[name].grad) < 1e-4, name


@pytest.mark.parametrize("coefficients", [None, COEFFICIENTS])
@pytest.mark.parametrize("model", ["ortho", "fisheye"])
@pytest.mark.parametrize("packed", [True, False])
def test_kernels_blend_what_the_oracle_does(model, coefficients, packed):
    if coefficients is not None and model == "ortho":
        pytest.skip("only a fisheye has coefficients")
    results = []
    for dtype, backend in ((torch.float64, "reference"), (torch.float32, "cpu")):
        leaves = leaves_of(seen_by(model), dtype)
        extra = {} if coefficients is None else {"radial_coeffs": coefficients.to(dtype).expand(2, 4).clone().requires_grad_()}
        images, alphas, _ = rasterization(
            **leaves, **extra, width=WIDTH, height=HEIGHT, camera_model=model, render_mode="RGB+ED", packed=packed, backend=backend
        )
        functional(images, alphas).backward()
        results.append((images, {name: leaf.grad for name, leaf in {**leaves, **extra}.items()}))
    (expected, expected_gradients), (found, found_gradients) = results
    assert float(expected.detach().abs().amax()) > 0.1
    assert relative(found, expected) < 2e-5
    for name in (*GRADIENTS, *({"radial_coeffs"} & set(expected_gradients))):
        assert relative(found_gradients[name], expected_gradients[name]) < 2e-4, name


@pytest.mark.parametrize("model", CAMERA_MODELS)
def test_the_jacobian_is_the_derivative(model):
    points, K = points_in_front(), torch.tensor([[30.0, 0, 20], [0, 32, 13], [0, 0, 1]], dtype=torch.float64)
    points[:, :2] *= 0.2 * points[:, 2:]  # a pinhole's is clamped beyond the border
    points[:5, :2] *= torch.tensor([1e-3, 1e-5, 1e-8, 0, 1])[:, None]  # near the axis, and on it
    coefficients = COEFFICIENTS if model == "fisheye" else None

    def show(points: torch.Tensor) -> torch.Tensor:
        return project_in_camera(points, K, WIDTH, HEIGHT, model, coefficients)[0]

    _, J, shows = project_in_camera(points, K, WIDTH, HEIGHT, model, coefficients)
    assert bool(shows.all())
    step = 1e-5 * torch.eye(3, dtype=torch.float64)
    expected = torch.stack([(show(points + d) - show(points - d)) / 2e-5 for d in step], -1)
    torch.testing.assert_close(J, expected, rtol=1e-5, atol=1e-5)


def test_a_fisheye_on_its_axis_has_finite_gradients():
    points = torch.tensor([[0.0, 0, 2], [1e-9, 0, 1], [0, 1e-7, 3]], dtype=torch.float64, requires_grad=True)
    K = torch.tensor([[30.0, 0, 20], [0, 32, 13], [0, 0, 1]], dtype=torch.float64)
    pixels, J, _ = project_in_camera(points, K, WIDTH, HEIGHT, "fisheye", COEFFICIENTS)
    assert torch.allclose(J[0], torch.tensor([[15.0, 0, 0], [0, 16, 0]], dtype=torch.float64))
    (pixels.sum() + J.sum()).backward()
    assert bool(torch.isfinite(points.grad).all())


def test_a_fisheye_bends_as_that_of_opencv():
    points = points_in_front().numpy()
    K = np.array([[30.0, 0, 20], [0, 32, 13], [0, 0, 1]])
    shown, _ = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), K, COEFFICIENTS.numpy())
    found, _, shows = project_in_camera(torch.from_numpy(points), torch.from_numpy(K), WIDTH, HEIGHT, "fisheye", COEFFICIENTS)
    np.testing.assert_allclose(found[shows].numpy(), shown[:, 0][shows.numpy()], atol=1e-6)
    assert int(shows.sum()) > 40


@pytest.mark.parametrize(
    ("coefficients", "angles", "visible"),
    [
        # theta (1 - theta^2 / 2) falls beyond 46.8 degrees.
        ([-0.5, 0, 0, 0], [0.3, 0.7, 0.9, 1.2], [True, True, False, False]),
        # This one falls between .95 and 1.22 and rises again, over what is there already.
        ([-0.6, 0.15, 0, 0], [0.3, 0.8, 1.0, 1.3], [True, True, False, False]),
        ([0.1, 0.01, 0, 0], [0.3, 0.8, 1.0, 1.3], [True, True, True, True]),
    ],
)
def test_what_a_lens_folds_back_is_culled(coefficients, angles, visible):
    theta = torch.tensor(angles)
    means = torch.stack([torch.sin(theta), torch.zeros(4), torch.cos(theta)], 1)
    K = torch.tensor([[12.0, 0, 20], [0, 12, 13], [0, 0, 1]])
    projected = project(
        means, torch.tensor([[1.0, 0, 0, 0]]).expand(4, 4), torch.full((4, 3), 0.01), torch.ones(4), torch.eye(4), K, WIDTH, HEIGHT,
        camera_model="fisheye", radial_coeffs=torch.tensor(coefficients),
    )  # fmt: skip
    assert projected.visible.tolist() == visible


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"camera_model": "ftheta"}, "camera_model"),
        ({"camera_model": "ortho", "radial_coeffs": torch.zeros(2, 4)}, "radial_coeffs"),
        ({"camera_model": "fisheye", "radial_coeffs": torch.zeros(2, 6)}, "radial_coeffs"),
        ({"camera_model": "fisheye", "radial_coeffs": torch.full((2, 4), torch.nan)}, "radial_coeffs"),
    ],
)
def test_what_is_not_covered_is_named(change, named):
    values = {name: value.float() for name, value in make().items()}
    with pytest.raises(ValueError, match=named):
        rasterization(**values, width=WIDTH, height=HEIGHT, **change)


def test_project_names_what_is_wrong():
    values = {name: value.float() for name, value in make(cameras=1).items()}
    geometry = [values[name] for name in ("means", "quats", "scales", "opacities")]
    camera = values["viewmats"][0], values["Ks"][0], WIDTH, HEIGHT
    with pytest.raises(ValueError, match="camera_model must be one of pinhole, ortho, fisheye, not 'ftheta'"):
        project(*geometry, *camera, camera_model="ftheta")
    with pytest.raises(ValueError, match="radial_coeffs"):
        project(*geometry, *camera, radial_coeffs=torch.zeros(4))
