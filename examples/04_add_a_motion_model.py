"""Define a motion model of your own, train it on the small built-in clip and export it.

Here every object flies like a thrown ball.

In a copy of flowsplat the class would be a file of ``gaussians/motion`` (CONTRIBUTING.md, "Add a motion model").
"""

import sys
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

import flowsplat
from flowsplat.common.files import read_json
from flowsplat.gaussians.model_config import ModelConfig
from flowsplat.gaussians.motion import MotionState, Parameter, Params, RigidMotion, presence, register
from flowsplat.output.export import ExportOptions, export_scene
from flowsplat.pipeline import prepare, train
from flowsplat.scenes.synthetic import SyntheticScene, write_synthetic


class Thrown(RigidMotion):
    """mu(t) = mean + velocity tau + acceleration tau^2 / 2; the rotation stays."""

    @property
    def parameters(self) -> dict[str, Parameter]:
        motion = {name: Parameter((3,), "motion", moves=True) for name in ("velocities", "accelerations")}
        return {**super().parameters, **motion}

    def start(
        self, means: Tensor, times: Tensor, quats: Tensor, scales: Tensor, log_lambdas: Tensor, coefficients: Tensor
    ) -> dict[str, Tensor]:  # fmt: skip
        order = coefficients.shape[1]
        fitted = torch.nn.functional.pad(coefficients, (0, 0, 0, max(2 - order, 0)))
        motion = {"velocities": fitted[:, 0], "accelerations": 2 * fitted[:, 1]}
        return {**super().start(means, times, quats, scales, log_lambdas, coefficients), **motion}

    def state(self, params: Params, t: float | Tensor) -> MotionState:
        tau = (t - params["times"])[:, None]
        velocities, accelerations = params["velocities"], params["accelerations"]
        return MotionState(
            means=params["means"] + velocities * tau + 0.5 * accelerations * tau**2,
            velocities=velocities + accelerations * tau,
            presence=presence(params["times"], params["log_lambdas"], t),
            quats=params["quats"],
            scales=torch.exp(params["log_scales"]),
        )

    def recenter(self, params: Params, shift: Tensor) -> dict[str, Tensor]:
        moved = self.state({**params, "times": -shift}, 0.0)
        return {**params, "means": moved.means, "velocities": moved.velocities, "times": params["times"] + shift}


@register("thrown", "Thrown", "Flies like a thrown ball.")
def thrown(settings: ModelConfig) -> Thrown:
    return Thrown()


out = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples")
iterations = int(sys.argv[2]) if len(sys.argv) > 2 else 150

scene = out / "04_scene"
if not (scene / "scene.json").exists():
    write_synthetic(scene, SyntheticScene(width=64, height=36, frames=8), holdout=4)
config = flowsplat.preset("default")
settings = replace(config.train, iterations=iterations, model=replace(config.train.model, kind="thrown"))
run = prepare(scene, out / "04_run", replace(config, priors=replace(config.priors, priors="true"), train=settings))
model = train(run)
history = read_json(run.path / "training" / "history.json")
print(f"loss {history[0]['loss']:.4f} -> {history[-1]['loss']:.4f}, PSNR {history[0]['psnr']:.2f} -> {history[-1]['psnr']:.2f} dB")
gaussians = model.gaussians
speed = gaussians.params["velocities"][gaussians.dynamic].norm(dim=1).median()
print(f"{int(gaussians.dynamic.sum())} of {len(gaussians)} Gaussians move, at {speed:.3f} median depths a clip")
print(f"to watch it: {export_scene(model, flowsplat.Scene(run.scene_path), 'html', out / '04_player.html', ExportOptions())}")
