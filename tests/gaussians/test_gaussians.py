"""Culling in time, gathering, gains, density control and the scene model."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from flowsplat.gaussians.culling import cpu as culling_cpu
from flowsplat.gaussians.culling import reference as culling_reference
from flowsplat.gaussians.density import DensityStatistics, densify, prune, reset_opacities, revise_dynamic
from flowsplat.gaussians.gaussians4d import Gaussians4D, concatenate, parameter_shapes
from flowsplat.gaussians.model import SceneModel
from flowsplat.gaussians.model_config import ModelConfig
from flowsplat.gaussians.render import fill_uncovered, render, render_active
from flowsplat.gaussians.slicing.reference import time_gains
from flowsplat.geometry import Camera, Similarity
from flowsplat.splatting.rules import ALPHA_MIN, EPS2D

FROZEN = ModelConfig(mean_poly=2, mean_fourier=1, quat_poly=1, quat_fourier=1, sh_degree=1, gains=4, freeze_background=True)


def random_model(count=12, config=FROZEN, seed=0):
    g = torch.Generator().manual_seed(seed)
    params = {name: 0.2 * torch.randn(count, *shape, generator=g) for name, shape in parameter_shapes(config).items()}
    params["means"][:, 2] += 2
    params["times"] = torch.linspace(0, 1, count)
    if "log_lambdas" in params:
        params["log_lambdas"][:] = math.log(40.0)
    object_ids = torch.where(torch.arange(count) % 2 == 0, torch.arange(count) // 2 % 3 + 1, 0).to(torch.uint8)
    return Gaussians4D(params, torch.arange(count) % 2 == 0, config, object_ids=object_ids)


def test_culling_in_time_keeps_background_and_the_present():
    gaussians = random_model()
    active = gaussians.active(0.3)
    resting, moving = active.rows[: active.num_static], active.rows[active.num_static :]
    assert not gaussians.dynamic[resting].any()
    assert active.num_static == 6
    p = gaussians.presence(0.3)
    expected = [i for i in range(12) if gaussians.dynamic[i] and p[i] >= 0.05]
    assert moving.tolist() == expected
    assert 0 < len(expected) < 6


def test_culling_against_the_camera_changes_no_image():
    gaussians = random_model(400)
    g = torch.Generator().manual_seed(3)
    gaussians.params["means"] = 3 * torch.randn(400, 3, generator=g)
    gaussians.params["log_scales"] = torch.randn(400, 3, generator=g) - 3
    view = Camera(np.eye(4), np.array([[40.0, 0, 20], [0, 40, 15], [0, 0, 1]]), 40, 30)
    culled = render(gaussians, view, 0.25)
    everything = gaussians.active(0.25)
    whole = render_active(gaussians, everything, view)
    assert len(culled.sliced.means) < 0.7 * len(everything.rows)
    assert culled.projected.visible.sum() == whole.projected.visible.sum()
    assert torch.equal(culled.color, whole.color)
    assert torch.equal(culled.depth, whole.depth)


def test_culling_reckons_with_more_than_is_drawn():
    assert -2 * math.log(ALPHA_MIN) < culling_reference.CULL_SIGMAS**2
    assert culling_reference.BLUR_SIGMA**2 > EPS2D


def test_gathered_rows_are_those_of_the_parameters():
    gaussians = random_model()
    active = gaussians.active(0.5)
    leaves = gaussians.gather(active)
    for name, value in leaves.items():
        assert torch.equal(value, gaussians.params[name][gaussians.rows_of(name, active)]), name
    assert len(leaves["mean_poly"]) == len(active.rows) - active.num_static
    assert len(leaves["log_gains"]) == active.num_static
    leaves["means"][:] = 0
    assert float(gaussians.params["means"].abs().min()) > 0  # copies


def test_a_model_with_wrong_parameters_is_refused():
    gaussians = random_model()
    with pytest.raises(ValueError, match="do not fit"):
        Gaussians4D({"means": torch.zeros(3, 3)}, torch.zeros(3, dtype=torch.bool), FROZEN)
    with pytest.raises(ValueError, match="quats must be"):
        Gaussians4D({**gaussians.params, "quats": torch.zeros(12, 3)}, gaussians.dynamic, FROZEN)
    with pytest.raises(ValueError, match="object_ids"):
        Gaussians4D(gaussians.params, gaussians.dynamic, FROZEN, object_ids=torch.zeros(3, dtype=torch.uint8))


def test_gains_change_the_brightness_of_the_background_only():
    gaussians = random_model()
    gaussians.params["log_gains"][:] = 0
    view = Camera(np.eye(4), np.array([[40.0, 0, 20], [0, 40, 15], [0, 0, 1]]), 40, 30)
    plain = render(gaussians, view, 0.25)
    gaussians.params["log_gains"][:, 0] = 0.3
    bright = render(gaussians, view, 0.25)
    active = gaussians.active(0.25)
    n = active.num_static
    torch.testing.assert_close(bright.sliced.colors[:n], plain.sliced.colors[:n] * math.exp(0.3 * math.cos(math.pi * 0.25)))
    assert torch.equal(bright.sliced.colors[n:], plain.sliced.colors[n:])
    assert float(time_gains(torch.zeros(3, 4), 0.7).sub(1).abs().max()) == 0


@pytest.mark.parametrize("config", [FROZEN, ModelConfig(), ModelConfig(move_means=False, move_quats=False)])
def test_density_control_keeps_parents_and_makes_children(config):
    gaussians = random_model(20, config)
    if "log_scales" in gaussians.params:
        gaussians.params["log_scales"][:10], gaussians.params["log_scales"][10:] = math.log(0.001), math.log(0.1)
    statistics = DensityStatistics.zeros(20)
    statistics.visits[:] = 2
    statistics.gradient[[1, 2, 15]] = 1.0
    result = densify(gaussians, statistics, 0.1, 0.01, 1000, torch.Generator().manual_seed(0))
    survivors = ~result.is_new
    assert len(result.gaussians) == len(result.index)
    for name, value in gaussians.params.items():
        assert torch.equal(result.gaussians.params[name][survivors], value[result.index[survivors]]), name
    assert torch.equal(result.gaussians.dynamic, gaussians.dynamic[result.index])
    assert torch.equal(result.gaussians.object_ids, gaussians.object_ids[result.index]), (
        "children belong to whom their parents belong"
    )
    children = result.index[result.is_new].tolist()
    if "log_scales" in gaussians.params:
        assert sorted(children) == [1, 2, 15, 15]  # two clones; one split into two, its parent gone
        assert 15 not in result.index[survivors].tolist()
        halves = result.gaussians.params["log_scales"][result.is_new][-2:]
        torch.testing.assert_close(halves, torch.full((2, 3), math.log(0.1 / 1.6)))
    capped = densify(gaussians, statistics, 0.1, 0.01, 21, torch.Generator().manual_seed(0))
    assert len(capped.gaussians) <= 21


def test_pruning_removes_the_transparent_the_broken_and_the_never_seen():
    gaussians = random_model(12)
    gaussians.params["logit_opacities"][:] = 2.0
    gaussians.params["logit_opacities"][1] = -9.0
    gaussians.params["means"][3] = float("nan")
    gaussians.params["times"][4] = 3.0  # dynamic, long after the clip
    gaussians.params["times"][5] = 3.0  # background: its time does not matter
    gaussians.params["times"][6], gaussians.params["log_lambdas"][6] = 0.123, 20.0  # between two frames
    times = np.linspace(0, 1, 6)
    result = prune(gaussians, times, 0.005, 0.0)
    assert sorted(set(range(12)) - set(result.index.tolist())) == [1, 3, 4, 6]
    assert not result.is_new.any()
    again = prune(result.gaussians, times, 0.005, 0.0)
    assert again.gaussians is result.gaussians, "where none is removed, nothing is copied"
    assert again.index.tolist() == list(range(8))


def test_opacity_reset():
    gaussians = random_model()
    gaussians.params["logit_opacities"][:] = torch.linspace(-9, 9, 12)
    reset_opacities(gaussians, 0.01)
    assert float(torch.sigmoid(gaussians.params["logit_opacities"]).max()) == pytest.approx(0.01, rel=1e-4)


def test_background_that_moves_becomes_dynamic_and_the_resting_comes_to_rest():
    gaussians = random_model(12)
    for name, parameter in gaussians.motion.parameters.items():
        if parameter.rate == "motion":
            gaussians.params[name][:] = 0
    gaussians.params["mean_poly"][0, 0] = torch.tensor([1.0, 0, 0])
    statistics = DensityStatistics.zeros(12)
    statistics.flow_visits[:] = 3
    statistics.flow_residual[[1, 3]] = 3 * 5.0
    statistics.flow_residual[5], statistics.flow_visits[5] = 50.0, 1  # seen once only
    statistics.flow_residual[7] = 3 * 5.0  # it has the right color
    statistics.color_residual[[1, 3, 5]] = 3 * 0.1
    moved, rested = revise_dynamic(gaussians, statistics, 1.5, 0.05, 0.5, 100.0, 6.0)
    assert (moved, rested) == (2, 5)  # dynamic 2, 4, 6, 8 and 10 do not move; 0 does
    assert gaussians.dynamic.tolist() == [k in (0, 1, 3) for k in range(12)]
    assert gaussians.params["log_lambdas"][[1, 3]].tolist() == [6.0, 6.0]


def test_linear_background_that_moves_becomes_dynamic_too():
    config = ModelConfig(move_means=False, move_quats=False, freeze_background=True)
    shapes, g = parameter_shapes(config), torch.Generator().manual_seed(0)
    params = {name: torch.randn(4, *shape, generator=g) for name, shape in shapes.items()}
    gaussians = Gaussians4D(params, torch.zeros(4, dtype=torch.bool), config)
    still = gaussians.motion.state(gaussians.params, 0.0).covars
    statistics = DensityStatistics.zeros(4)
    statistics.flow_visits[:] = 3
    statistics.flow_residual[[1, 3]] = 3 * 5.0
    assert revise_dynamic(gaussians, statistics, 1.5, 0.0, 0.5, 100.0, 6.0) == (2, 0)
    precision = gaussians.motion.log_precision(gaussians.params)
    torch.testing.assert_close(precision[[1, 3]], torch.full((2,), 6.0), rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(gaussians.motion.state(gaussians.params, 0.0).covars, still, rtol=1e-2, atol=1e-3)


def test_concatenating_and_selecting():
    a, b = random_model(3), random_model(4, seed=1)
    both = concatenate([a, b])
    assert len(both) == 7
    again = both.select(torch.arange(3, 7))
    assert all(torch.equal(again.params[name], b.params[name]) for name in b.params)
    assert torch.equal(again.object_ids, b.object_ids)
    assert both.object_counts == {1: 2, 2: 2}


def test_without_numbers_all_belong_to_none():
    gaussians = random_model()
    plain = Gaussians4D(gaussians.params, gaussians.dynamic, FROZEN)
    assert plain.object_ids.tolist() == [0] * 12
    assert plain.object_ids.dtype == torch.uint8
    assert plain.object_counts == {}


def test_filling_spreads_color_into_holes_and_leaves_the_covered_alone():
    color, alpha = np.full((32, 48, 3), 0.5, np.float32), np.ones((32, 48), np.float32)
    alpha[:, 30:], color[:, 30:] = 0, 0
    filled = fill_uncovered(color, alpha)
    assert np.abs(filled[:, :30] - 0.5).max() < 1e-6
    assert np.abs(filled[:, 32:] - 0.5).max() < 0.02
    assert fill_uncovered(color * 0 + 0.3, np.ones((32, 48), np.float32)).max() == pytest.approx(0.3)


def test_filling_does_not_brighten_dark_surfaces_that_the_background_shows_through():
    color, alpha = np.full((32, 48, 3), 0.5, np.float32), np.ones((32, 48), np.float32)
    alpha[:, 8:10], color[:, 8:10] = 0.55, 0.02  # what training makes of something black
    alpha[:, 30:], color[:, 30:] = 0, 0
    filled = fill_uncovered(color, alpha)
    np.testing.assert_array_equal(filled[:, 8:10], color[:, 8:10])
    assert filled[:, 32:].min() > 0.4


def test_the_scene_model_hides_the_normalization():
    gaussians = random_model()
    camera = Camera(np.eye(4), np.array([[40.0, 0, 20], [0, 40, 15], [0, 0, 1]]), 40, 30)
    similarity = Similarity(0.25, np.eye(3), np.array([0.1, 0, 0]))
    outside = similarity.inverse().camera(camera)
    plain = SceneModel(gaussians, Similarity(), 0.0, 1.0).render(camera, 0.5, (camera, 0.6))
    scaled = SceneModel(gaussians, similarity, 10.0, 14.0).render(outside, 12.0, (outside, 12.4))
    np.testing.assert_allclose(scaled.color, plain.color, atol=1e-4)
    np.testing.assert_allclose(scaled.flow, plain.flow, atol=1e-2)
    np.testing.assert_allclose(scaled.depth, 4 * plain.depth, atol=1e-3)
    assert SceneModel(gaussians, similarity, 10.0, 14.0).active_count(12.0) == len(gaussians.active(0.5).rows)


def test_finer_pixels_show_the_same_image():
    """Every third pixel of an image three times as fine is a pixel of the image that training knows."""
    generator = torch.Generator().manual_seed(4)
    count = 900  # many of them beyond the border
    params = {name: torch.zeros(count, *shape) for name, shape in parameter_shapes(FROZEN).items()}
    grid = torch.stack(torch.meshgrid(torch.arange(30.0), torch.arange(30.0), indexing="xy"), -1).reshape(-1, 2)
    grid += 0.4 * torch.rand(grid.shape, generator=generator)  # so that some only just reach into the image
    params["means"] = torch.cat([(grid - 14.5) * 1.5 / 40, torch.ones(count, 1)], 1)  # one in 1.5 pixels
    params["quats"][:, 0] = 1
    params["log_scales"][:] = math.log(0.3 / 40)
    params["logit_opacities"][:] = 3
    params["sh"][:, 0] = torch.randn(count, 3, generator=generator)
    gaussians = Gaussians4D(params, torch.zeros(count, dtype=torch.bool), FROZEN)
    model = SceneModel(gaussians, Similarity(), 0.0, 1.0, fill=False, focal=40.0)
    camera = Camera(np.eye(4), np.array([[40.0, 0, 12], [0, 40, 12], [0, 0, 1]]), 24, 24)
    fine = camera.resize(72, 72)
    known, seen = model.render(camera, 0.5), model.render(fine, 0.5)
    np.testing.assert_allclose(seen.color[1::3, 1::3], known.color, atol=2e-3)
    np.testing.assert_allclose(seen.alpha[1::3, 1::3], known.alpha, atol=2e-3)
    # The cull knows how far the blur reaches: with a camera nothing is missing that is there without one.
    eps2d, everything = model.blur(fine), gaussians.active(0.5)
    whole = render_active(gaussians, everything, fine, eps2d=eps2d)
    assert len(gaussians.active(0.5, fine, eps2d=eps2d).rows) < len(everything.rows)
    assert torch.equal(render(gaussians, fine, 0.5, eps2d=eps2d).image, whole.image)
    model.focal = 0.0
    assert np.abs(model.render(fine, 0.5).alpha[1::3, 1::3] - known.alpha).max() > 0.2  # gaps between the Gaussians


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_culling_matches_its_oracle(dtype):
    gaussians = random_model(4000)
    g = torch.Generator().manual_seed(3)
    gaussians.params["means"] = 3 * torch.randn(4000, 3, generator=g)
    gaussians.params["log_scales"] = torch.randn(4000, 3, generator=g) - 3
    view = Camera(np.eye(4), np.array([[40.0, 0, 20], [0, 40, 15], [0, 0, 1]]), 40, 30)
    names = ("means", "log_scales", "times", "log_lambdas")
    arguments = [gaussians.at_rest, *(gaussians.params[name].to(dtype) for name in names), 0.25, 0.05, view, 0.02]
    found, expected = culling_cpu.active_rows(*arguments), culling_reference.active_rows(*arguments)
    assert found[1] == expected[1]
    assert torch.equal(found[0], expected[0])
