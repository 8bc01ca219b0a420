"""A training step with every operation by the Triton kernels against the same step by the CPU backend."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from flowsplat.common import devices
from flowsplat.gaussians.culling import capacity
from flowsplat.gaussians.gaussians4d import Active, Gaussians4D
from flowsplat.splatting import api as splatting
from flowsplat.training.trainer import Trainer
from tests.marks import slow
from tests.training.handful import FRAMES, a_few, seen, tiny

pytest.importorskip("triton", reason="Triton is not installed")
from flowsplat.common.triton_probe import _squares

ON_GPU = torch.cuda.is_available()


@pytest.fixture
def by_triton(monkeypatch):
    """Call it, and from then on every operation is computed by the Triton kernels, on the CPU too, with few rows."""

    def force() -> None:
        monkeypatch.setattr(capacity, "GRANULE", 8)  # the interpreter takes its time with padding, too
        pick = splatting._pick
        monkeypatch.setattr(devices, "kernels_for", lambda value: "triton" if value.dtype == torch.float32 else "reference")
        monkeypatch.setattr(splatting, "_pick", lambda backend, means: "triton" if backend == "auto" else pick(backend, means))

    return force


def close(ours: torch.Tensor, expected: torch.Tensor, name: str, tolerance: float) -> None:
    error = (ours.double().cpu() - expected.double()).norm()
    assert float(error) <= tolerance * float(expected.double().norm()) + 1e-7, name


def without_padding(gaussians: Gaussians4D, name: str, active: Active, gradient: torch.Tensor) -> torch.Tensor:
    """Of a gradient by rows that which is not padding's; the padding's is 0."""
    resting, moving = active.counts()
    if name in gaussians.moving_names:
        ours = gradient[:moving]
    else:
        ours = gradient[:resting] if name == "log_gains" else active.valid(gradient)
    assert torch.isfinite(gradient).all()
    assert int(gradient.count_nonzero()) == int(ours.count_nonzero())
    return ours


@pytest.mark.parametrize(("preset", "flow_model"), [("default", "displacement"), slow("default", "affine"), slow("paper", "mean")])
def test_the_loss_and_its_gradients_are_those_of_the_cpu(preset, flow_model, by_triton):
    config = tiny(preset, flow_model=flow_model)
    observations = seen(a_few(config))
    found = []
    for device in ("cpu", "cuda" if ON_GPU else "cpu"):
        trainer = Trainer(observations, None, replace(config, iterations=0), start=a_few(config), device=device)
        trainer.run()
        trainer.gaussians.sh_degree = 1
        found.append([trainer.differentiate(k) for k in (0, FRAMES - 1)])  # the last one has no flow
        by_triton()
    for (expected, right), (ours, gradients) in zip(*found, strict=True):
        active = gradients.active
        assert active.valid(active.rows).tolist() == right.active.rows.tolist()
        assert len(active.rows) > len(right.active.rows)
        assert active.valid(gradients.drawn).tolist() == right.drawn.tolist()
        assert int(gradients.drawn.sum()) == int(right.drawn.sum())
        figures = {name: float(value) for name, value in ours.figures.items()}
        assert figures == pytest.approx(expected.figures, rel=1e-4, abs=1e-6)
        for name, gradient in right.values.items():
            close(without_padding(trainer.gaussians, name, active, gradients.values[name]), gradient, name, 2e-4)


def test_steps_lead_where_those_of_the_cpu_lead(by_triton):
    config = tiny("default", frames_per_iteration=2)
    observations = seen(a_few(config))
    found = []
    for device in ("cpu", "cuda" if ON_GPU else "cpu"):
        start = a_few(config)
        trainer = Trainer(observations, None, config, start=start, device=device)
        found.append((trainer.run(), trainer.history))
        by_triton()
    (expected, history), (ours, our_history) = found
    assert our_history[-1] == pytest.approx(history[-1], rel=1e-4, abs=1e-6)
    first = a_few(config).params
    for name, value in expected.params.items():
        close(ours.params[name].cpu() - first[name], value - first[name], name, 0.02)  # Adam's first steps are signs


def moving_start(config):
    """With shared values that move them."""
    gaussians, g = a_few(config), torch.Generator().manual_seed(3)
    for name, parameter in getattr(gaussians.motion, "shared_parameters", {}).items():
        if parameter.rate > 0:
            gaussians.shared[name] += 0.05 * torch.randn(parameter.shape, generator=g)
    return gaussians


@pytest.mark.parametrize("kind", ["bases", *(slow(kind) for kind in ("splines", "marbles", "hexplane", "deformation"))])
def test_gradients_and_steps_of_other_motion_models_are_those_of_the_cpu(kind, by_triton):
    """Also of what their Gaussians share, which is one row a parameter."""
    config = tiny("default")
    config = replace(config, model=replace(config.model, kind=kind, knots=6, bases=3), iterations=0)
    observations, found = seen(a_few(tiny("default"))), []
    for device in ("cpu", "cuda" if ON_GPU else "cpu"):
        trainer = Trainer(observations, None, config, start=moving_start(config), device=device)
        trainer.run()
        found.append((trainer, trainer.differentiate(0)[1]))
        by_triton()
    (_, right), (trainer, ours) = found
    assert ours.values.keys() == right.values.keys()
    for name, gradient in right.values.items():
        close(ours.values[name], gradient, name, 2e-4)
    assert ours.shared.keys() == right.shared.keys()
    for name, gradient in right.shared.items():
        close(ours.shared[name], gradient, name, 2e-4)

    gaussians = trainer.gaussians
    assert all(value.device == gaussians.device for value in gaussians.values.values())
    learned, rates = getattr(gaussians.motion, "shared_parameters", {}), trainer.rates.of_shared(0, gaussians)
    before = {name: value.clone() for name, value in gaussians.shared.items()}
    trainer._optimize(trainer.state, ours)
    for name, value in gaussians.shared.items():
        if learned[name].rate > 0:  # the first step of Adam
            expected = -rates[name].view_as(value) * torch.sign(ours.shared[name])
            large = ours.shared[name].abs() > 1e-6
            torch.testing.assert_close((value - before[name])[large], expected[large], rtol=1e-2, atol=1e-7, msg=name)
            assert large.any()


@pytest.mark.parametrize("flow_model", ["displacement", slow("affine")])
def test_every_kernel_of_a_step_is_launched_on_the_device_of_its_tensors(flow_model, by_triton, monkeypatch):
    """Not on the one that happens to be the current one. The interpreter knows no devices, so the guard is counted instead."""
    runs = type(_squares)
    guarded, launched = [], []
    device_of = torch.cuda.device_of

    class Guard:
        def __init__(self, tensor):
            assert isinstance(tensor, torch.Tensor)
            self._real = device_of(tensor)

        def __enter__(self):
            self._real.__enter__()
            guarded.append(self)

        def __exit__(self, *error):
            guarded.pop()
            self._real.__exit__(*error)

    run = runs.run

    def launch(self, *given, **settings):
        launched.append((self.fn.__module__, self.fn.__name__, bool(guarded)))
        return run(self, *given, **settings)

    monkeypatch.setattr(torch.cuda, "device_of", Guard)
    monkeypatch.setattr(runs, "run", launch)
    config = tiny("default", flow_model=flow_model)
    observations, start = seen(a_few(config)), a_few(config)  # on the CPU, by its kernels
    by_triton()
    Trainer(observations, None, config, start=start, device="cuda" if ON_GPU else "cpu").run()
    assert {module.split(".triton")[0] for module, _, _ in launched} >= {
        f"flowsplat.{part}" for part in (
            "gaussians.culling", "gaussians.slicing", "gaussians.flow", "splatting", "training.photometric_loss",
            "training.rigidity", "training.adam", "training.ray_preconditioning",
        )
    }  # fmt: skip
    assert {(module, name) for module, name, is_guarded in launched if not is_guarded} == set()


def state_of(trainer: Trainer) -> dict[str, torch.Tensor]:
    """Everything that training changes."""
    statistics = {f"statistics.{name}": value for name, value in trainer.state.statistics.items()}
    return {**trainer.gaussians.params, **trainer.state.optimizer.state(), **statistics}


@pytest.mark.parametrize(
    ("preset", "frames", "gains", "frozen", "granules"),
    [slow("default", 1, 2, True, (8, 48)), slow("default", 2, 2, True, (8,)), ("paper", 1, 0, False, (8,))],
)
def test_padding_changes_nothing_and_where_there_are_too_few_rows_there_are_more(
    preset, frames, gains, frozen, granules, by_triton, monkeypatch
):
    config = tiny(preset, frames_per_iteration=frames)
    config = replace(config, model=replace(config.model, gains=gains, freeze_background=frozen))
    observations, computed = seen(a_few(config)), []
    by_triton()
    backpropagate, padded = Trainer.backpropagate, Gaussians4D.active

    def counting(self, *given):
        computed.append(given)
        return backpropagate(self, *given)

    def run():
        computed.clear()
        trainer = Trainer(observations, None, config, start=a_few(config), device="cuda" if ON_GPU else "cpu")
        trainer.run()
        return state_of(trainer), trainer.history[-1], len(computed)

    monkeypatch.setattr(Trainer, "backpropagate", counting)
    found = []
    for granule in granules:
        monkeypatch.setattr(capacity, "GRANULE", granule)
        found.append(run())
    monkeypatch.setattr(Gaussians4D, "active", lambda self, t, camera=None, capacity=None: padded(self, t, camera))
    expected, figures, steps = run()
    assert steps == config.iterations * frames
    assert int(expected["counts"].max()) == config.iterations
    assert [attempts > steps for _, _, attempts in found] == [granule < 16 for granule in granules]
    for state, our_figures, _ in found:
        assert our_figures == pytest.approx(figures, rel=1e-6)
        for name, value in expected.items():
            assert torch.equal(state[name], value), name


@pytest.mark.parametrize("resting", [slow(True), False])
def test_a_frame_without_moving_gaussians_or_without_any(resting, by_triton):
    config = tiny("default")
    observations = seen(a_few(config))
    by_triton()
    start = a_few(config)
    start.dynamic[:] = not resting
    start.params["log_lambdas"] += 20.0  # those that move are long gone
    start.params["times"] -= 3.0
    before = {name: value.clone() for name, value in start.params.items()}
    trainer = Trainer(observations, None, config, start=start, device="cuda" if ON_GPU else "cpu")
    trainer.run()
    assert trainer.history[-1]["active"] == (24 if resting else 0)
    assert trainer.history[-1]["rigid"] == 0
    for name, value in trainer.gaussians.params.items():
        assert torch.isfinite(value).all(), name
        assert resting or torch.equal(value.cpu(), before[name]), name
    assert int(trainer.state.optimizer.counts.max()) == (2 if resting else 0)
