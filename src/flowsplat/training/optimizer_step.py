"""One step of the optimizer: along the mean gradient of some frames, at the rates of its place in the schedule."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from flowsplat.common.threads import in_one_launch
from flowsplat.gaussians.gaussians4d import Active, Gaussians4D
from flowsplat.gaussians.observations import Observations
from flowsplat.gaussians.slicing import Gradients
from flowsplat.training.adam import RowAdam
from flowsplat.training.ray_preconditioning import PathSpread, step_along_rays
from flowsplat.training.schedule import LearningRates
from flowsplat.training.state import TrainState


@dataclass(frozen=True)
class RowGradients:
    """What a step goes along.

    Attributes:
        active: the rows that have gradients.
        drawn: [A] bool, which of them are stepped.
        values: by parameter, of the rows that ``Gaussians4D.rows_of`` names.
        shared: of the parameters that Gaussians share, as far as they have one.
    """

    active: Active
    drawn: Tensor
    values: Gradients
    shared: Gradients = field(default_factory=dict)


class MeanGradient:
    """Sums up the gradients of the frames of a step."""

    def __init__(self, gaussians: Gaussians4D, frames: int, everyone: Active):
        """``everyone``: all rows."""
        self._gaussians, self._frames, self._everyone = gaussians, frames, everyone
        # The last one is where padding, -1, points to.
        count = len(gaussians)
        self._totals = {name: value.new_zeros(count + 1, *value.shape[1:]) for name, value in gaussians.params.items()}
        self._touched = torch.zeros(count + 1, dtype=torch.bool, device=gaussians.device)
        self._shared: Gradients = {}

    def add(self, found: RowGradients) -> None:
        """Add those of a frame; who was not drawn has none."""
        gaussians, active = self._gaussians, found.active
        for name, gradient in found.values.items():
            share = found.drawn[gaussians.part(name, active)].to(gradient.dtype) / self._frames
            self._totals[name][gaussians.rows_of(name, active)] += gradient * share.view(-1, *(1,) * (gradient.ndim - 1))
        self._touched[active.rows] |= found.drawn
        for name, gradient in found.shared.items():
            self._shared[name] = self._shared.get(name, 0) + gradient / self._frames

    def result(self) -> RowGradients:
        """Return their mean, of all rows."""
        active = self._everyone
        values = {name: total[self._gaussians.rows_of(name, active)] for name, total in self._totals.items()}
        return RowGradients(active, self._touched[active.rows], values, self._shared)


class OptimizerStep:
    """Steps every parameter that has a gradient; positions at rest in the axes of their rays."""

    def __init__(self, rates: LearningRates, observations: Observations, along_ray: float):
        """``along_ray``: as ``RatesConfig.along_ray``."""
        self._rates, self._focal, self._along_ray = rates, observations.focal, along_ray
        centers = np.array([frame.camera.center for frame in observations.frames], np.float32)
        self._path = PathSpread.of(torch.from_numpy(centers), rates.device)

    def __call__(self, state: TrainState, found: RowGradients) -> None:
        """Take it."""
        gaussians, optimizer, active, drawn = state.gaussians, state.optimizer, found.active, found.drawn
        optimizer.begin_step(active.valid(active.rows), active.valid(drawn))
        rates_at_rest = self._rates.at(state.step, gaussians)
        rates_moving = self._rates.at(state.step, gaussians, moving=True)
        with in_one_launch():
            for name, gradient in found.values.items():
                value, having = gaussians.params[name], gaussians.part(name, active)
                rows, stepped, at_rest = active.rows[having], drawn[having], active.num_static - (having.start or 0)
                given = optimizer, name, value, rows[:at_rest], stepped[:at_rest], gradient[:at_rest], rates_at_rest[name]
                if name == "means" and self._along_ray > 1:
                    step_along_rays(*given, self._path, self._focal, self._along_ray)
                else:
                    RowAdam.step(*given)
                optimizer.step(name, value, rows[at_rest:], stepped[at_rest:], gradient[at_rest:], rates_moving[name])
        if state.shared_optimizer is not None and found.shared:
            self._step_shared(state, state.shared_optimizer, found.shared)

    def _step_shared(self, state: TrainState, optimizer: RowAdam, gradients: Gradients) -> None:
        """Step what all Gaussians share, each parameter as one row."""
        rates = self._rates.of_shared(state.step, state.gaussians)
        row = torch.zeros(1, dtype=torch.int64, device=state.gaussians.device)
        stepped = torch.ones_like(row, dtype=torch.bool)
        optimizer.begin_step(row, stepped)
        for name, gradient in gradients.items():
            if name in rates:
                optimizer.step(name, state.gaussians.shared[name][None], row, stepped, gradient[None], rates[name])


def all_rows(gaussians: Gaussians4D) -> Active:
    """Return all of them, those at rest first. Waits for a GPU to count those."""
    rests = gaussians.at_rest
    resting = torch.nonzero(rests)
    return Active(torch.cat([resting, torch.nonzero(~rests)]).squeeze(1), len(resting), 0.0)
