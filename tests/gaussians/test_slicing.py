"""The slicing kernel against its oracle: values and gradients."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from flowsplat.gaussians.gaussians4d import Gaussians4D, parameter_shapes
from flowsplat.gaussians.model_config import ModelConfig
from flowsplat.gaussians.slicing import cpu, reference

OUTPUTS = ("means", "quats", "scales", "opacities", "colors", "velocities", "next_means", "next_quats")


def random_model(config: ModelConfig, count: int = 40) -> Gaussians4D:
    g = torch.Generator().manual_seed(0)
    params = {name: 0.5 * torch.randn(count, *shape, generator=g) for name, shape in parameter_shapes(config).items()}
    params["times"] = torch.rand(count, generator=g)
    return Gaussians4D(params, torch.rand(count, generator=g) < 0.5, config)


BASE = ModelConfig(gains=5, freeze_background=True)


CASES = [
    (BASE, 3, 0.7),
    (replace(BASE, sh_degree=2), 2, None),
    (replace(BASE, sh_degree=3, mean_poly=2, mean_fourier=1, quat_poly=1, quat_fourier=0, fourier_base=3.0), 1, 0.1),
    (replace(BASE, gains=0, freeze_background=False), 0, 0.7),
    (replace(BASE, move_means=False), 1, 0.7),
    (replace(BASE, move_quats=False), 0, None),
]
"""A model, its degree of harmonics in use, and the time of the other frame."""


@pytest.mark.parametrize(("config", "degree", "next_time"), CASES)
def test_the_kernel_matches_its_oracle(config, degree, next_time):
    gaussians = random_model(config)
    active = gaussians.active(0.4)
    gaussians.sh_degree = degree
    exact = Gaussians4D({name: v.double() for name, v in gaussians.params.items()}, gaussians.dynamic, config, degree)
    results = []
    for module, model in ((reference, exact), (cpu, gaussians)):
        dtype = model.params["means"].dtype
        gradients = {}
        center = torch.tensor([0.1, 0.2, -3.0], dtype=dtype)
        sliced = module.slice_gaussians(model, active, center, next_time, gradients)
        g = torch.Generator().manual_seed(1)
        total = torch.zeros((), dtype=dtype)
        values = {}
        for name in OUTPUTS:
            value = getattr(sliced, name)
            if value is not None:
                values[name] = value
                total = total + (value * torch.randn(value.shape, generator=g, dtype=torch.float64).to(dtype)).sum()
        total.backward()
        results.append((values, gradients))
    (expected, expected_gradients), (found, found_gradients) = results
    assert set(found) == set(expected)
    for name, value in expected.items():
        torch.testing.assert_close(found[name].double(), value, atol=2e-5, rtol=2e-5, msg=name)
    for name, gradient in expected_gradients.items():
        torch.testing.assert_close(found_gradients[name].double(), gradient, atol=2e-4, rtol=2e-4, msg=name)


def test_nothing_moving_and_nothing_resting():
    for dynamic in (True, False):
        gaussians = random_model(BASE)
        gaussians.dynamic[:] = dynamic
        active = gaussians.active(0.5)
        gradients = {}
        sliced = cpu.slice_gaussians(gaussians, active, torch.zeros(3), 0.6, gradients)
        sliced.colors.sum().backward()
        assert len(sliced.velocities) == (len(active.rows) if dynamic else 0)
        assert {name: len(g) for name, g in gradients.items()} == {
            name: len(gaussians.rows_of(name, active)) for name in gaussians.params
        }


def test_without_gradients_nothing_is_kept_for_a_backward_pass():
    gaussians = random_model(BASE)
    active = gaussians.active(0.5)
    for module in (cpu, reference):
        sliced = module.slice_gaussians(gaussians, active, torch.zeros(3), None, None)
        assert not sliced.means.requires_grad


@pytest.mark.parametrize("changed", ["means", "quats", "sh", "mean_poly", "log_gains", "of the slice"])
def test_what_was_changed_in_place_has_no_gradient(changed):
    """The kernel reads it again: others than were sliced would give a wrong one."""
    gaussians = random_model(BASE)
    gaussians.sh_degree = 2
    sliced = cpu.slice_gaussians(gaussians, gaussians.active(0.5), torch.zeros(3), 0.6, {})
    with torch.no_grad():
        (sliced.means if changed == "of the slice" else gaussians.params[changed]).mul_(1.5)
    with pytest.raises(RuntimeError, match=r"modified by an inplace operation"):
        sliced.colors.sum().backward()
