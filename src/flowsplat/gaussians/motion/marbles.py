"""Round Gaussians with a trajectory each, those of Dynamic Gaussian Marbles (docs/method/representation.md, "Motion models of
others")."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from flowsplat.gaussians.model_config import ModelConfig
from flowsplat.gaussians.motion.knots import fit_knots, linear_weights
from flowsplat.gaussians.motion.protocol import MotionState, Parameter, Params, Shape, presence, register
from flowsplat.gaussians.motion.rigid import RigidMotion


@dataclass(frozen=True)
class MarbleMotion(RigidMotion):
    """mu(t) = mean + P(t) - P(mu_t), with P straight lines between places of each Gaussian; one scale and no rotation.

    Dynamic Gaussian Marbles for Novel View Synthesis of Casual Monocular Videos, https://arxiv.org/abs/2406.18717. What keeps
    groups of them together there, the isometry loss among neighbors, is here the rigid loss, which all models have.
    """

    knots: int

    @property
    def parameters(self) -> dict[str, Parameter]:
        """See ``MotionModel``."""
        return {
            "log_lambdas": Parameter((), "precision", moves=True, fades=True),
            "log_radii": Parameter((), "scale"),
            "places": Parameter((self.knots, 3), "motion", moves=True),
        }

    def start(
        self, means: Tensor, times: Tensor, quats: Tensor, scales: Tensor, log_lambdas: Tensor, coefficients: Tensor
    ) -> dict[str, Tensor]:  # fmt: skip
        """See ``MotionModel``: as large as a disc is along its surface, places that follow the paths, by least squares."""
        places = fit_knots(linear_weights, times, torch.exp(-0.5 * log_lambdas), coefficients, self.knots)
        return {"log_lambdas": log_lambdas, "log_radii": torch.log(scales).median(1).values, "places": places}

    def state(self, params: Params, t: float | Tensor) -> MotionState:
        """See ``MotionModel``."""
        times = params["times"]
        weights, rates = linear_weights(torch.as_tensor(t, dtype=times.dtype, device=times.device).expand_as(times), self.knots)
        since = weights - linear_weights(times, self.knots)[0]
        shape = self.at_rest(params)
        return MotionState(
            means=params["means"] + torch.bmm(since[:, None], params["places"])[:, 0],
            velocities=torch.bmm(rates[:, None], params["places"])[:, 0],
            presence=presence(times, params["log_lambdas"], t),
            quats=shape.quats,
            scales=shape.scales,
        )

    def at_rest(self, params: Params) -> Shape:
        """See ``MotionModel``."""
        radii = torch.exp(params["log_radii"])
        upright = radii.new_tensor([1.0, 0.0, 0.0, 0.0]).expand(len(radii), 4)
        return Shape(upright, radii[:, None].expand(-1, 3))

    def log_scales(self, params: Params) -> Tensor | None:
        """See ``MotionModel``."""
        return params["log_radii"][:, None].expand(-1, 3).contiguous()

    def recenter(self, params: Params, shift: Tensor) -> dict[str, Tensor]:
        """See ``MotionModel``."""
        times = params["times"] + shift
        return {**params, "means": self.state(params, times).means, "times": times}

    def shrunk(self, params: Params, log_factor: float, in_time: Tensor) -> dict[str, Tensor]:
        """See ``MotionModel``."""
        log_lambdas = torch.where(in_time, params["log_lambdas"] + 2 * log_factor, params["log_lambdas"])
        return {**params, "log_radii": params["log_radii"] - log_factor, "log_lambdas": log_lambdas}


@register("marbles", "Marbles", "Round, with a trajectory each, as Dynamic Gaussian Marbles.")
def _from_settings(settings: ModelConfig) -> MarbleMotion:
    return MarbleMotion(settings.knots)
