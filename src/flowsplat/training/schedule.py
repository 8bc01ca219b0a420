"""The learning rates of every parameter at a step."""

from __future__ import annotations

import functools
import math

import numpy as np
import torch
from torch import Tensor

from flowsplat.common.devices import upload
from flowsplat.gaussians.gaussians4d import Gaussians4D
from flowsplat.gaussians.motion import SharedMotion
from flowsplat.gaussians.motion.protocol import RateGroup
from flowsplat.training.config import RatesConfig


class LearningRates:
    """They fall exponentially over the steps; each parameter of a motion model has the rate of its group."""

    def __init__(self, config: RatesConfig, iterations: int, focal: float, device: torch.device):
        """``focal``: pixels that a unit of length has at the median depth."""
        self.config, self._iterations, self._focal, self.device = config, iterations, focal, device

    def at(self, step: int, gaussians: Gaussians4D, moving: bool = False) -> dict[str, Tensor]:
        """Return the rates of Gaussians at rest, or of those that move: one for every number of a row, by parameter."""
        r = self.config
        progress = step / max(self._iterations, 1)
        decay = r.moving_decay if moving else r.decay
        means, motion, rest = (decay**progress for decay in (r.means_decay, r.motion_decay, decay))
        limit = r.means_pixels / self._focal
        slowed = limit / r.means if 0 < limit < r.means else 1.0
        rates = {
            "means": slowed * r.means * means, "times": r.times, "logit_opacities": r.opacities * rest, "log_gains": r.gains * rest,
            "slopes": r.slopes * rest / (r.moving if moving else 1),  # of what moves no faster: it gained nothing
        }  # fmt: skip
        groups: dict[RateGroup, float] = {
            "rotation": r.quats * rest, "scale": r.scales * rest, "precision": r.log_lambdas * rest,
            "motion": slowed * r.motion * motion,
        }  # fmt: skip
        parameters = gaussians.motion.parameters
        rates |= {name: groups[parameter.rate] for name, parameter in parameters.items()}
        powers = {name for name, parameter in parameters.items() if parameter.powers and r.time_factor != 1}
        rates["times"] /= r.time_factor
        result: dict[str, np.ndarray] = {}
        for name, value in gaussians.params.items():
            size = math.prod(value.shape[1:])
            result[name] = np.full(size, r.harmonics * rest if name == "sh" else rates[name], np.float32)
            if name == "sh":
                result[name][:3] = r.colors * rest
            if name == "log_gains":
                result[name] *= _falloff(size, r.gains_falloff)
            if name in powers:
                of_power = np.float32(r.time_factor) ** np.arange(1, value.shape[1] + 1, dtype=np.float32)
                result[name] *= np.repeat(of_power, math.prod(value.shape[2:]))
        # One copy to the device for all of them.
        together = upload(np.concatenate(list(result.values())) * np.float32(r.moving if moving else 1), self.device)
        return dict(zip(result, together.split([len(rate) for rate in result.values()]), strict=True))

    def of_shared(self, step: int, gaussians: Gaussians4D) -> dict[str, Tensor]:
        """Return the rates of what Gaussians share and learn: one for every number of a parameter, by its name."""
        if not isinstance(gaussians.motion, SharedMotion):
            return {}
        fallen = self.config.motion_decay ** (step / max(self._iterations, 1))
        learned = {name: parameter for name, parameter in gaussians.motion.shared_parameters.items() if parameter.rate > 0}
        return {
            name: torch.full((math.prod(parameter.shape),), parameter.rate * fallen, device=self.device)
            for name, parameter in learned.items()
        }


@functools.cache
def _falloff(count: int, power: float) -> np.ndarray:
    """Return [count] factors by which the gains' frequencies learn more slowly."""
    return (torch.arange(1.0, count + 1) ** -power).numpy()
