"""Train a field for a number of seconds; called again, it continues with the same bits."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from flowsplat.common.files import make_folder
from flowsplat.common.progress import report
from flowsplat.common.stopping import Stopped, stop_requests
from flowsplat.training.checkpoint import read_tensors, write_tensors
from flowsplat_benchmarks.fields.networks import Field, FieldConfig, FieldName, make_field
from flowsplat_benchmarks.fields.rays import TrainingRays
from flowsplat_benchmarks.fields.volume import render_rays

PACE_STEPS = 3
"""Steps of another, equal field that are timed to know how many fit into the seconds; one more before them, for what only the first
step takes."""
CHECKPOINT_SECONDS = 120.0
"""Of training between two checkpoints, which is what a kill can cost."""
REPORT_SECONDS = 60.0
"""Between two lines on the training."""
CHECKPOINT = "checkpoint.safetensors"


@dataclass(frozen=True)
class Plan:
    """What is trained.

    Attributes:
        name: which field.
        config: its architecture.
        seed: of its first weights and of all that is drawn.
        seconds: by the clock, after which it ends.
        key: a short name of everything that it depends on; a checkpoint with another one is not continued.
    """

    name: FieldName
    config: FieldConfig
    seed: int
    seconds: float
    key: str


@dataclass(frozen=True)
class Trained:
    """A trained field.

    Attributes:
        field: itself.
        steps: how many were made.
        planned: how many there were to be, from which the learning rate and the annealing follow.
        seconds: by the clock, that they took.
        processor_seconds: of all cores.
        loss: mean squared error of the fine template in the last step.
    """

    field: Field
    steps: int
    planned: int
    seconds: float
    processor_seconds: float
    loss: float


class FieldTrainer:
    """Adam on the squared error of random rays, of the coarse and of the fine template.

    Attributes:
        field: what is trained.
        step: steps that were made.
        planned: how many there will be.
        loss: mean squared error of the fine template in the last step; 0 before the first one.
    """

    def __init__(self, data: TrainingRays, plan: Plan, planned: int):
        self.field = make_field(plan.name, data.frame_times, plan.config, plan.seed)
        self.step, self.planned, self.loss = 0, planned, 0.0
        self._data, self._config = data, plan.config
        self._parameters = dict(self.field.named_parameters())
        self._optimizer = torch.optim.Adam(self._parameters.values(), lr=plan.config.rate)
        self._generator = torch.Generator().manual_seed(plan.seed + 1)

    def advance(self) -> None:
        """Make one step."""
        config, progress = self._config, self.step / self.planned
        self.field.progress = progress
        for group in self._optimizer.param_groups:
            group["lr"] = config.rate * (config.last_rate / config.rate) ** progress
        rays, colors = self._data.draw(config.rays, self._generator)
        data = self._data
        coarse, fine = render_rays(self.field, rays, data.near, data.far, config.samples, config.importance, self._generator)
        errors = [((shown.color - colors) ** 2).mean() for shown in (coarse, fine)]
        self._optimizer.zero_grad(set_to_none=True)
        (errors[0] + errors[1]).backward()
        self._optimizer.step()
        self.step, self.loss = self.step + 1, float(errors[1].detach())

    def save(self, path: Path, key: str, seconds: float, processor_seconds: float) -> None:
        """Write all that the next step depends on, and the seconds that were spent."""
        tensors: dict[str, Tensor] = {f"field.{name}": value.detach() for name, value in self._parameters.items()}
        for name, value in self._parameters.items():
            tensors |= {f"adam.{name}.{kind}": number for kind, number in self._optimizer.state[value].items()}
        tensors["generator"] = self._generator.get_state()
        write_tensors(
            path, tensors,
            {
                "key": key, "step": self.step, "planned": self.planned, "loss": self.loss, "seconds": seconds,
                "processor_seconds": processor_seconds,
            },
        )  # fmt: skip

    def load(self, tensors: Mapping[str, Tensor], values: Mapping[str, Any]) -> None:
        """Take back what ``save`` wrote."""
        with torch.no_grad():
            for name, value in self._parameters.items():
                value.copy_(tensors[f"field.{name}"])
                start = f"adam.{name}."
                state = {key.removeprefix(start): tensor for key, tensor in tensors.items() if key.startswith(start)}
                if state:
                    self._optimizer.state[value] = state
        self._generator.set_state(tensors["generator"])
        self.step, self.loss = int(values["step"]), float(values["loss"])


def plan_steps(data: TrainingRays, plan: Plan) -> int:
    """Return how many steps fit into the seconds of a plan, 1 or more, from the time of a few."""
    timed = FieldTrainer(data, plan, 2 * PACE_STEPS)
    timed.advance()
    began = time.perf_counter()
    for _ in range(PACE_STEPS):
        timed.advance()
    return max(1, round(plan.seconds / max((time.perf_counter() - began) / PACE_STEPS, 1e-9)))


def train_field(data: TrainingRays, plan: Plan, folder: Path, steps: int | None = None) -> Trained:
    """Train a field until its steps or its seconds are over, whichever is first; what a checkpoint has is not done again.

    How many steps there will be is found once, from the time of a few, because the learning rate and the annealing follow from it.
    A training that was stopped and continued has the same bits as one that was not, if it makes as many steps.

    Args:
        folder: for the checkpoint.
        steps: how many there will be, whatever time they take; None = as many as fit.

    Raises:
        Stopped: one of the signals came; the checkpoint is written.
        InputError: the checkpoint is damaged, or the folder cannot be written.
    """
    path = make_folder(folder) / CHECKPOINT
    tensors, values = read_tensors(path) if path.exists() else ({}, {})
    is_continued = values.get("key") == plan.key
    planned = int(values["planned"]) if is_continued else steps or plan_steps(data, plan)
    trainer = FieldTrainer(data, plan, planned)
    spent, processor = 0.0, 0.0
    if is_continued:
        trainer.load(tensors, values)
        spent, processor = float(values["seconds"]), float(values["processor_seconds"])
        report(f"{plan.name} continues after step {trainer.step:,} of {planned:,}.")
    began, began_processor = time.perf_counter() - spent, time.process_time() - processor
    saved = told = spent

    def is_over() -> bool:
        return trainer.step >= planned or (steps is None and trainer.step > 0 and time.perf_counter() - began >= plan.seconds)

    def save() -> None:
        trainer.save(path, plan.key, time.perf_counter() - began, time.process_time() - began_processor)

    with stop_requests() as request:
        while not is_over():
            trainer.advance()
            now = time.perf_counter() - began
            if request.signal is not None:
                save()
                report(f"Stopped after step {trainer.step:,} of {planned:,}. The same command continues there.")
                raise Stopped(request.signal)
            if now - saved >= CHECKPOINT_SECONDS:
                saved = now
                save()
            if now - told >= REPORT_SECONDS:
                told = now
                report(f"{plan.name}: step {trainer.step:,} of {planned:,}, {now:,.0f} of {plan.seconds:,.0f} seconds.")
    seconds, processor = time.perf_counter() - began, time.process_time() - began_processor
    if trainer.step > int(values.get("step", 0)) or not is_continued:
        trainer.save(path, plan.key, seconds, processor)
    trainer.field.progress = trainer.step / planned
    return Trained(trainer.field, trainer.step, planned, seconds, processor, trainer.loss)
