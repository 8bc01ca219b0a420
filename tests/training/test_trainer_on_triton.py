"""A training step with every operation by the Triton kernels against the same step by the CPU backend."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from flowsplat.common import devices
from flowsplat.gaussians.culling import rooms
from flowsplat.gaussians.gaussians4d import Active, Gaussians4D, parameter_shapes
from flowsplat.gaussians.observations import Observation, Observations
from flowsplat.gaussians.render import render
from flowsplat.geometry import Camera, Similarity
from flowsplat.scenes import Flow
from flowsplat.splatting import api as splatting
from flowsplat.training.config import PRESETS, TrainConfig
from flowsplat.training.trainer import Trainer

pytest.importorskip("triton", reason="Triton is not installed")

WIDTH, HEIGHT, FRAMES = 24, 16, 3
ON_GPU = torch.cuda.is_available()


def a_few(config: TrainConfig, count: int = 24) -> Gaussians4D:
    """Gaussians before the cameras, two thirds of them moving."""
    g = torch.Generator().manual_seed(0)
    params = {name: 0.1 * torch.randn(count, *shape, generator=g) for name, shape in parameter_shapes(config.model).items()}
    params["means"] = params["means"] * torch.tensor([3.0, 2.0, 1.0]) + torch.tensor([0.0, 0.0, 1.0])
    params["log_scales"] -= 2.5
    params["times"] = torch.randint(FRAMES, (count,), generator=g) / (FRAMES - 1)
    params["log_lambdas"] += 2.0
    return Gaussians4D(params, torch.arange(count) % 3 > 0, config.model, config.model.sh_degree)


def seen(gaussians: Gaussians4D) -> Observations:
    """Noisy pictures, depth and flow of them."""
    rng = np.random.default_rng(0)
    K = np.array([[20.0, 0, WIDTH / 2], [0, 20, HEIGHT / 2], [0, 0, 1]])
    cameras = []
    for k in range(FRAMES):
        viewmat = np.eye(4)
        viewmat[0, 3] = -0.02 * k
        cameras.append(Camera(viewmat, K, WIDTH, HEIGHT))
    frames = []
    for k, camera in enumerate(cameras):
        shown = render(gaussians, camera, k / (FRAMES - 1))
        flow = Flow(k, k + 1, rng.normal(0, 1, (HEIGHT, WIDTH, 2)).astype(np.float32), np.ones((HEIGHT, WIDTH), np.float32))
        frames.append(
            Observation(
                frame=k, time=k / (FRAMES - 1), camera=camera,
                image=(255 * np.clip(shown.colour.numpy() + rng.normal(0, 0.1, (HEIGHT, WIDTH, 3)), 0, 1)).astype(np.uint8),
                depth=rng.uniform(0.8, 1.2, (HEIGHT, WIDTH)).astype(np.float32), depth_trusted=rng.random((HEIGHT, WIDTH)) < 0.8,
                mask=np.zeros((HEIGHT, WIDTH), bool), forward=flow if k + 1 < FRAMES else None, backward=None,
            )
        )  # fmt: skip
    return Observations(frames, Similarity())


@pytest.fixture
def by_triton(monkeypatch):
    """Call it, and from then on every operation is computed by the Triton kernels, on the CPU too, in small rooms."""

    def force() -> None:
        monkeypatch.setattr(rooms, "GRANULE", 8)  # the interpreter takes its time with nobody, too
        pick = splatting._pick
        monkeypatch.setattr(devices, "kernels_for", lambda value: "triton" if value.dtype == torch.float32 else "reference")
        monkeypatch.setattr(splatting, "_pick", lambda backend, means: "triton" if backend == "auto" else pick(backend, means))

    return force


def tiny(preset: str, **changes) -> TrainConfig:
    config = PRESETS[preset]
    model = replace(config.model, mean_poly=2, mean_fourier=1, quat_poly=1, quat_fourier=1, sh_degree=1)
    return replace(
        config, iterations=2, preview_every=0, model=model, loss=replace(config.loss, rigid_neighbours=4),
        density=replace(config.density, every=0, reset_every=0), **changes,
    )  # fmt: skip


def close(ours: torch.Tensor, expected: torch.Tensor, name: str, tolerance: float) -> None:
    error = (ours.double().cpu() - expected.double()).norm()
    assert float(error) <= tolerance * float(expected.double().norm()) + 1e-7, name


def of_somebody(gaussians: Gaussians4D, name: str, active: Active, gradient: torch.Tensor) -> torch.Tensor:
    """Of a gradient by rows that of somebody; nobody's is 0."""
    resting, moving = active.counts()
    if name in gaussians.moving_names:
        ours = gradient[:moving]
    else:
        ours = gradient[:resting] if name == "log_gains" else active.somebody(gradient)
    assert torch.isfinite(gradient).all()
    assert int(gradient.count_nonzero()) == int(ours.count_nonzero())
    return ours


@pytest.mark.parametrize(("preset", "flow_model"), [("default", "displacement"), ("default", "affine"), ("paper", "mean")])
def test_the_loss_and_its_gradients_are_those_of_the_cpu(preset, flow_model, by_triton):
    config = tiny(preset, flow_model=flow_model)
    observations = seen(a_few(config))
    found = []
    for device in ("cpu", "cuda" if ON_GPU else "cpu"):
        trainer = Trainer(observations, None, replace(config, iterations=0), start=a_few(config), device=device)
        trainer.run()
        trainer.gaussians.sh_degree = 1
        found.append([trainer._differentiate(k) for k in (0, FRAMES - 1)])  # the last one has no flow
        by_triton()
    for expected, ours in zip(*found, strict=True):
        active = ours[0]
        assert active.somebody(active.rows).tolist() == expected[0].rows.tolist()
        assert len(active.rows) > len(expected[0].rows)
        assert active.somebody(ours[1]).tolist() == expected[1].tolist()
        assert int(ours[1].sum()) == int(expected[1].sum())
        assert {name: float(value) for name, value in ours[3].items()} == pytest.approx(expected[3], rel=1e-4, abs=1e-6)
        for name, gradient in expected[2].items():
            close(of_somebody(trainer.gaussians, name, active, ours[2][name]), gradient, name, 2e-4)


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


def state_of(trainer: Trainer) -> dict[str, torch.Tensor]:
    """Everything that training changes."""
    statistics = {f"statistics.{name}": value for name, value in vars(trainer._statistics).items()}
    return {**trainer.gaussians.params, **trainer._adam.state(), **statistics}


@pytest.mark.parametrize(
    ("preset", "frames", "gains", "frozen", "granules"),
    [("default", 1, 2, True, (8, 48)), ("default", 2, 2, True, (8,)), ("paper", 1, 0, False, (8,))],
)
def test_places_of_nobody_change_nothing_and_where_there_are_too_few_there_are_more(
    preset, frames, gains, frozen, granules, by_triton, monkeypatch
):
    config = tiny(preset, frames_per_iteration=frames)
    config = replace(config, model=replace(config.model, gains=gains, freeze_background=frozen))
    observations, computed = seen(a_few(config)), []
    by_triton()
    backpropagate, padded = Trainer._backpropagate, Gaussians4D.active

    def counting(self, *given):
        computed.append(given)
        return backpropagate(self, *given)

    def run():
        computed.clear()
        trainer = Trainer(observations, None, config, start=a_few(config), device="cuda" if ON_GPU else "cpu")
        trainer.run()
        return state_of(trainer), trainer.history[-1], len(computed)

    monkeypatch.setattr(Trainer, "_backpropagate", counting)
    found = []
    for granule in granules:
        monkeypatch.setattr(rooms, "GRANULE", granule)
        found.append(run())
    monkeypatch.setattr(Gaussians4D, "active", lambda self, t, camera=None, rooms=None: padded(self, t, camera))
    expected, figures, steps = run()
    assert steps == config.iterations * frames
    assert int(expected["counts"].max()) == config.iterations
    assert [attempts > steps for _, _, attempts in found] == [granule < 16 for granule in granules]
    for state, our_figures, _ in found:
        assert our_figures == pytest.approx(figures, rel=1e-6)
        for name, value in expected.items():
            assert torch.equal(state[name], value), name


@pytest.mark.parametrize("somebody", [True, False])
def test_a_frame_without_anybody_that_moves_or_without_anybody(somebody, by_triton):
    config = tiny("default")
    observations = seen(a_few(config))
    by_triton()
    start = a_few(config)
    start.dynamic[:] = not somebody
    start.params["log_lambdas"] += 20.0  # those that move are long gone
    start.params["times"] -= 3.0
    before = {name: value.clone() for name, value in start.params.items()}
    trainer = Trainer(observations, None, config, start=start, device="cuda" if ON_GPU else "cpu")
    trainer.run()
    assert trainer.history[-1]["active"] == (24 if somebody else 0)
    assert trainer.history[-1]["rigid"] == 0
    for name, value in trainer.gaussians.params.items():
        assert torch.isfinite(value).all(), name
        assert somebody or torch.equal(value.cpu(), before[name]), name
    assert int(trainer._adam.counts.max()) == (2 if somebody else 0)
