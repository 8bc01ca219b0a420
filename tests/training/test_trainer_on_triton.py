"""A training step with every operation by the Triton kernels against the same step by the CPU backend."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from flowsplat.common import devices
from flowsplat.gaussians.gaussians4d import Gaussians4D, parameter_shapes
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
    """Call it, and from then on every operation is computed by the Triton kernels, on the CPU too."""

    def force() -> None:
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
        assert ours[0].rows.tolist() == expected[0].rows.tolist()
        assert ours[1].tolist() == expected[1].tolist()
        assert {name: float(value) for name, value in ours[3].items()} == pytest.approx(expected[3], rel=1e-4, abs=1e-6)
        for name, gradient in expected[2].items():
            close(ours[2][name], gradient, name, 2e-4)


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
