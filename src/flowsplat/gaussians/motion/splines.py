"""Cubic B-splines of the mean and the rotation, the motion of SplineGS (docs/method/representation.md, "Motion models of
others")."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from flowsplat.gaussians.model_config import ModelConfig
from flowsplat.gaussians.motion.knots import cubic_weights, fit_knots
from flowsplat.gaussians.motion.protocol import MotionState, Parameter, Params, presence, register
from flowsplat.gaussians.motion.rigid import RigidMotion


@dataclass(frozen=True)
class SplineMotion(RigidMotion):
    """mu(t) = mean + S(t) - S(mu_t), with S a uniform cubic B-spline of each Gaussian over the clip; q(t) of the same form.

    SplineGS: Robust Motion-Adaptive Spline for Real-Time Dynamic 3D Gaussians from Monocular Video,
    https://arxiv.org/abs/2412.09982.
    There every Gaussian loses control points that it can do without; here all have as many, so that they are rows of one tensor.
    """

    knots: int

    @property
    def parameters(self) -> dict[str, Parameter]:
        """See ``MotionModel``."""
        motion = {
            "mean_knots": Parameter((self.knots, 3), "motion", moves=True),
            "quat_knots": Parameter((self.knots, 4), "motion", moves=True),
        }
        return {**super().parameters, **motion}

    def start(
        self, means: Tensor, times: Tensor, quats: Tensor, scales: Tensor, log_lambdas: Tensor, coefficients: Tensor
    ) -> dict[str, Tensor]:  # fmt: skip
        """See ``MotionModel``: knots that follow the paths, by least squares."""
        knots = fit_knots(cubic_weights, times, torch.exp(-0.5 * log_lambdas), coefficients, self.knots)
        return {**super().start(means, times, quats, scales, log_lambdas, coefficients), "mean_knots": knots}

    def state(self, params: Params, t: float | Tensor) -> MotionState:
        """See ``MotionModel``."""
        times = params["times"]
        weights, rates = cubic_weights(torch.as_tensor(t, dtype=times.dtype, device=times.device).expand_as(times), self.knots)
        since = weights - cubic_weights(times, self.knots)[0]
        return MotionState(
            means=params["means"] + _combine(since, params["mean_knots"]),
            velocities=_combine(rates, params["mean_knots"]),
            presence=presence(times, params["log_lambdas"], t),
            quats=params["quats"] + _combine(since, params["quat_knots"]),
            scales=torch.exp(params["log_scales"]),
        )


def _combine(weights: Tensor, knots: Tensor) -> Tensor:
    return torch.bmm(weights[:, None], knots)[:, 0]


@register("splines", "Splines", "Cubic B-splines, the motion of SplineGS.")
def _from_settings(settings: ModelConfig) -> SplineMotion:
    return SplineMotion(settings.knots)
