"""The optimizer of all parameters, and the one place that picks who computes its step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import torch
from torch import Tensor

from flowsplat.common import devices
from flowsplat.common.devices import Kernels


class AdamKernels(Protocol):
    """What each of the twins has."""

    def step_rows(
        self, value: Tensor, mean: Tensor, square: Tensor, counts: Tensor, rows: Tensor, stepped: Tensor, gradient: Tensor,
        rates: Tensor,
    ) -> None:  # fmt: skip
        """As in ``reference``."""


def _twin(kernels: Kernels) -> AdamKernels:
    """Pick the backend that computes it, imported only where that is needed."""
    if kernels == "cpu":
        from flowsplat.training.adam import cpu

        return cpu
    if kernels == "triton":
        from flowsplat.training.adam import triton

        return triton
    from flowsplat.training.adam import reference

    return reference


class RowAdam:
    """Adam whose moments and step counts belong to rows: a Gaussian without a gradient is not touched at all.

    Where every row has a gradient in every step this is torch's Adam. Where not, a row that is absent keeps its moments
    instead of letting them decay, and its bias correction counts its own steps: each Gaussian sees the Adam of the frames
    that showed it (as the selective Adam of "Taming 3DGS" and gsplat does, there with the common step count).
    """

    def __init__(self, params: Mapping[str, Tensor]):
        self.means = {name: torch.zeros_like(value) for name, value in params.items()}
        self.squares = {name: torch.zeros_like(value) for name, value in params.items()}
        first = next(iter(params.values()))
        self.counts = torch.zeros(len(first), dtype=torch.int32, device=first.device)
        self._restarted: dict[str, Tensor] = {}

    def begin_step(self, rows: Tensor, stepped: Tensor) -> None:
        """Count one step for those of the rows [A] (each at most once) that are to be stepped [A] bool."""
        self.counts[rows] += stepped.to(self.counts.dtype)

    def restart(self, name: str) -> None:
        """Forget the moments of the parameter ``name`` and begin its bias correction anew.

        For values that were changed by other means than a step: their moments still point to where the old ones went. The step
        counts belong to all parameters of a row, so what each row had counted by now is kept and left out from here on.
        """
        self.means[name].zero_()
        self.squares[name].zero_()
        self._restarted[name] = self.counts.clone()

    def step(self, name: str, value: Tensor, rows: Tensor, stepped: Tensor, gradient: Tensor, rates: Tensor) -> None:
        """Step the parameter ``name`` in place.

        Args:
            name: of the parameter, whose moments these are.
            value: [N, ...], of D numbers a row.
            rows: [A] int64.
            stepped: [A] bool; the other rows are left alone, as if they were not named, and may be -1, padding.
            gradient: [A, ...] of the rows.
            rates: [D] learning rates.
        """
        if len(rows) == 0 or value[0].numel() == 0:
            return
        _twin(devices.kernels_for(value)).step_rows(
            value.view(len(value), -1), *self.moments(name), rows, stepped, gradient.reshape(len(rows), -1), rates
        )

    def moments(self, name: str) -> tuple[Tensor, Tensor, Tensor]:
        """Return a parameter's [N, D] first and second moments, themselves, and the steps [N] that each row has taken."""
        count = len(self.counts)
        counts = self.counts - self._restarted[name] if name in self._restarted else self.counts
        return self.means[name].view(count, -1), self.squares[name].view(count, -1), counts

    def reindex(self, index: Tensor, is_new: Tensor) -> None:
        """After density control: row k comes from old row ``index[k]``; new rows [M] bool start with empty moments."""
        for moments in (self.means, self.squares):
            for name, value in moments.items():
                moments[name] = value[index]
                moments[name][is_new] = 0
        self.counts = self.counts[index]
        self.counts[is_new] = 0
        for name, counted in self._restarted.items():
            self._restarted[name] = counted[index]
            self._restarted[name][is_new] = 0

    def state(self) -> dict[str, Tensor]:
        """Return every tensor by name, for a checkpoint."""
        state = {f"mean.{name}": value for name, value in self.means.items()}
        state |= {f"square.{name}": value for name, value in self.squares.items()}
        state |= {f"restarted.{name}": value for name, value in self._restarted.items()}
        return {**state, "counts": self.counts}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """The inverse of ``state``."""
        self.means = {name: state[f"mean.{name}"] for name in self.means}
        self.squares = {name: state[f"square.{name}"] for name in self.squares}
        self.counts = state["counts"]
        self._restarted = {name: state[f"restarted.{name}"] for name in self.means if f"restarted.{name}" in state}
