"""Motion models: derivatives, recentering, and the linear model against the conditional of a 4D normal distribution."""

from __future__ import annotations

import math

import pytest
import torch

from flowsplat.gaussians.gaussians4d import Active, Gaussians4D, parameter_shapes
from flowsplat.gaussians.model_config import ModelConfig
from flowsplat.gaussians.motion import (
    LinearMotion,
    MotionModel,
    Parameter,
    SeriesMotion,
    SharedMotion,
    covariances_4d,
    motion_model,
    presence,
)
from flowsplat.gaussians.motion.bases import BasesMotion
from flowsplat.gaussians.motion.deformation import DeformationMotion
from flowsplat.gaussians.motion.hexplane import HexplaneMotion
from flowsplat.gaussians.motion.knots import cubic_weights, fit_knots, linear_weights
from flowsplat.gaussians.motion.marbles import MarbleMotion
from flowsplat.gaussians.motion.splines import SplineMotion
from flowsplat.gaussians.slicing.reference import slice_gaussians
from tests.gaussians.balls import Balls


def random_params(motion, count=7, seed=0):
    g = torch.Generator().manual_seed(seed)
    shapes = {"means": (3,), "times": (), **{name: parameter.shape for name, parameter in motion.parameters.items()}}
    return {name: 0.5 * torch.randn(count, *shape, generator=g, dtype=torch.float64) for name, shape in shapes.items()}


def bind_random(motion: SharedMotion) -> SharedMotion:
    """With other values than those with which nothing moves."""
    g = torch.Generator().manual_seed(1)
    shared = {name: value.double() for name, value in motion.initial_shared().items()}
    return motion.bind({name: value + 0.5 * torch.randn(value.shape, generator=g).double() for name, value in shared.items()})


SHARING = [
    bind_random(motion)
    for motion in (
        BasesMotion(5, 3), DeformationMotion(layers=2, width=5, place_octaves=3, time_octaves=4),
        HexplaneMotion(4, resolutions=(3, 4), features=2, width=5),
    )
]  # fmt: skip
MOTIONS: list[MotionModel] = [
    SeriesMotion(), SeriesMotion(2, 1, 1, 0, 3.0), SeriesMotion(1, 0, 0, 0), LinearMotion(), Balls(), SplineMotion(6),
    MarbleMotion(5), *SHARING,
]  # fmt: skip
UNKNOWN = Parameter((), "motion")


@pytest.mark.parametrize("motion", MOTIONS)
def test_the_velocity_is_the_derivative_of_the_mean(motion):
    params, h = random_params(motion), 1e-5
    before, after = motion.state(params, 0.3 - h), motion.state(params, 0.3 + h)
    torch.testing.assert_close(motion.state(params, 0.3).velocities, (after.means - before.means) / (2 * h), atol=1e-7, rtol=1e-6)


def test_at_its_own_time_a_gaussian_is_where_its_mean_says():
    motion = SeriesMotion()
    params = random_params(motion)
    params["times"][:] = 0.4
    state = motion.state(params, 0.4)
    torch.testing.assert_close(state.means, params["means"])
    torch.testing.assert_close(state.quats, params["quats"])
    torch.testing.assert_close(state.presence, torch.ones(7, dtype=torch.float64))


@pytest.mark.parametrize("motion", MOTIONS)
def test_recentering_does_not_change_the_motion(motion):
    params = random_params(motion)
    shift = torch.linspace(-0.5, 0.5, 7, dtype=torch.float64)
    moved = motion.recenter(params, shift)
    torch.testing.assert_close(moved["times"], params["times"] + shift)
    for t in (-0.2, 0.3, 0.9):
        a, b = motion.state(params, t), motion.state(moved, t)
        for name in ("means", "velocities", "quats", "covars"):
            if getattr(a, name) is not None:
                torch.testing.assert_close(getattr(b, name), getattr(a, name), msg=f"{name} at {t}")


@pytest.mark.parametrize("motion", MOTIONS)
def test_gradients_are_those_of_the_values(motion):
    params = {name: value.requires_grad_() for name, value in random_params(motion, count=2).items()}

    def values(*given):
        named = dict(zip(params, given, strict=True))
        state, shape = motion.state(named, 0.3), motion.at_rest(named)
        kept = (*vars(state).values(), *vars(shape).values(), motion.log_precision(named))
        return tuple(value for value in kept if value is not None)

    assert torch.autograd.gradcheck(values, tuple(params.values()))


@pytest.mark.parametrize("motion", SHARING)
def test_gradients_of_what_gaussians_share_are_those_of_the_values(motion):
    params, shared = random_params(motion, count=3), {name: value.clone() for name, value in motion.shared.items()}
    learned = [name for name, parameter in motion.shared_parameters.items() if parameter.rate > 0]

    def values(*given):
        state = motion.bind({**shared, **dict(zip(learned, given, strict=True))}).state(params, 0.3)
        return state.means, state.velocities, state.quats

    assert torch.autograd.gradcheck(values, tuple(shared[name].requires_grad_() for name in learned))


@pytest.mark.parametrize("motion", MOTIONS)
def test_each_may_be_asked_for_a_time_of_its_own(motion):
    params = random_params(motion)
    times = torch.linspace(-0.2, 1.1, 7, dtype=torch.float64)
    together = motion.state(params, times)
    for k, t in enumerate(times.tolist()):
        alone = motion.state(params, t)
        for name in ("means", "velocities", "presence", "quats", "covars"):
            if getattr(alone, name) is not None:
                torch.testing.assert_close(getattr(together, name)[k], getattr(alone, name)[k], msg=name)


@pytest.mark.parametrize("kind", ["series", "balls", "splines", "marbles", "bases", "hexplane", "deformation"])
def test_the_first_gaussians_follow_their_paths(kind):
    """Which is where all of them begin, whatever they are made of."""
    motion = motion_model(ModelConfig(kind=kind))
    g = torch.Generator().manual_seed(2)
    count = 200
    means, times = torch.rand(count, 3, generator=g), torch.rand(count, generator=g)
    left = means[:, :1] < 0.5
    coefficients = torch.where(left[..., None], torch.tensor([[0.4, 0.0, 0.1]]), torch.tensor([[0.0, -0.3, 0.0]])).expand(
        count, 1, 3
    )
    quats, scales = torch.tensor([1.0, 0, 0, 0]).expand(count, 4), torch.full((count, 3), 0.02)
    log_lambdas = torch.full((count,), math.log(1 / 0.1**2))
    shapes = {name: parameter.shape for name, parameter in motion.parameters.items()}
    params = {"means": means, "times": times, **{name: torch.zeros(count, *shape) for name, shape in shapes.items()}}
    params |= motion.start(means, times, quats, scales, log_lambdas, coefficients)
    if isinstance(motion, SharedMotion):
        motion = motion.bind(motion.start_shared(params, coefficients, torch.ones(count, dtype=torch.bool)))
    moved = motion.state(params, times + 0.1).means - means
    expected = 0.1 * coefficients[:, 0]
    assert float((moved - expected).norm(dim=1).mean()) < 0.35 * float(expected.norm(dim=1).mean())
    torch.testing.assert_close(motion.state(params, times).means, means, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("kind", ["bases", "hexplane", "deformation"])
def test_what_rests_at_the_start_would_stay_where_it_is(kind):
    """Also if it is found to move later: what all share is fitted to it as well."""
    motion = motion_model(ModelConfig(kind=kind))
    assert isinstance(motion, SharedMotion)
    g = torch.Generator().manual_seed(2)
    count = 600
    means, times, dynamic = torch.rand(count, 3, generator=g), torch.rand(count, generator=g), torch.arange(count) % 6 == 0
    means[dynamic] = 0.4 + 0.2 * means[dynamic]
    means[~dynamic, 2] += 1.0
    coefficients = torch.where(dynamic[:, None, None], torch.tensor([[[0.4, 0.0, 0.1]]]), torch.zeros(1, 1, 3))
    log_lambdas = torch.where(dynamic, math.log(1 / 0.1**2), math.log(1e-6))
    quats, scales = torch.tensor([1.0, 0, 0, 0]).expand(count, 4), torch.full((count, 3), 0.02)
    shapes = {name: parameter.shape for name, parameter in motion.parameters.items()}
    params = {"means": means, "times": times, **{name: torch.zeros(count, *shape) for name, shape in shapes.items()}}
    params |= motion.start(means, times, quats, scales, log_lambdas, coefficients)
    motion = motion.bind(motion.start_shared(params, coefficients, dynamic))
    moved = (motion.state(params, times + 0.1).means - means).norm(dim=1)
    true = 0.1 * float(coefficients[0, 0].norm())
    assert float(moved[dynamic].median()) > 0.6 * true
    assert float(moved[~dynamic].median()) < 0.1 * true


@pytest.mark.parametrize("sigma", [1e-4, 2e-3, 0.04, 0.3])
@pytest.mark.parametrize("weigh", [cubic_weights, linear_weights])
def test_knots_have_the_speed_of_a_path_however_short_it_is_known(weigh, sigma):
    times = torch.tensor([0.0, 0.21, 0.5, 0.93])
    velocities = torch.tensor([[0.4, 0.0, -0.1]]).expand(4, 3)
    knots = fit_knots(weigh, times, torch.full((4,), sigma), velocities[:, None], 12)
    _, rates = weigh(times, 12)
    found = torch.bmm(rates[:, None], knots)[:, 0]
    torch.testing.assert_close(found, velocities, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("weigh", [cubic_weights, linear_weights])
def test_knots_that_lie_on_a_line_give_that_line(weigh):
    """Cubic ones from one piece before the clip to one behind it, as a B-spline has them."""
    t = torch.linspace(-0.1, 1.1, 23, dtype=torch.float64)
    first = -1 / 4 if weigh is cubic_weights else 0.0
    line = torch.linspace(first, 1 - first, 7, dtype=torch.float64)
    weights, rates = weigh(t, 7)
    torch.testing.assert_close(weights @ line, t)
    torch.testing.assert_close(rates @ line, torch.ones_like(t))
    torch.testing.assert_close(weights.sum(1), torch.ones_like(t))


def test_high_frequencies_come_in_one_after_the_other():
    motion = DeformationMotion()
    counts = [motion.anneal(progress)["octaves"] for progress in (0.0, 0.25, 0.5, 1.0)]
    assert counts == [2.0, 6.0, 10.0, 10.0]


@pytest.mark.parametrize("motion", MOTIONS)
def test_at_their_center_times_gaussians_have_the_shape_of_those_at_rest(motion):
    """Which takes nothing of what moves."""
    params = random_params(motion)
    moving = ("times", *(name for name, parameter in motion.parameters.items() if parameter.moves))
    shape = motion.at_rest({name: value for name, value in params.items() if name not in moving})
    state = motion.state({**params, "times": torch.zeros(7, dtype=torch.float64)}, 0.0)
    for name in ("quats", "scales", "covars"):
        assert (getattr(shape, name) is None) == (getattr(state, name) is None)
        if getattr(shape, name) is not None:
            torch.testing.assert_close(getattr(shape, name), getattr(state, name), msg=name)
    if shape.scales is not None and motion.log_scales(params) is not None:
        torch.testing.assert_close(torch.exp(motion.log_scales(params)), shape.scales)


@pytest.mark.parametrize("motion", MOTIONS)
def test_those_that_fade_say_all_about_the_precision(motion):
    params = random_params(motion)
    named = {name: value for name, value in params.items() if name == "times" or motion.parameters.get(name, UNKNOWN).fades}
    torch.testing.assert_close(motion.log_precision(named), motion.log_precision(params))


@pytest.mark.parametrize("motion", MOTIONS)
def test_what_is_shrunk_is_smaller_in_space_and_where_asked_in_time(motion):
    params = random_params(motion)
    in_time = torch.arange(7) % 2 == 0
    before, after = motion.at_rest(params), motion.at_rest(shrunk := motion.shrunk(params, math.log(1.6), in_time))
    if before.scales is not None:
        torch.testing.assert_close(after.scales, before.scales / 1.6)
    else:
        torch.testing.assert_close(after.covars, before.covars / 1.6**2)
    change = motion.log_precision(shrunk) - motion.log_precision(params)
    torch.testing.assert_close(change[in_time], torch.full((4,), 2 * math.log(1.6), dtype=torch.float64))


def test_the_settings_name_the_model():
    assert motion_model(ModelConfig()) == SeriesMotion()
    assert motion_model(ModelConfig(move_means=False)) == SeriesMotion(1, 0, 3, 3)
    assert motion_model(ModelConfig(move_quats=False)) == SeriesMotion(6, 6, 0, 0)
    for config in (ModelConfig(move_means=False, move_quats=False), ModelConfig(kind="linear")):
        assert motion_model(config) == LinearMotion()
    assert isinstance(motion_model(ModelConfig(kind="balls")), Balls)
    assert motion_model(ModelConfig(kind="splines", knots=9)) == SplineMotion(9)
    assert motion_model(ModelConfig(kind="marbles")) == MarbleMotion(16)
    assert motion_model(ModelConfig(kind="bases", bases=4)) == BasesMotion(16, 4)
    assert motion_model(ModelConfig(kind="hexplane")) == HexplaneMotion(16)
    assert motion_model(ModelConfig(kind="deformation")) == DeformationMotion()


@pytest.mark.parametrize("motion", MOTIONS)
def test_another_precision_changes_nothing_else(motion):
    params = random_params(motion)
    changed = motion.with_precision(params, 3.0)
    torch.testing.assert_close(motion.log_precision({**params, **changed}), torch.full((7,), 3.0, dtype=torch.float64))
    a, b = motion.state(params, 0.2), motion.state(changed, 0.2)
    for name in ("means", "velocities", "quats", "covars"):
        if getattr(a, name) is not None:
            torch.testing.assert_close(getattr(b, name), getattr(a, name), msg=name, rtol=1e-4, atol=1e-5)


def test_linear_motion_is_the_conditional_of_a_4d_normal_distribution():
    params = random_params(LinearMotion(), seed=3)
    U, V, W = covariances_4d(params["log_scales4"], params["quats_left"], params["quats_right"])
    sigma = torch.zeros(7, 4, 4, dtype=torch.float64)
    sigma[:, :3, :3], sigma[:, :3, 3], sigma[:, 3, :3], sigma[:, 3, 3] = U, V, V, W
    assert (torch.linalg.eigvalsh(sigma) > 0).all()
    # The inverse of the leading block of the precision is the conditional covariance.
    precision = torch.linalg.inv(sigma)
    state = LinearMotion().state(params, 0.7)
    torch.testing.assert_close(state.covars, torch.linalg.inv(precision[:, :3, :3]))
    tau = 0.7 - params["times"]
    conditional = params["means"] - tau[:, None] * torch.linalg.solve(precision[:, :3, :3], precision[:, :3, 3])
    torch.testing.assert_close(state.means, conditional)
    torch.testing.assert_close(state.presence, presence(params["times"], -torch.log(W), 0.7))


def test_linear_parameters_from_moments():
    g = torch.Generator().manual_seed(5)
    root = torch.randn(9, 3, 3, generator=g)
    covars = 0.01 * root @ root.transpose(1, 2) + 1e-4 * torch.eye(3)
    velocities, log_lambdas = torch.randn(9, 3, generator=g), torch.randn(9, generator=g)
    params = LinearMotion.from_moments(covars, velocities, log_lambdas)
    params = {**params, "means": torch.zeros(9, 3), "times": torch.zeros(9)}
    state = LinearMotion().state(params, 0.1)
    torch.testing.assert_close(state.covars, covars, atol=1e-5, rtol=1e-3)
    torch.testing.assert_close(state.velocities, velocities, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(LinearMotion().log_precision(params), log_lambdas, atol=1e-4, rtol=1e-4)


def test_the_precision_of_linear_motion_is_that_of_its_covariance():
    g = torch.Generator().manual_seed(4)
    params = {name: torch.randn(50, 4, generator=g) for name in LinearMotion().parameters}
    _, _, W = covariances_4d(params["log_scales4"], params["quats_left"], params["quats_right"])
    torch.testing.assert_close(LinearMotion().log_precision(params), -torch.log(W))


@pytest.mark.parametrize("duration", [0.1, 1.0, 1000.0])
def test_the_covariance_of_linear_motion_is_exact_however_long_it_lasts(duration):
    params = random_params(LinearMotion(), seed=3)
    params["log_scales4"][:, :3] = math.log(0.003) + 0.5 * params["log_scales4"][:, :3]
    params["log_scales4"][:, 3] = math.log(duration)
    upright = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)
    params |= {name: upright + 0.05 * params[name] for name in ("quats_left", "quats_right")}
    U, V, W = covariances_4d(params["log_scales4"], params["quats_left"], params["quats_right"])
    expected = U - V[:, :, None] * V[:, None] / W[:, None, None]
    found = LinearMotion().state({name: value.float() for name, value in params.items()}, 0.3).covars
    assert ((found - expected).flatten(1).norm(dim=1) / expected.flatten(1).norm(dim=1)).max() < 1e-4


@pytest.mark.parametrize("kind", ["series", "linear", "splines", "marbles", "bases", "hexplane", "deformation"])
def test_all_that_a_model_computes_stays_on_its_device(kind):
    """With tensors that have no values, on a device of their own (``meta``): most operations refuse to mix in one of the host."""
    config, device = ModelConfig(kind=kind), torch.device("meta")
    motion = motion_model(config)
    if isinstance(motion, SharedMotion):
        motion = motion.bind({name: value.to(device).requires_grad_() for name, value in motion.initial_shared().items()})
    shapes = parameter_shapes(config).items()
    params = {name: torch.zeros(6, *shape, device=device, requires_grad=True) for name, shape in shapes}
    times = params["times"]
    moved = [motion.recenter(params, times), motion.shrunk(params, 0.5, times > 0)]
    if kind != "linear":  # which solves eigenvalues on the host
        moved.append(motion.with_precision(params, 1.0))
    found = [motion.log_precision(params), motion.log_scales(params), *(value for each in moved for value in each.values())]
    for given in (motion.state(params, 0.3), motion.state(params, times), motion.at_rest(params)):
        found += vars(given).values()
    leaves = {name: value.detach() for name, value in params.items()}
    shared = {name: value.detach() for name, value in getattr(motion, "shared", {}).items()}
    gaussians, gradients = Gaussians4D(leaves, leaves["times"] > 0, config, 1, shared=shared), {}
    active = Active(torch.zeros(6, dtype=torch.int64, device=device), 2, 0.3)
    sliced = [
        value for value in vars(slice_gaussians(gaussians, active, torch.zeros(3), 0.5, gradients)).values() if value is not None
    ]
    torch.stack([value.sum() for value in sliced]).sum().backward()
    gaussians.anneal(0.5)
    found += [*sliced, *gradients.values()]
    assert gradients.keys() >= {name for name, parameter in getattr(motion, "shared_parameters", {}).items() if parameter.rate > 0}
    assert {value.device for value in found if value is not None} == {device}
