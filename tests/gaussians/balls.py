"""A motion model that shares nothing with those of the package: round Gaussians with covariances, which fly straight on."""

from __future__ import annotations

import torch

from flowsplat.gaussians.motion import MotionState, Parameter, Shape, presence, register


class Balls:
    """Sigma = radius^2 I, mu(t) = mean + drift tau, lambda = 1 / life^2."""

    kernels = None

    @property
    def parameters(self):
        return {
            "drifts": Parameter((3,), "motion", moves=True),
            "log_radii": Parameter((), "scale"),
            "log_lives": Parameter((), "precision", moves=True, fades=True),
        }

    def log_precision(self, params):
        return -2 * params["log_lives"]

    def state(self, params, t):
        tau = (t - params["times"])[:, None]
        return MotionState(
            means=params["means"] + tau * params["drifts"], velocities=params["drifts"].clone(),
            presence=presence(params["times"], self.log_precision(params), t), covars=self.at_rest(params).covars,
        )  # fmt: skip

    def at_rest(self, params):
        eye = torch.eye(3, dtype=params["means"].dtype, device=params["means"].device)
        return Shape(covars=torch.exp(2 * params["log_radii"])[:, None, None] * eye)

    def log_scales(self, params):
        return params["log_radii"][:, None].expand(-1, 3).contiguous()

    def start(self, means, times, quats, scales, log_lambdas, coefficients):
        drifts = coefficients[:, 0] if coefficients.shape[1] else torch.zeros(len(quats), 3)
        return {"drifts": drifts, "log_radii": torch.log(scales).mean(1), "log_lives": -0.5 * log_lambdas}

    def recenter(self, params, shift):
        return {**params, "means": params["means"] + shift[:, None] * params["drifts"], "times": params["times"] + shift}

    def with_precision(self, params, log_lambda):
        return {**params, "log_lives": torch.full_like(params["log_lives"], -0.5 * log_lambda)}

    def shrunk(self, params, log_factor, in_time):
        lives = torch.where(in_time, params["log_lives"] - log_factor, params["log_lives"])
        return {**params, "log_radii": params["log_radii"] - log_factor, "log_lives": lives}


@register("balls", "Balls", "Round and drifting.")
def balls(settings):
    return Balls()
