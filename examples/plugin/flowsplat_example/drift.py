"""A motion model: everything flies straight on. ``--train.model.kind drift`` takes it."""

from __future__ import annotations

import torch
from torch import Tensor

from flowsplat.gaussians.model_config import ModelConfig
from flowsplat.gaussians.motion import MotionState, Parameter, Params, RigidMotion, presence, register


class Drift(RigidMotion):
    """mu(t) = mean + velocity tau; the rotation stays."""

    @property
    def parameters(self) -> dict[str, Parameter]:
        """Those of ``RigidMotion``, and a velocity."""
        return {**super().parameters, "drifts": Parameter((3,), "motion", moves=True)}

    def start(
        self, means: Tensor, times: Tensor, quats: Tensor, scales: Tensor, log_lambdas: Tensor, coefficients: Tensor
    ) -> dict[str, Tensor]:  # fmt: skip
        """Begin with the velocity that was fitted."""
        fitted = torch.nn.functional.pad(coefficients, (0, 0, 0, max(1 - coefficients.shape[1], 0)))
        return {**super().start(means, times, quats, scales, log_lambdas, coefficients), "drifts": fitted[:, 0]}

    def state(self, params: Params, t: float | Tensor) -> MotionState:
        """Return them at a time."""
        tau = (t - params["times"])[:, None]
        return MotionState(
            means=params["means"] + params["drifts"] * tau,
            velocities=params["drifts"],
            presence=presence(params["times"], params["log_lambdas"], t),
            quats=params["quats"],
            scales=torch.exp(params["log_scales"]),
        )

    def recenter(self, params: Params, shift: Tensor) -> dict[str, Tensor]:
        """Move the center times along the line."""
        return {**params, "means": params["means"] + params["drifts"] * shift[:, None], "times": params["times"] + shift}


@register("drift", "Drift", "Everything flies straight on.")
def drift(settings: ModelConfig) -> Drift:
    """Return the model; it has no settings."""
    return Drift()
