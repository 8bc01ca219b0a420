"""The CPU backend against the GPU backend at full size."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest
import torch

from flowsplat.gaussians.render import render, render_active
from flowsplat.training.config import PRESETS
from flowsplat.training.trainer import Trainer
from flowsplat_benchmarks.scripts.cpu_parts import scene

WIDTH, HEIGHT, COUNT = 854, 480, 100_000


def scenes():
    """The same Gaussians on both, their cameras."""
    model = scene.gaussians(PRESETS["default"].model, COUNT, WIDTH, HEIGHT)
    return model, model.to("cuda"), scene.cameras(scene.work_load(1, WIDTH, HEIGHT))


def difference(ours: torch.Tensor, expected: torch.Tensor) -> float:
    """Of the GPU from the CPU, relative to the norm."""
    return float((ours.detach().cpu().double() - expected.detach().double()).norm() / expected.detach().double().norm())


@pytest.mark.parametrize("flow_model", ["mean", "displacement", "affine"])
def test_images_are_the_same(flow_model):
    on_cpu, on_gpu, cameras = scenes()
    expected, ours = (
        render(model, cameras[1], 0.2, flow_to=(cameras[2], 0.4), flow_model=flow_model) for model in (on_cpu, on_gpu)
    )
    # At the edge of a support a rounding decides: a few pixels of 400,000 differ by up to 1/255.
    for name in ("color", "depth", "alpha", "flow"):
        assert difference(getattr(ours, name), getattr(expected, name)) < 1e-3, name
    assert torch.equal(render(on_gpu, cameras[1], 0.2).image, render(on_gpu, cameras[1], 0.2).image)


def test_gradients_are_the_same():
    on_cpu, on_gpu, cameras = scenes()
    found = []
    for model in (on_cpu, on_gpu):
        gradients: dict[str, torch.Tensor] = {}
        active = model.active(0.2, cameras[1])
        frame = render_active(model, active, cameras[1], flow_to=(cameras[2], 0.4), flow_model="affine", gradients=gradients)
        weights = torch.randn(HEIGHT, WIDTH, 10, generator=torch.Generator().manual_seed(0))
        (frame.image[..., :10] * weights.to(frame.image.device)).sum().backward()
        found.append((active.rows.cpu(), gradients))
    (rows, expected), (our_rows, ours) = found
    assert torch.equal(rows, our_rows)
    for name, gradient in expected.items():
        if float(gradient.norm()) > 0:
            assert difference(ours[name], gradient) < 1e-2, name


@contextmanager
def waiting_is_an_error() -> Iterator[None]:
    """Whatever makes the host wait until the GPU has nothing left to do raises an error, but for asking an event or the device."""
    torch.cuda.set_sync_debug_mode("error")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode("default")


@pytest.mark.parametrize(("flow_model", "frames"), [("displacement", 1), ("affine", 1), ("mean", 1), ("displacement", 2)])
def test_a_step_asks_the_gpu_only_for_what_it_counted_before_the_rest_was_queued(flow_model, frames):
    """How many pairs of a Gaussian and a tile there are, and how many Gaussians are active, both of every frame."""
    config = replace(PRESETS["default"], iterations=12, preview_every=0, flow_model=flow_model, frames_per_iteration=frames)
    start = scene.gaussians(config.model, COUNT, WIDTH, HEIGHT)
    trainer = Trainer(scene.observations(start, WIDTH, HEIGHT), None, config, start=start, device="cuda")
    trainer.run()  # which finds neighbors, and room for every frame
    with waiting_is_an_error():
        for _ in range(4):  # in one of them the flow of every Gaussian is looked at
            trainer.iterate()
    with torch.profiler.profile() as profile:
        trainer.iterate()
    waits = [event.name for event in profile.events() if event.name in ("cudaStreamSynchronize", "cudaEventSynchronize")]
    assert waits.count("cudaEventSynchronize") <= 2 * frames, waits
    assert "cudaStreamSynchronize" not in waits


def test_training_stops_and_goes_on_across_devices(tmp_path):
    config = replace(PRESETS["default"], iterations=6, checkpoint_every=3, preview_every=0)
    start = scene.gaussians(config.model, 5_000, 160, 90)
    observations = scene.observations(start, 160, 90)

    class Stopped(Exception):
        pass

    def stop(_: dict[str, float]) -> None:
        raise Stopped

    first = Trainer(observations, None, config, tmp_path, record=stop, start=start.to("cuda"), device="cuda")
    with pytest.raises(Stopped):
        first.run()  # at the last step, when the checkpoint of step 3 is there
    second = Trainer(observations, None, config, tmp_path, device="cpu")
    assert second.run().device.type == "cpu"
    assert second.step == 6
