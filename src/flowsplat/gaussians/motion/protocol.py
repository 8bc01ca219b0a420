"""Define what every motion model offers.

A model says which parameters it has and gives the state of its Gaussians at a time. Everything else, from the first Gaussians to
the exported page, asks it and knows none of its parameters by name; only the fused kernels do, of the models that have some.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, Protocol

import torch
from torch import Tensor

from flowsplat.gaussians.model_config import MOTION_MODELS, ModelConfig

Params = Mapping[str, Tensor]
RateGroup = Literal["rotation", "scale", "precision", "motion"]
FusedKernels = Literal["series"]


@dataclass(frozen=True)
class Parameter:
    """One parameter of a model.

    Attributes:
        shape: of one Gaussian's value.
        rate: whose learning rate it has: that of rotations, scales, temporal precision or motion.
        moves: only Gaussians that move use it, not those at rest.
        fades: ``log_precision`` depends on it.
        powers: its first dimension counts powers of time from 1 on, so that its numbers depend on the unit of time.
    """

    shape: tuple[int, ...]
    rate: RateGroup
    moves: bool = False
    fades: bool = False
    powers: bool = False


@dataclass(frozen=True)
class Shape:
    """What Gaussians at rest look like. Either ``quats`` and ``scales`` are given, or ``covars``.

    Attributes:
        quats: [N, 4] not normalized.
        scales: [N, 3]
        covars: [N, 3, 3]
    """

    quats: Tensor | None = None
    scales: Tensor | None = None
    covars: Tensor | None = None


@dataclass(frozen=True)
class MotionState:
    """Gaussians at one time. Either ``quats`` and ``scales`` are given, or ``covars``.

    Attributes:
        means: [N, 3]
        velocities: [N, 3] d mean / dt, per clip length.
        presence: [N] p(t), between 0 and 1.
        quats: [N, 4] not normalized.
        scales: [N, 3]
        covars: [N, 3, 3]
    """

    means: Tensor
    velocities: Tensor
    presence: Tensor
    quats: Tensor | None = None
    scales: Tensor | None = None
    covars: Tensor | None = None


class MotionModel(Protocol):
    """What every motion model offers. ``RigidMotion`` has most of it for Gaussians that keep their scales."""

    @property
    def parameters(self) -> dict[str, Parameter]:
        """The parameters that the model needs besides ``means`` [N, 3] and ``times`` [N], the center times."""
        ...

    @property
    def kernels(self) -> FusedKernels | None:
        """Which fused kernels slice it; None = none do, and the plain slice is used."""
        ...

    def log_precision(self, params: Params) -> Tensor:
        """Return [N] log of lambda, the temporal precision, from ``times`` and the parameters that fade."""
        ...

    def state(self, params: Params, t: float | Tensor) -> MotionState:
        """Return the Gaussians at clip time ``t``, or each [N] at its own."""
        ...

    def at_rest(self, params: Params) -> Shape:
        """Return the shapes at the center times, from ``means`` and the parameters that do not move, in the form that ``state``
        gives."""
        ...

    def log_scales(self, params: Params) -> Tensor | None:
        """Return [N, 3] log of the scales where these are parameters that no time changes, for the cull; None = there are none."""
        ...

    def start(
        self, means: Tensor, times: Tensor, quats: Tensor, scales: Tensor, log_lambdas: Tensor, coefficients: Tensor
    ) -> dict[str, Tensor]:  # fmt: skip
        """Parameters for the first Gaussians, as far as they do not begin at 0, without means and times.

        Args:
            means: [N, 3] where they are at their center times.
            times: [N] these.
            quats: [N, 4] their rotations.
            scales: [N, 3]
            log_lambdas: [N] log of their temporal precision.
            coefficients: [N, order, 3] a_n of mu(t) = mean + sum a_n tau^n, which was fitted to what they follow; order may be 0.
        """
        ...

    def recenter(self, params: Params, shift: Tensor) -> dict[str, Tensor]:
        """Return the parameters that describe the same motion about the center times moved by ``shift`` [N]."""
        ...

    def with_precision(self, params: Params, log_lambda: float) -> dict[str, Tensor]:
        """Return the parameters of the same Gaussians with another temporal precision."""
        ...

    def shrunk(self, params: Params, log_factor: float, in_time: Tensor) -> dict[str, Tensor]:
        """Return the parameters of Gaussians exp(``log_factor``) times smaller, and as much shorter where ``in_time`` [N] bool."""
        ...


Maker = Callable[[ModelConfig], MotionModel]


def register(name: str, title: str, sentence: str) -> Callable[[Maker], Maker]:
    """Decorate what makes a model from the settings: ``--train.model.kind`` finds it by this name.

    Raises:
        ValueError: as ``Registry.add``.
    """
    return MOTION_MODELS.register(name, title, sentence)


def motion_model(settings: ModelConfig) -> MotionModel:
    """Return the motion model that these settings describe; a series of which neither means nor rotations are left is the linear
    one.

    Raises:
        InputError: there is none of that kind.
    """
    neither = settings.kind == "series" and not settings.move_means and not settings.move_quats
    kind = "linear" if neither else settings.kind
    model: MotionModel = MOTION_MODELS[kind](settings)
    return model


def presence(times: Tensor, log_lambdas: Tensor, t: float | Tensor) -> Tensor:
    """p(t) = exp(-lambda (t - mu_t)^2 / 2) [N]."""
    tau = t - times
    return torch.exp(-0.5 * torch.exp(log_lambdas) * tau * tau)
