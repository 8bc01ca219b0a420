"""The mean of the parameters over the last steps of training."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import torch
from torch import Tensor

AVERAGE_STRIDE = 10
"""Steps between two that count; the last one does (docs/method/training.md)."""


class TailAverage:
    """Sums up parameters, so that training can end at their mean instead of wherever its last step led.

    Every step follows the gradient of one frame and goes too far for the others; the mean of many has less of that noise, and
    rates may stay high to the end (Polyak and Juditsky, https://doi.org/10.1137/0330046; SWA, https://arxiv.org/abs/1803.05407).

    Attributes:
        count: how often parameters were added.
    """

    def __init__(self) -> None:
        self.count = 0
        self._sums: dict[str, Tensor] = {}

    @torch.no_grad()
    def add(self, params: Mapping[str, Tensor]) -> None:
        """Count the parameters as they are now."""
        if not self._sums:
            self._sums = {name: torch.zeros_like(value) for name, value in params.items()}
        for name, total in self._sums.items():
            total += params[name]
        self.count += 1

    def restart(self) -> None:
        """Forget everything: some parameters were changed by other means than a step."""
        self.count, self._sums = 0, {}

    def reindex(self, index: Tensor, is_new: Tensor, shared: Collection[str] = ()) -> None:
        """After density control: row k comes from old row ``index[k]``; new rows have no past, so all begins anew.

        ``shared``: parameters that have no rows.
        """
        if bool(is_new.any()):
            self.restart()
        self._sums = {name: total if name in shared else total[index] for name, total in self._sums.items()}

    @torch.no_grad()
    def write(self, params: Mapping[str, Tensor]) -> None:
        """Put the mean into the parameters, in place; does nothing if there is none."""
        for name, total in self._sums.items():
            params[name].copy_(total / self.count)

    def state(self) -> dict[str, Tensor]:
        """Return every sum by name, for a checkpoint."""
        return dict(self._sums)

    def load_state(self, count: int, state: Mapping[str, Tensor]) -> None:
        """The inverse of ``state`` and ``count``."""
        self.count, self._sums = count, dict(state)
