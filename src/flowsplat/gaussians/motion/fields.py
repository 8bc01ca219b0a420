"""Let Gaussians ask a field over space and time how they move: what the models have in common that have one."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from flowsplat.gaussians.motion.protocol import MotionState, Parameter, Params, presence
from flowsplat.gaussians.motion.sharing import SharedMotion, SharedParameter

OFFSET_NUMBERS = 7
"""What a field says: how the mean [3] and the quaternion [4] change."""


@dataclass(frozen=True)
class FieldMotion(SharedMotion):
    """mu(t) = mean + D(x, t) - D(x, mu_t), and q(t) of the same form, with a field D that all Gaussians share.

    A Gaussian asks it at its own place x, ``anchors`` [N, 3], which begins at its mean. In the papers that is the mean itself, and
    mu(t) = x + D(x, t): a canonical scene outside of time. Here Gaussians begin at many times, each where it was seen, and density
    control expects them there; so the mean stays where a Gaussian is at its center time, and x is a parameter of its own. Scales do
    not change in time, which neither the page nor the cull could show.
    """

    @property
    def parameters(self) -> dict[str, Parameter]:
        """See ``MotionModel``."""
        return {**super().parameters, "anchors": Parameter((3,), "motion", moves=True)}

    @abstractmethod
    def ask(self, anchors: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Return [N, ``OFFSET_NUMBERS``] what the field says of places [N, 3] at times [N], and its derivative in time."""

    def start(
        self, means: Tensor, times: Tensor, quats: Tensor, scales: Tensor, log_lambdas: Tensor, coefficients: Tensor
    ) -> dict[str, Tensor]:  # fmt: skip
        """See ``MotionModel``."""
        return {**super().start(means, times, quats, scales, log_lambdas, coefficients), "anchors": means.clone()}

    def state(self, params: Params, t: float | Tensor) -> MotionState:
        """See ``MotionModel``."""
        times, anchors = params["times"], params["anchors"]
        now, rate = self.ask(anchors, torch.as_tensor(t, dtype=times.dtype, device=times.device).expand_as(times))
        since = now - self.ask(anchors, times)[0]
        return MotionState(
            means=params["means"] + since[:, :3],
            velocities=rate[:, :3],
            presence=presence(times, params["log_lambdas"], t),
            quats=params["quats"] + since[:, 3:],
            scales=torch.exp(params["log_scales"]),
        )


# -- networks


def layer_parameters(widths: Sequence[int], rate: float) -> dict[str, SharedParameter]:
    """Return the weights [out, in] and biases [out] of a network whose layers have these widths, the input first; the last has no
    bias, which all times would have in common."""
    found = {}
    for k, (before, after) in enumerate(pairwise(widths)):
        found[f"weights_{k}"] = SharedParameter((after, before), rate)
        if k < len(widths) - 2:
            found[f"biases_{k}"] = SharedParameter((after,), rate)
    return found


def initial_layers(widths: Sequence[int], generator: torch.Generator, last: float) -> dict[str, Tensor]:
    """Return weights drawn as He et al. do for ReLU (https://arxiv.org/abs/1502.01852), those of the last layer ``last`` times as
    large."""
    found = {}
    for k, (before, after) in enumerate(pairwise(widths)):
        drawn = torch.randn(after, before, generator=generator) * (2 / before) ** 0.5
        if k < len(widths) - 2:
            found[f"weights_{k}"], found[f"biases_{k}"] = drawn, torch.zeros(after)
        else:
            found[f"weights_{k}"] = last * drawn
    return found


def apply_layers(layers: Mapping[str, Tensor], inputs: Tensor, rates: Tensor) -> tuple[Tensor, Tensor]:
    """Return [N, out] what a network with ReLU makes of inputs [N, in], and its derivative where theirs is ``rates`` [N, in]."""
    last = len(layers) // 2
    for k in range(last):
        inputs, rates = inputs @ layers[f"weights_{k}"].T + layers[f"biases_{k}"], rates @ layers[f"weights_{k}"].T
        inputs, rates = torch.relu(inputs), rates * (inputs > 0)
    return inputs @ layers[f"weights_{last}"].T, rates @ layers[f"weights_{last}"].T
