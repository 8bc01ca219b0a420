"""The history of a training: figures of its steps, a few steps to an entry."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

Figures = dict[str, float | Tensor]
"""Figures of a step by name; tensors of the GPU as long as the host need not know them."""

RECORD_EVERY = 10
"""Steps that one entry of the history averages over. Chosen by eye."""


@dataclass
class History:
    """Figures of training.

    Attributes:
        entries: one every ``RECORD_EVERY`` steps: step, loss, psnr, gaussians, active, and those of the terms of the loss.
        recent: figures of the steps since the last one.
    """

    entries: list[dict[str, float]] = field(default_factory=list)
    recent: list[Figures] = field(default_factory=list)

    def add(self, step: int, figures: Figures, gaussians: int, is_last: bool) -> dict[str, float] | None:
        """Add the figures of a step; return the new entry where one is due."""
        self.recent.append(figures)
        if step % RECORD_EVERY and not is_last:
            return None
        recent = read_figures(self.recent)
        # Those of a checkpoint that somebody changed may lack one.
        mean = {name: float(np.mean([each[name] for each in recent if name in each])) for name in figures}
        self.entries.append({"step": float(step), **mean, "gaussians": float(gaussians)})
        self.recent = []
        return self.entries[-1]

    def values(self) -> dict[str, Any]:
        """Return everything, for a checkpoint. Waits for a GPU."""
        return {"recent": read_figures(self.recent), "history": self.entries}

    @staticmethod
    def restore(values: Mapping[str, Any]) -> History:
        """Return the inverse of ``values``.

        Raises:
            KeyError: an entry is of no step, or has no PSNR, which the progress of a training shows.
        """
        for entry in values["history"]:
            _ = entry["step"], entry["psnr"]
        return History(values["history"], [{**entry} for entry in values["recent"]])


def mean_figures(found: list[Figures]) -> Figures:
    """Return the mean of several frames' figures, by name."""
    return {name: _mean([figures[name] for figures in found]) for name in found[0]}


def _mean(values: list[float | Tensor]) -> float | Tensor:
    numbers = [value for value in values if not isinstance(value, Tensor)]
    return float(np.mean(numbers)) if len(numbers) == len(values) else sum(values) / len(values)


def read_figures(found: list[Figures]) -> list[dict[str, float]]:
    """Return figures as numbers: waits for those that are still on a device, for all of them once."""
    tensors = [value.double() for figures in found for value in figures.values() if isinstance(value, Tensor)]
    numbers = iter(torch.stack(tensors).tolist() if tensors else [])
    return [{name: next(numbers) if isinstance(value, Tensor) else value for name, value in each.items()} for each in found]
