"""Share parameters among all Gaussians of a model: bases, planes of features, the weights of a network.

They are no rows: density control leaves them alone, and every Gaussian that moves has a part in their gradient. ``Gaussians4D``
keeps them beside its rows (``shared``) and binds its model to them, so that ``state`` and all that asks it need not know of them.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor
from typing_extensions import Self

from flowsplat.gaussians.motion.protocol import Params
from flowsplat.gaussians.motion.rigid import RigidMotion

FIT_GAUSSIANS = 4096
"""Gaussians to whose paths the shared parameters are fitted at the start, at most; half of them rest where enough do. Chosen by
eye."""
FIT_STEPS = 150
"""Steps of Adam of that fit. Chosen by eye."""
FIT_RATE = 0.01
"""Learning rate of that fit at its start; it falls to 0 along a cosine. Chosen by eye."""
FIT_SIGMAS = (-1.0, -0.5, 0.5, 1.0)
"""At which times from its center, in standard deviations of its presence, the path of a Gaussian is asked for. Chosen by eye."""
MAX_FIT_SIGMA = 0.5
"""Of these standard deviations, at most, in clip lengths: what rests is always there, and is asked for within the clip."""


@dataclass(frozen=True)
class SharedParameter:
    """A parameter that all Gaussians share.

    Attributes:
        shape: of its value.
        rate: Adam's learning rate at the start, which falls like that of motion (``RatesConfig.motion_decay``); 0 = it is not
            learned, and ``SharedMotion.anneal`` sets it.
    """

    shape: tuple[int, ...]
    rate: float


@dataclass(frozen=True)
class SharedMotion(RigidMotion):
    """A model with shared parameters: a subclass names them and says how they begin.

    Attributes:
        shared: their values by name; empty until ``bind``.
    """

    shared: Mapping[str, Tensor] = field(default_factory=dict, kw_only=True, repr=False, compare=False)

    @property
    @abstractmethod
    def shared_parameters(self) -> dict[str, SharedParameter]:
        """All of them, by name; none has the name of a parameter of Gaussians."""

    def bind(self, shared: Mapping[str, Tensor]) -> Self:
        """Return the same model with these values."""
        return replace(self, shared=shared)

    def read_shared(self, name: str, like: Tensor) -> Tensor:
        """Return the value of one, in the type of ``like``: what looks at a trained scene may do so in float64."""
        return self.shared[name].to(like.dtype)

    @abstractmethod
    def initial_shared(self) -> dict[str, Tensor]:
        """Return values with which nothing moves, as training begins with them; float32, the same every time."""

    def anneal(self, progress: float) -> dict[str, float]:
        """Return what the shared parameters that are not learned become after this share of training, 0 to 1."""
        return {}

    def start_shared(self, params: Params, coefficients: Tensor, dynamic: Tensor) -> dict[str, Tensor]:
        """Return values with which the first Gaussians follow their paths, as nearly as some steps of Adam bring it.

        What rests has a part in that, with paths of 0: it would move from its first step on if it turned out not to be background.

        Args:
            params: of the first Gaussians, from ``start``.
            coefficients: [N, order, 3] a_n of mu(t) = mean + sum a_n tau^n, as in ``start``; order may be 0.
            dynamic: [N] bool, those that do not rest.
        """
        initial = self.initial_shared()
        if not bool(coefficients.any()):
            return initial
        rows = _draw(dynamic).repeat(len(FIT_SIGMAS))
        some, followed = {name: value[rows] for name, value in params.items()}, coefficients[rows]
        sigmas = coefficients.new_tensor(FIT_SIGMAS).repeat_interleave(len(rows) // len(FIT_SIGMAS))
        spans = sigmas * torch.exp(-0.5 * self.log_precision(some)).clamp(max=MAX_FIT_SIGMA)
        powers = torch.stack([spans ** (n + 1) for n in range(followed.shape[1])], 1)
        paths = torch.bmm(powers[:, None], followed)[:, 0]
        learned = [name for name, parameter in self.shared_parameters.items() if parameter.rate > 0]
        leaves = {name: value.to(paths.device, copy=True).requires_grad_(name in learned) for name, value in initial.items()}
        adam = torch.optim.Adam([leaves[name] for name in learned], FIT_RATE)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(adam, FIT_STEPS)
        model = self.bind(leaves)
        with torch.enable_grad():
            for _ in range(FIT_STEPS):
                moved = model.state(some, some["times"] + spans).means - some["means"]
                adam.zero_grad()
                (moved - paths).norm(dim=1).mean().backward()
                adam.step()
                schedule.step()
        return {name: value.detach() for name, value in leaves.items()}


def _draw(dynamic: Tensor) -> Tensor:
    """Return rows of at most ``FIT_GAUSSIANS`` Gaussians, the same every time: of those that rest and of those that do not half
    each, or fewer where there are no more."""
    generator = torch.Generator().manual_seed(0)
    kinds = [torch.nonzero(chosen).squeeze(1) for chosen in (dynamic, ~dynamic)]
    half = FIT_GAUSSIANS // 2
    rooms = [FIT_GAUSSIANS - min(half, len(other)) for other in kinds[::-1]]
    drawn = [rows[torch.randperm(len(rows), generator=generator)[:room].to(rows)] for rows, room in zip(kinds, rooms, strict=True)]
    return torch.cat(drawn)
