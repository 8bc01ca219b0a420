"""Samples along rays and what is seen, against closed forms; gradients in float64."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
import torch
from torch.autograd import gradcheck

from flowsplat_benchmarks.fields.deformation import move_by_screws
from flowsplat_benchmarks.fields.encoding import count_encoded, encode, weigh_octaves
from flowsplat_benchmarks.fields.volume import composite, place_importance, place_strata, render_rays


@pytest.mark.parametrize("stretch", [1.0, 1.7])
@pytest.mark.parametrize("density", [0.05, 1.0, 40.0])
def test_a_constant_medium_is_that_of_the_closed_form(density, stretch):
    near, far, color = 1.0, 3.0, torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64)
    depths = torch.linspace(near, far, 4001, dtype=torch.float64)[None, :-1]
    step = (far - near) / 4000
    seen = composite(
        torch.full_like(depths, density), color.expand(1, 4000, 3), depths, torch.tensor([stretch], dtype=torch.float64), step
    )
    per_depth = density * stretch
    alpha = 1 - math.exp(-per_depth * (far - near))
    torch.testing.assert_close(seen.alpha, torch.tensor([alpha], dtype=torch.float64))
    torch.testing.assert_close(seen.color[0], alpha * color)
    # Planar depth times alpha: the integral of z s exp(-s (z - near)).
    expected = near + 1 / per_depth - math.exp(-per_depth * (far - near)) * (far + 1 / per_depth)
    assert float(seen.depth[0]) == pytest.approx(expected, abs=step)


def test_behind_the_last_sample_all_is_opaque_and_in_float32_nothing_is_lost():
    depths = torch.tensor([[1.0, 2.0, 3.0]])
    seen = composite(torch.full((1, 3), 0.1), torch.ones(1, 3, 3), depths, torch.ones(1))
    shares = [1 - math.exp(-0.1), math.exp(-0.1) - math.exp(-0.2), math.exp(-0.2)]
    torch.testing.assert_close(seen.weights[0], torch.tensor(shares))


def test_gradients_of_what_is_seen():
    generator = torch.Generator().manual_seed(0)
    density = torch.rand((2, 5), generator=generator, dtype=torch.float64).requires_grad_()
    color = torch.rand((2, 5, 3), generator=generator, dtype=torch.float64).requires_grad_()
    depths = torch.linspace(1, 2, 5, dtype=torch.float64).expand(2, 5)
    stretch = torch.tensor([1.0, 1.3], dtype=torch.float64)

    def show(density, color):
        seen = composite(density, color, depths, stretch, 0.25)
        return seen.color, seen.alpha, seen.depth

    assert gradcheck(show, (density, color))


@pytest.mark.parametrize("size", [0.0, 1e-6, 1e-3, 1.0, 3.0])
def test_screws_are_matrix_exponentials_with_gradients(size):
    generator = torch.Generator().manual_seed(1)
    screws = torch.randn((4, 6), generator=generator, dtype=torch.float64)
    screws = torch.cat([size * screws[:, :3] / screws[:, :3].norm(dim=1, keepdim=True), screws[:, 3:]], 1)
    points = torch.randn((4, 3), generator=generator, dtype=torch.float64)
    for point, screw, moved in zip(points, screws, move_by_screws(points, screws), strict=True):
        x, y, z = screw[:3].tolist()
        twist = torch.zeros((4, 4), dtype=torch.float64)
        twist[:3, :3] = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
        twist[:3, 3] = screw[3:]
        expected = torch.linalg.matrix_exp(twist) @ torch.cat([point, torch.ones(1, dtype=torch.float64)])
        torch.testing.assert_close(moved, expected[:3], rtol=1e-9, atol=1e-9)
    if size != 1e-6:  # finite differences would step over the border of the series
        assert gradcheck(move_by_screws, (points.requires_grad_(), screws.detach().requires_grad_()))


def test_frequencies_come_in_one_after_the_other():
    assert weigh_octaves(4, 0.0).tolist() == [0, 0, 0, 0]
    assert weigh_octaves(4, 4.0).tolist() == [1, 1, 1, 1]
    weights = torch.stack([weigh_octaves(4, octaves) for octaves in torch.linspace(0, 4, 33).tolist()])
    assert (weights.diff(dim=0) >= 0).all()
    assert (weights.diff(dim=1) <= 0).all()
    assert weights[12].tolist() == [1.0, 0.5, 0.0, 0.0], "halfway through the second"
    values = torch.tensor([[0.3, -0.7]], dtype=torch.float64)
    encoded = encode(values, 3)
    assert encoded.shape == (1, count_encoded(2, 3))
    assert encoded[0, :2].tolist() == values[0].tolist()
    torch.testing.assert_close(encoded[0, 2:5], torch.sin(0.3 * torch.tensor([1.0, 2.0, 4.0], dtype=torch.float64)))
    torch.testing.assert_close(encode(values, 3, 3.0), encoded)
    annealed = encode(values, 3, 1.0)
    assert annealed[0, [3, 4, 6, 7]].tolist() == [0, 0, 0, 0]
    assert not encode(values, 3, 0.0, has_values=False).any()


def test_strata_have_one_sample_each():
    depths = place_strata(0.5, 20.0, 100, 16, torch.Generator().manual_seed(0))
    edges = 1 / torch.linspace(1 / 0.5, 1 / 20.0, 17)
    assert (depths >= edges[:-1] - 1e-5).all()
    assert (depths <= edges[1:] + 1e-5).all()
    even = place_strata(0.5, 20.0, 1, 16, None)
    torch.testing.assert_close(1 / even[0, 0], torch.tensor(2 - (2 - 0.05) / 32))


def test_importance_samples_lie_where_the_weights_are():
    depths = torch.linspace(1, 2, 21).expand(3, 21)
    weights = torch.zeros(3, 21)
    weights[0, 10] = 1.0
    weights[1, 4], weights[1, 15] = 0.75, 0.25
    found = place_importance(depths, weights, 200, torch.Generator().manual_seed(0))
    assert found.shape == (3, 221)
    assert (found.diff(dim=1) >= 0).all()
    assert ((found[0] >= 1.475) & (found[0] <= 1.525)).sum() >= 199
    share = ((found[1] >= 1.175) & (found[1] <= 1.225)).sum() / 200
    assert 0.7 < share < 0.8
    assert found[2].min() >= 1
    assert found[2].max() <= 2, "a ray that met nothing is sampled all along"


def test_a_ray_finds_a_wall():
    """A field of the closed form: nothing before a wall, everything behind it."""
    rays = SimpleNamespace(
        origins=torch.zeros(2, 3), directions=torch.tensor([[0.0, 0.0, 1.0], [0.5, 0.0, 1.0]]), times=torch.tensor([0.0, 1.0])
    )

    def ask(points, views, times, fine):
        torch.testing.assert_close(views.norm(dim=1), torch.ones(2))
        color = torch.stack([times, 1 - times, torch.zeros_like(times)], 1)[:, None].expand(*points.shape)
        return torch.where(points[..., 2] > 2.0, 1000.0, 0.0), color

    coarse, fine = render_rays(ask, rays, 1.0, 5.0, 32, 64)
    torch.testing.assert_close(fine.color, torch.tensor([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]))
    assert (fine.depth - 2).abs().max() < (coarse.depth - 2).abs().max() < 0.2
