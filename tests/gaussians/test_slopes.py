"""Brightness that varies inside a Gaussian: against what a disc in space looks like, and the kernels against their oracle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from flowsplat.gaussians.density import DensityStatistics, densify
from flowsplat.gaussians.gaussians4d import Gaussians4D, parameter_shapes
from flowsplat.gaussians.model_config import ModelConfig
from flowsplat.gaussians.render import render, render_active
from flowsplat.gaussians.slicing import Slice
from flowsplat.gaussians.slopes import cpu, image_slopes, reference
from flowsplat.geometry import Camera
from flowsplat.geometry.rotations import quats_to_rotations
from flowsplat.splatting import blend, project
from flowsplat.splatting.rules import C0

WIDTH, HEIGHT = 80, 64
CAMERA = Camera(np.eye(4), np.array([[60.0, 0, 40], [0, 62, 32], [0, 0, 1]]), WIDTH, HEIGHT)


def random_slice(count: int, dtype: torch.dtype = torch.float64, seed: int = 0) -> dict[str, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=g, dtype=torch.float64)

    means = uniform(count, 3) * torch.tensor([2.4, 1.8, 2]) - torch.tensor([1.2, 0.9, -1.0])
    means[0] = torch.tensor([0.0, 0, -1])  # behind the camera
    values = {
        "means": means, "quats": torch.randn(count, 4, generator=g, dtype=torch.float64), "scales": 0.15 * uniform(count, 3) + 0.02,
        "opacities": 0.8 * uniform(count) + 0.1, "features": uniform(count, 6), "slopes": uniform(count, 2) - 0.5,
    }  # fmt: skip
    return {name: value.float().to(dtype) for name, value in values.items()}


def drawn(values, backend: str, slopes_of) -> tuple[torch.Tensor, torch.Tensor, dict[str, torch.Tensor]]:
    """The image, the slopes in it, and gradients of a fixed random functional of the image."""
    leaves = {name: value.detach().clone().requires_grad_() for name, value in values.items()}
    means, quats, scales, opacities, features, slopes = leaves.values()
    projected = project(means, quats, scales, opacities, *CAMERA.tensors(means.dtype, "cpu"), WIDTH, HEIGHT, backend=backend)
    sliced = Slice(means, quats, scales, None, opacities, features[:, :3], means, None, None, slopes)
    seen = slopes_of(sliced, projected, CAMERA)
    image, alpha = blend(projected, opacities, features, WIDTH, HEIGHT, slopes=seen)
    weights = torch.randn(HEIGHT, WIDTH, 7, generator=torch.Generator().manual_seed(1), dtype=torch.float64).to(image.dtype)
    ((image * weights[..., :6]).sum() + (alpha * weights[..., 6]).sum()).backward()
    return image.detach(), seen.detach(), {name: leaf.grad for name, leaf in leaves.items()}


def assert_alike(found: torch.Tensor, expected: torch.Tensor, tolerance: float) -> None:
    assert float((found.double() - expected).abs().max()) <= tolerance * float(expected.abs().max())


def test_kernels_give_the_values_and_gradients_of_the_oracle():
    expected = drawn(random_slice(80), "reference", reference.image_slopes)
    found = drawn(random_slice(80, torch.float32), "cpu", cpu.image_slopes)
    assert float(expected[1].abs().max()) > 0.1
    assert not found[1][0].any(), "what is behind the camera has none"
    for k in (0, 1):
        assert_alike(found[k], expected[k], 1e-5)
    for name, gradient in expected[2].items():
        assert_alike(found[2][name], gradient, 1e-4)


def test_gradients_of_the_oracle_are_those_of_small_changes():
    """Small changes of all but the slopes leave the map alone by which these become slopes in the image."""
    values = random_slice(4)
    g = torch.Generator().manual_seed(2)

    def project_all(given):
        means, quats, scales, opacities, *_ = given.values()
        return project(means, quats, scales, opacities, *CAMERA.tensors(torch.float64, "cpu"), WIDTH, HEIGHT)

    def total(given) -> torch.Tensor:
        *_, opacities, features, slopes = given.values()
        first, projected = project_all(values), project_all(given)
        means = values["means"]
        sliced = Slice(
            means, values["quats"], values["scales"], None, values["opacities"], features[:, :3], means, None, None, slopes
        )
        seen = reference.image_slopes(sliced, first, CAMERA)
        return (blend(projected, opacities, features, WIDTH, HEIGHT, slopes=seen)[0] ** 2).sum()

    leaves = {name: value.clone().requires_grad_() for name, value in values.items()}
    means, quats, scales, opacities, features, slopes = leaves.values()
    projected = project_all(leaves)
    sliced = Slice(means, quats, scales, None, opacities, features[:, :3], means, None, None, slopes)
    image, _ = blend(projected, opacities, features, WIDTH, HEIGHT, slopes=reference.image_slopes(sliced, projected, CAMERA))
    (image**2).sum().backward()
    for name, leaf in leaves.items():
        change = torch.randn(leaf.shape, generator=g, dtype=torch.float64)
        small = 1e-6
        sides = [float(total({**values, name: values[name] + sign * small * change})) for sign in (1, -1)]
        assert (sides[0] - sides[1]) / (2 * small) == pytest.approx(float((leaf.grad * change).sum()), rel=1e-4), name


@pytest.mark.parametrize("tilt", [0.0, 0.6])
def test_a_disc_is_as_bright_at_a_pixel_as_where_its_ray_meets_the_disc(tilt):
    """A disc far larger than a pixel, hardly thick: there blur and thickness count for nothing."""
    quat = torch.tensor([[np.cos(tilt / 2), np.sin(tilt / 2) * 0.6, np.sin(tilt / 2) * 0.8, 0.0]])
    scales, slope = torch.tensor([[0.11, 0.07, 1e-5]], dtype=torch.float64), torch.tensor([[0.3, -0.2]], dtype=torch.float64)
    mean, opacity = torch.tensor([[0.0, 0, 4]], dtype=torch.float64), torch.tensor([0.9], dtype=torch.float64)
    camera = Camera(np.eye(4), np.array([[900.0, 0, 40], [0, 900, 32], [0, 0, 1]]), WIDTH, HEIGHT)
    projected = project(mean, quat, scales, opacity, *camera.tensors(torch.float64, "cpu"), WIDTH, HEIGHT)
    sliced = Slice(mean, quat, scales, None, opacity, torch.zeros(1, 3), mean, None, None, slope)
    seen = reference.image_slopes(sliced, projected, camera)
    image, alpha = blend(projected, opacity, torch.full((1, 3), 0.5, dtype=torch.float64), WIDTH, HEIGHT, slopes=seen)
    R = quats_to_rotations(quat)[0]
    y, x = np.mgrid[26:39, 34:47]
    rays = torch.from_numpy(np.stack([(x + 0.5 - 40) / 900, (y + 0.5 - 32) / 900, np.ones(x.shape)], -1))
    hits = rays * ((mean[0] @ R[:, 2]) / (rays @ R[:, 2]))[..., None]
    u = ((hits - mean[0]) @ R)[..., :2] / scales[0, :2]
    expected = 0.5 + (u * slope[0]).sum(-1)
    brightness = (image / alpha[..., None])[26:39, 34:47]
    assert float((brightness - expected[..., None]).abs().max()) < 2e-3
    assert float(expected.max() - expected.min()) > 0.05


def small_model(slopes: bool, dtype: torch.dtype = torch.float32) -> Gaussians4D:
    config = ModelConfig(
        mean_poly=2, mean_fourier=0, quat_poly=1, quat_fourier=0, sh_degree=0, freeze_background=True, slopes=slopes
    )
    g = torch.Generator().manual_seed(3)
    params = {name: 0.3 * torch.randn(40, *shape, generator=g) for name, shape in parameter_shapes(config).items()}
    params["means"][:, 2] += 2
    params["log_scales"] -= 2.5
    params["logit_opacities"] += 2
    params["times"] = torch.full((40,), 0.5)
    return Gaussians4D({name: value.to(dtype) for name, value in params.items()}, torch.arange(40) >= 20, config)


def test_a_model_without_slopes_has_no_such_parameter_and_looks_as_one_with_slopes_of_zero():
    plain, sloped = small_model(False), small_model(True)
    assert "slopes" not in plain.params
    assert sloped.params["slopes"].shape == (40, 2)
    flat = sloped.without_slopes()
    assert not flat.config.slopes
    nothing = Gaussians4D({**sloped.params, "slopes": torch.zeros(40, 2)}, sloped.dynamic, sloped.config)
    images = [render(model, CAMERA, 0.4).color for model in (sloped, flat, nothing)]
    torch.testing.assert_close(images[1], images[2], rtol=0, atol=1e-6)
    assert float((images[0] - images[1]).abs().max()) > 0.05


def test_models_with_general_covariances_have_none():
    config = ModelConfig(kind="linear", slopes=True)
    assert "slopes" not in parameter_shapes(config)


def test_gradients_of_the_parameter_are_those_of_float64():
    found = []
    for dtype in (torch.float64, torch.float32):
        model = small_model(True, dtype)
        active = model.active(0.4, CAMERA)
        gradients: dict[str, torch.Tensor] = {}
        (render_active(model, active, CAMERA, gradients=gradients).image ** 2).sum().backward()
        assert gradients["slopes"].shape == (len(active.rows), 2)
        found.append(gradients)
    for name in ("slopes", "means", "log_scales", "quats"):
        assert_alike(found[1][name], found[0][name], 1e-3)


def test_an_object_at_another_distance_looks_the_same_from_the_clips_camera():
    sliced = Slice(**{
        **{name: value for name, value in random_slice(30).items() if name in ("means", "quats", "scales", "opacities", "slopes")},
        "covars": None, "colors": torch.zeros(30, 3), "velocities": torch.zeros(30, 3), "next_means": None, "next_quats": None,
    })  # fmt: skip
    farther = replace(sliced, means=1.5 * sliced.means, scales=1.5 * sliced.scales)
    seen = []
    for each in (sliced, farther):
        view = CAMERA.tensors(torch.float64, "cpu")
        projected = project(each.means, each.quats, each.scales, each.opacities, *view, WIDTH, HEIGHT)
        seen.append(image_slopes(each, projected, CAMERA))
    torch.testing.assert_close(seen[0], seen[1])


def test_what_does_not_fit_is_refused():
    values = random_slice(5, torch.float32)
    projected = project(*list(values.values())[:4], *CAMERA.tensors(), WIDTH, HEIGHT)
    with pytest.raises(ValueError, match="slopes must be"):
        blend(projected, values["opacities"], values["features"], WIDTH, HEIGHT, slopes=torch.zeros(5, 3))
    with pytest.raises(ValueError, match="slopes must be"):
        blend(projected, values["opacities"], values["features"][:, :2], WIDTH, HEIGHT, slopes=torch.zeros(5, 2))
    with pytest.raises(ValueError, match="absolute gradients"):
        blend(projected, values["opacities"], values["features"], WIDTH, HEIGHT, slopes=torch.zeros(5, 2), absgrad=True)


def test_triton_draws_what_the_cpu_draws():
    pytest.importorskip("triton", reason="Triton is not installed")
    device = "cuda" if torch.cuda.is_available() else "cpu"
    values = {name: value[:24] for name, value in random_slice(80, torch.float32).items()}
    expected = drawn(values, "cpu", cpu.image_slopes)
    found = drawn({name: value.to(device) for name, value in values.items()}, "triton", reference.image_slopes)
    differs = (found[0].cpu() - expected[0]).abs().amax(-1) > 1e-4
    assert float(differs.float().mean()) < 2e-3, "but where a Gaussian ends, which rounding decides"
    for name, gradient in expected[2].items():
        assert_alike(found[2][name].cpu(), gradient.double(), 1e-2)


def test_children_of_a_split_are_as_bright_as_their_parent_was_there():
    model = small_model(True).select(torch.arange(20))  # at rest
    statistics = DensityStatistics.zeros(20)
    statistics.visits[:], statistics.gradient[5] = 1, 1.0
    result = densify(model, statistics, 0.5, 0.0, 100, torch.Generator().manual_seed(0))
    children, parent = (
        result.gaussians.select(torch.nonzero(result.is_new).squeeze(1)).params,
        model.select(torch.tensor([5])).params,
    )
    assert len(children["means"]) == 2
    R, scales = quats_to_rotations(parent["quats"])[0], torch.exp(parent["log_scales"])
    u = (children["means"] - parent["means"]) @ R / scales
    brighter = (u[:, :2] * parent["slopes"]).sum(1, keepdim=True)
    assert float(brighter.abs().min()) > 1e-3
    torch.testing.assert_close(C0 * children["sh"][:, 0], C0 * parent["sh"][:, 0] + brighter, rtol=0, atol=1e-5)
    in_space = [values["slopes"] / torch.exp(values["log_scales"][:, :2]) for values in (children, parent)]
    torch.testing.assert_close(in_space[0], in_space[1].expand(2, 2))
