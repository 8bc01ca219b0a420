"""All that training changes, which is all that a checkpoint holds; and the one place that re-indexes it when rows change."""

from __future__ import annotations

import time as clock
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from flowsplat.gaussians.density import DensityResult
from flowsplat.gaussians.gaussians4d import Gaussians4D
from flowsplat.gaussians.model_config import ModelConfig
from flowsplat.training.adam import RowAdam
from flowsplat.training.frame_order import FrameOrder
from flowsplat.training.history import History
from flowsplat.training.rigidity import Neighbors
from flowsplat.training.weight_averaging import TailAverage

MAX_ALONE_SHARE = 0.01
"""Share of the dynamic Gaussians that may be without neighbors until the next search, which takes as long as tens of steps
(docs/method/training.md)."""


@dataclass
class TrainState:
    """A training after some steps.

    Attributes:
        gaussians: the model so far.
        order: of the training frames.
        generator: of random numbers, on the host; strategies draw from it.
        step: steps done.
        optimizer: moments and step counts of every Gaussian.
        shared_optimizer: those of what Gaussians share, each a single row; None = they share nothing.
        average: the mean of the parameters over the last steps.
        statistics: by name, [N, ...] what the strategy keeps for every Gaussian.
        neighbors: of the rigid loss, None = to be found.
        neighbors_found: at which step they were.
        history: figures of the steps.
        earlier_seconds: what earlier processes took for the steps that this one went on from.
        revision: another number wherever rows changed, or which of them move.
        began: when this process did, on the clock ``time.perf_counter``.
    """

    gaussians: Gaussians4D
    order: FrameOrder
    generator: torch.Generator
    step: int = 0
    optimizer: RowAdam = field(init=False)
    shared_optimizer: RowAdam | None = field(init=False, default=None)
    average: TailAverage = field(default_factory=TailAverage)
    statistics: dict[str, Tensor] = field(default_factory=dict)
    neighbors: Neighbors | None = None
    neighbors_found: int = 0
    history: History = field(default_factory=History)
    earlier_seconds: float = 0.0
    revision: int = 0
    began: float = field(default_factory=clock.perf_counter)

    def __post_init__(self) -> None:
        self.optimizer = RowAdam(self.gaussians.params)
        if self.gaussians.shared:
            self.shared_optimizer = RowAdam({name: value[None] for name, value in self.gaussians.shared.items()})

    @property
    def seconds(self) -> float:
        """Of all processes that had a part in it."""
        return self.earlier_seconds + clock.perf_counter() - self.began

    def adopt(self, result: DensityResult) -> None:
        """Go on with other Gaussians: all that belongs to rows follows them. New rows have no past.

        Raises:
            ValueError: the result does not say of every new row from which old one it comes, or whether it is new.
        """
        if result.gaussians is self.gaussians:
            return
        count, index, old = len(result.gaussians), result.index, len(self.gaussians)
        if len(index) != count or result.is_new.shape != index.shape or result.is_new.dtype != torch.bool:
            raise ValueError(f"{count:,} Gaussians need an index and an is_new (bool) of as many")
        if count and not 0 <= int(index.min()) <= int(index.max()) < old:
            raise ValueError(f"index must name old Gaussians, 0 to {old - 1}, not {int(index.min())} to {int(index.max())}")
        self.optimizer.reindex(result.index, result.is_new)
        if self.neighbors is not None:
            self.neighbors = self.neighbors.reindex(result.index)
        self.average.reindex(result.index, result.is_new, self.gaussians.shared)
        self.statistics = {name: value[result.index] for name, value in self.statistics.items()}
        for value in self.statistics.values():
            value[result.is_new] = 0
        self.gaussians = result.gaussians
        self.revision += 1

    def note_revised_motion(self) -> None:
        """Some of the Gaussians were told to move, or to rest: means over steps begin anew, and who has no neighbors needs some."""
        self.average.restart()
        # Those that became dynamic have no neighbors yet, and are those of none. A few can wait for the next search.
        dynamic = self.gaussians.dynamic
        if self.neighbors is not None and float(self.neighbors.alone[dynamic].float().mean()) > MAX_ALONE_SHARE:
            self.neighbors = None
        self.revision += 1

    # -- as a checkpoint holds it

    def tensors(self) -> dict[str, Tensor]:
        """Return every tensor by name."""
        gaussians = self.gaussians
        tensors = {f"param.{name}": value for name, value in gaussians.params.items()}
        tensors |= {f"shared.{name}": value for name, value in gaussians.shared.items()}
        tensors |= {f"adam.{name}": value for name, value in self.optimizer.state().items()}
        if self.shared_optimizer is not None:
            tensors |= {f"shared_adam.{name}": value for name, value in self.shared_optimizer.state().items()}
        tensors |= {f"statistics.{name}": value for name, value in self.statistics.items()}
        tensors |= {f"average.{name}": value for name, value in self.average.state().items()}
        tensors |= {"dynamic": gaussians.dynamic, "object_ids": gaussians.object_ids, "generator": self.generator.get_state()}
        if self.neighbors is not None:
            tensors |= {"neighbors.indices": self.neighbors.indices, "neighbors.weights": self.neighbors.weights}
        return tensors

    def values(self) -> dict[str, Any]:
        """Return everything else, as JSON holds it."""
        return {
            "step": self.step,
            "sh_degree": self.gaussians.sh_degree,
            **self.order.values(),
            "neighbors_found": self.neighbors_found,
            "averaged": self.average.count,
            "seconds": self.seconds,
            **self.history.values(),
        }

    @staticmethod
    def restore(
        tensors: Mapping[str, Tensor], values: Mapping[str, Any], model: ModelConfig, order: FrameOrder, device: torch.device
    ) -> TrainState:
        """Return the inverse of ``tensors`` and ``values``.

        Args:
            tensors: by name.
            values: likewise.
            model: what the parameters mean.
            order: of the frames; brought to where it was.
            device: to train on.

        Raises:
            KeyError, ValueError, TypeError, RuntimeError, AttributeError: something is not as it was written.
        """

        def group(prefix: str) -> dict[str, Tensor]:
            chosen = {name[len(prefix) + 1 :]: value for name, value in tensors.items() if name.startswith(prefix + ".")}
            return {name: value.to(device) for name, value in chosen.items()}

        dynamic, object_ids = tensors["dynamic"].to(device), tensors["object_ids"].to(torch.uint8).to(device)
        gaussians = Gaussians4D(group("param"), dynamic, model, int(values["sh_degree"]), object_ids, shared=group("shared"))
        generator = torch.Generator()
        generator.set_state(tensors["generator"])
        order.restore(values)
        state = TrainState(gaussians, order, generator, int(values["step"]))
        state.optimizer.load_state(group("adam"))
        if state.shared_optimizer is not None:
            state.shared_optimizer.load_state(group("shared_adam"))
        state.average.load_state(int(values["averaged"]), group("average"))
        state.statistics = group("statistics")
        state.neighbors = Neighbors(**group("neighbors")) if "neighbors.indices" in tensors else None
        state.neighbors_found = int(values["neighbors_found"])
        state.history = History.restore(values)
        state.earlier_seconds = float(values["seconds"])
        return state
