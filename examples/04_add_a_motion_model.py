"""Write a motion model of your own: anything with the methods of ``MotionModel`` moves Gaussians. Here: circles."""

import sys
from dataclasses import dataclass
from pathlib import Path

import torch

from flowsplat.gaussians.motion import MotionModel, MotionState, Params, presence


@dataclass(frozen=True)
class CircularMotion:
    """Every Gaussian runs on a circle in the x-y plane: mu(t) = mean + radius (cos(w tau) - 1, sin(w tau), 0)."""

    @property
    def parameter_shapes(self) -> dict[str, tuple[int, ...]]:
        return {"log_lambdas": (), "quats": (4,), "log_scales": (3,), "radii": (), "rates": ()}

    @property
    def motion_names(self) -> tuple[str, ...]:
        return "radii", "rates"

    def log_precision(self, params: Params) -> torch.Tensor:
        return params["log_lambdas"]

    def state(self, params: Params, t: float) -> MotionState:
        tau, radius, rate = t - params["times"], params["radii"], params["rates"]
        cos, sin, zero = torch.cos(rate * tau), torch.sin(rate * tau), torch.zeros_like(tau)
        return MotionState(
            means=params["means"] + radius[:, None] * torch.stack([cos - 1, sin, zero], 1),
            velocities=(radius * rate)[:, None] * torch.stack([-sin, cos, zero], 1),
            presence=presence(params["times"], params["log_lambdas"], t),
            quats=params["quats"],
            scales=torch.exp(params["log_scales"]),
        )

    def recentred(self, params: Params, shift: torch.Tensor) -> dict[str, torch.Tensor]:
        raise ValueError("a circle cannot be split in time: its start is its parameter")

    def with_precision(self, params: Params, log_lambda: float) -> dict[str, torch.Tensor]:
        return {"log_lambdas": torch.full_like(params["log_lambdas"], log_lambda)}


out = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples")
motion: MotionModel = CircularMotion()
params = {name: torch.zeros(3, *shape) for name, shape in motion.parameter_shapes.items()}
params |= {"means": torch.zeros(3, 3), "times": torch.zeros(3), "radii": torch.ones(3), "rates": torch.tensor([1.0, 2.0, 3.0])}
for time in (0.0, 0.25, 0.5):
    state = motion.state(params, time)
    print(f"t = {time}: x = {[round(v, 3) for v in state.means[:, 0].tolist()]}, speed = {state.velocities.norm(dim=1).tolist()}")
