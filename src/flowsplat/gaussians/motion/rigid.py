"""Share what models have in common whose Gaussians keep their scales: rotation, scales and temporal precision are parameters of
their own."""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from torch import Tensor

from flowsplat.gaussians.motion.protocol import FusedKernels, MotionState, Parameter, Params, Shape


class RigidMotion(ABC):
    """A model without its motion: subclasses add its parameters and ``state``, and what of it has a start.

    As it is, ``start`` leaves all motion at 0, and ``recenter`` is that of models that are asked for absolute times.
    """

    @abstractmethod
    def state(self, params: Params, t: float | Tensor) -> MotionState:
        """See ``MotionModel``."""

    @property
    def parameters(self) -> dict[str, Parameter]:
        """See ``MotionModel``."""
        return {
            "log_lambdas": Parameter((), "precision", moves=True, fades=True),
            "quats": Parameter((4,), "rotation"),
            "log_scales": Parameter((3,), "scale"),
        }

    @property
    def kernels(self) -> FusedKernels | None:
        """None: see ``MotionModel``."""
        return None

    def log_precision(self, params: Params) -> Tensor:
        """See ``MotionModel``."""
        return params["log_lambdas"]

    def at_rest(self, params: Params) -> Shape:
        """See ``MotionModel``."""
        return Shape(params["quats"], torch.exp(params["log_scales"]))

    def log_scales(self, params: Params) -> Tensor | None:
        """See ``MotionModel``."""
        return params["log_scales"]

    def start(
        self, means: Tensor, times: Tensor, quats: Tensor, scales: Tensor, log_lambdas: Tensor, coefficients: Tensor
    ) -> dict[str, Tensor]:  # fmt: skip
        """See ``MotionModel``."""
        return {"quats": quats, "log_scales": torch.log(scales), "log_lambdas": log_lambdas}

    def recenter(self, params: Params, shift: Tensor) -> dict[str, Tensor]:
        """See ``MotionModel``."""
        times = params["times"] + shift
        moved = self.state(params, times)
        assert moved.quats is not None
        return {**params, "means": moved.means, "quats": moved.quats, "times": times}

    def with_precision(self, params: Params, log_lambda: float) -> dict[str, Tensor]:
        """See ``MotionModel``."""
        return {**params, "log_lambdas": torch.full_like(params["log_lambdas"], log_lambda)}

    def shrunk(self, params: Params, log_factor: float, in_time: Tensor) -> dict[str, Tensor]:
        """See ``MotionModel``."""
        log_lambdas = torch.where(in_time, params["log_lambdas"] + 2 * log_factor, params["log_lambdas"])
        return {**params, "log_scales": params["log_scales"] - log_factor, "log_lambdas": log_lambdas}
