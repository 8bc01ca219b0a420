"""What looks at a training after every step: its history, preview images and checkpoints."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import torch
from torch import Tensor

from flowsplat.common.errors import InputError
from flowsplat.common.files import check_json, write_json
from flowsplat.common.progress import report
from flowsplat.common.settings import to_plain
from flowsplat.gaussians.observations import Observation
from flowsplat.gaussians.render import RenderedFrame
from flowsplat.training.checkpoint import (
    CheckpointFile,
    check_model,
    check_training_state,
    latest_checkpoint,
    read_tensors,
    write_tensors,
)
from flowsplat.training.config import TrainConfig, select_result_settings
from flowsplat.training.frame_order import FrameOrder
from flowsplat.training.history import Figures
from flowsplat.training.state import TrainState
from flowsplat.training.step import StepOutput
from flowsplat.training.strategies.protocol import Strategy
from flowsplat.training.timing import CheckpointTimes

Preview = Callable[[int, Observation, RenderedFrame], None]
Record = Callable[[dict[str, float]], None]


class Callback(Protocol):
    """What is called after every step."""

    def __call__(self, state: TrainState, step: StepOutput, figures: Figures, /) -> None:
        """Look at a step.

        Args:
            state: after it.
            step: its last frame as it was rendered, before the optimizer's step.
            figures: means over its frames.
        """
        ...


class HistoryCallback:
    """Adds to the history, and tells somebody of every new entry."""

    def __init__(self, iterations: int, record: Record | None):
        """``record``: called with each entry."""
        self._iterations, self._record = iterations, record

    def __call__(self, state: TrainState, step: StepOutput, figures: Figures) -> None:
        """See ``Callback``.

        Raises:
            InputError: the loss is not finite.
        """
        entry = state.history.add(state.step, figures, step.count, state.step == self._iterations)
        if entry is not None and not math.isfinite(entry["loss"]):
            wrong = [name for name, value in entry.items() if name != "loss" and not math.isfinite(value)]
            raise InputError(
                f"The loss is no number at step {state.step} (not finite: {', '.join(wrong) or 'the sum of its terms'})."
            )
        if entry is not None and self._record is not None:
            self._record(entry)


class PreviewCallback:
    """Shows the first frame that is rendered, and one every so many steps."""

    def __init__(self, every: int, show: Preview):
        """``every``: steps between two."""
        self._every, self._show = every, show

    def __call__(self, state: TrainState, step: StepOutput, figures: Figures) -> None:
        """See ``Callback``."""
        if step.step % self._every == 0:
            self._show(step.step, step.observations[step.frame], step.rendered)


class Checkpoints:
    """Keeps the last checkpoint of a training in a folder."""

    def __init__(self, folder: Path, config: TrainConfig):
        """``folder``: made when the first one is written."""
        self.folder, self._config = folder, config

    def __call__(self, state: TrainState, step: StepOutput, figures: Figures) -> None:
        """See ``Callback``."""
        if self._times.is_due(state.step, began := clock.perf_counter()) and state.step < self._config.iterations:
            self.save(state)
            now = clock.perf_counter()
            self._times.note_written(now, now - began)

    def save(self, state: TrainState) -> None:
        """Write one, and delete those before it."""
        name = f"step_{state.step:06d}.safetensors"
        write_tensors(self.folder / name, state.tensors(), {**state.values(), "config": to_plain(self._config)})
        write_json(self.folder / "latest.json", {"file": name, "step": state.step, "written": clock.time()})
        for old in self.folder.glob("*step_*.safetensors"):
            if old.name != name:
                old.unlink()

    def load(self, order: FrameOrder, strategy: Strategy, device: torch.device) -> TrainState | None:
        """Return the last one, if there is one; from now on the time until the next one counts.

        Args:
            order: of the frames; brought to where it was.
            strategy: whose statistics it must hold.
            device: to train on.

        Raises:
            InputError: it is damaged, or was written with other settings.
        """
        self._times = CheckpointTimes(self._config.checkpoint_every, clock.perf_counter())
        if not (self.folder / "latest.json").exists():
            return None
        path = latest_checkpoint(self.folder)
        if not path.exists():  # a damaged one, which was deleted
            return None
        tensors, values = read_tensors(path)
        check_json(path, values, CheckpointFile)
        if select_result_settings(values["config"]) != select_result_settings(to_plain(self._config)):
            raise InputError(f"{path} was written with other training settings. Use another output folder, or delete it.")
        try:
            state = TrainState.restore(tensors, values, self._config.model, order, device)
            check_model(path, state.gaussians)
            check_training_state(path, tensors, state.gaussians, _initial_statistics(state, strategy))
        except (KeyError, ValueError, TypeError, RuntimeError, AttributeError, ArithmeticError) as error:
            raise InputError(f"{path} is incomplete: {error}. Delete {path.parent} to train from the beginning.") from error
        report(f"Going on from step {state.step} of {self._config.iterations}.")
        return state


def _initial_statistics(state: TrainState, strategy: Strategy) -> dict[str, Tensor]:
    """Return what a strategy keeps for every Gaussian, before it has seen any: names, shapes and types."""
    kept, state.statistics = state.statistics, {}
    strategy.initialize_state(state)
    expected, state.statistics = state.statistics, kept
    return expected
