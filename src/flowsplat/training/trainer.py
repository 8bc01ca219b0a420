"""The training loop (docs/method/training.md)."""

from __future__ import annotations

import time as clock
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NoReturn

import torch
from torch import Tensor

from flowsplat.common.devices import upload
from flowsplat.common.errors import InputError
from flowsplat.common.memory import keep_freed_memory
from flowsplat.common.progress import progress_bar, report, spinner
from flowsplat.common.stopping import Stopped, stop_requests
from flowsplat.gaussians.culling import RowCapacity
from flowsplat.gaussians.gaussians4d import Active, Gaussians4D
from flowsplat.gaussians.initialize import initialize
from flowsplat.gaussians.observations import Observations
from flowsplat.gaussians.render import RenderedFrame, render_active
from flowsplat.gaussians.slicing import Gradients
from flowsplat.scenes import Tracks
from flowsplat.training.callbacks import Callback, Checkpoints, HistoryCallback, Preview, PreviewCallback, Record
from flowsplat.training.config import TrainConfig
from flowsplat.training.frame_order import FrameOrder
from flowsplat.training.history import Figures, mean_figures
from flowsplat.training.optimizer_step import MeanGradient, OptimizerStep, RowGradients, all_rows
from flowsplat.training.photometric_loss import PhotometricTargets
from flowsplat.training.schedule import LearningRates
from flowsplat.training.state import TrainState
from flowsplat.training.step import StepOutput
from flowsplat.training.strategies import STRATEGIES
from flowsplat.training.strategies.protocol import Strategy
from flowsplat.training.targets import Targets
from flowsplat.training.weight_averaging import AVERAGE_STRIDE


class Trainer:
    """Trains 4D Gaussians on observations; can stop at any step and go on from its last checkpoint to the same bits.

    On a GPU the host runs ahead. Of a step it has to know two things only: whether there were enough rows for the active Gaussians
    (``RowCapacity``) and enough slots for their pairs with a tile (``splatting.triton.tiles.PairCapacity``). Both are counted
    before the Gaussians are blended, and read when there is more than that in the GPU's queue: the pairs after the forward pass,
    the Gaussians after the backward pass. Where there were too few, there are more from then on, and the frame is computed again
    before anything is changed. It does wait every ``history.RECORD_EVERY`` steps for the history, and where neighbors are searched,
    density is controlled, or a preview or a checkpoint is written.

    Attributes:
        state: all that is trained, once ``run`` or ``begin`` was called.
        callbacks: called after every step, in this order; more can be added.
        rates: the schedule of learning rates.
    """

    state: TrainState

    def __init__(
        self,
        observations: Observations,
        tracks: Tracks | None,
        config: TrainConfig,
        checkpoints: str | Path | None = None,
        preview: Preview | None = None,
        record: Record | None = None,
        start: Gaussians4D | None = None,
        device: torch.device | str = "cpu",
        first_step: int = 0,
        visits: Sequence[int] | None = None,
    ):
        """Prepare to train; nothing is computed before ``run``.

        Args:
            observations: training frames.
            tracks: for an initialization from tracks.
            config: every setting.
            checkpoints: folder to keep the last checkpoint in; None = none.
            preview: called every ``preview_every`` steps with a rendered frame.
            record: called with every new entry of the history.
            start: the Gaussians to start from; None = ``initialize``.
            device: what to train on. Its tensors stay there, ``gaussians`` too.
            first_step: how many steps ``start`` has behind it: rates and harmonics go on from there.
            visits: how often each frame is drawn in a round; None = once.

        Raises:
            InputError: a setting has a value that makes no sense.
        """
        config.check()
        self.observations, self.tracks, self.config, self.device = observations, tracks, config, torch.device(device)
        self._start, self._first_step, self._visits = start, first_step, visits
        self._targets = Targets(observations, config.loss.flow > 0, self.device)
        self._capacity = RowCapacity()
        self._everyone: tuple[int, Active] | None = None
        self.rates = LearningRates(config.rates, config.iterations, observations.focal, self.device)
        self._optimize = OptimizerStep(self.rates, observations, config.rates.along_ray)
        self._terms = config.loss.terms()
        self._strategy: Strategy = STRATEGIES[config.strategy](config, observations)
        self._checkpoints = None if checkpoints is None else Checkpoints(Path(checkpoints), config)
        self.callbacks: list[Callback] = [HistoryCallback(config.iterations, record)]
        if preview is not None and config.preview_every:
            self.callbacks.append(PreviewCallback(config.preview_every, preview))
        if self._checkpoints is not None:
            self.callbacks.append(self._checkpoints)

    @property
    def gaussians(self) -> Gaussians4D:
        """The model so far."""
        return self.state.gaussians

    @property
    def step(self) -> int:
        """Steps done."""
        return self.state.step

    @property
    def history(self) -> list[dict[str, float]]:
        """Entries of the history: see ``History``."""
        return self.state.history.entries

    # -- the loop

    def run(self) -> Gaussians4D:
        """Train from the last checkpoint, or from the beginning, to the end.

        Ctrl-C, SIGTERM and SIGHUP let the step end, and write a checkpoint.

        Raises:
            InputError: the last checkpoint is damaged or of other settings, or no Gaussian is left.
            Stopped: one of the signals came.
        """
        self.begin()
        state, config = self.state, self.config
        label = "Fitting" if self._first_step else "Training"
        with progress_bar(label, config.iterations, state.step) as bar, stop_requests() as request, keep_freed_memory():
            while state.step < config.iterations:
                output, figures = self.iterate()
                for callback in self.callbacks:
                    callback(state, output, figures)
                del output  # what was rendered: the next step needs as much memory again
                if request.signal is not None:
                    self._stop(request.signal)
                known = figures if isinstance(figures["psnr"], float) else self.history[-1] if self.history else None
                psnr = "" if known is None else f"PSNR {known['psnr']:.2f}  "
                bar.advance(1, f"{psnr}{len(state.gaussians):,} Gaussians")
        state.average.write(state.gaussians.values)
        return state.gaussians

    def iterate(self) -> tuple[StepOutput, Figures]:
        """Take one optimizer step over the next frames; return the last of them as it was rendered, and the figures of all."""
        state, config = self.state, self.config
        state.gaussians.sh_degree = min(state.gaussians.config.sh_degree, 4 * state.step // max(config.iterations, 1))
        # A scene that goes on is trained already: nothing is taken from it that came in while it was.
        state.gaussians.anneal(1.0 if self._first_step else state.step / max(config.iterations, 1))
        frames = state.order.take(config.frames_per_iteration or len(self.observations))
        for k in (*frames[1:2], *state.order.following):
            self._targets.prefetch(k)
        mean = MeanGradient(state.gaussians, len(frames), self._all_rows()) if len(frames) > 1 else None
        all_figures = []
        for k in frames:
            output, gradients = self.differentiate(k)
            all_figures.append(output.figures)
            if mean is not None:
                mean.add(gradients)
            if len(all_figures) < len(frames):
                self._count(output)
        self._optimize(state, gradients if mean is None else mean.result())
        state.step += 1
        averaging, left = config.is_averaged(state.step), config.iterations - state.step
        if averaging and left % AVERAGE_STRIDE == 0:
            state.average.add(state.gaussians.values)
        output.ends_step = True
        self._count(output)
        return output, mean_figures(all_figures)

    def differentiate(self, k: int) -> tuple[StepOutput, RowGradients]:
        """Render training frame k and differentiate its loss.

        Until the loss is differentiated nothing is kept but what only depends on the step, so that a frame with too few rows
        for its Gaussians can be computed again. Their number is asked for when all that is in the queue of the GPU.
        """
        frame, gaussians = self.observations[k], self.state.gaussians
        while True:
            active = gaussians.active(frame.time, frame.camera, capacity=self._capacity)
            output, gradients = self.backpropagate(k, active)
            if active.fits():
                break
            self._capacity.grow(active.counts())
        output.figures["active"] = float(sum(active.counts()))
        shared = {name: gradients.pop(name) for name in gaussians.shared if name in gradients}
        return output, RowGradients(active, output.visible, gradients, shared)

    def backpropagate(self, k: int, active: Active) -> tuple[StepOutput, Gradients]:
        """Render some of the Gaussians in training frame k and differentiate the sum of all terms of the loss."""
        state, targets = self.state, self._targets[k]
        gradients: Gradients = {}
        rendered = self._render(k, active, targets, gradients)
        output = StepOutput(state, self.config, self.observations, k, targets, active, rendered, state.step, len(state.gaussians))
        self._strategy.step_pre_backward(state, output)
        total: Tensor | None = None
        for name, weight, term in self._terms:
            value = term.compute(output)
            if value is not None and not (isinstance(value, Tensor) and value.numel() == 1):
                raise TypeError(f"the loss term {name!r} returned {value!r:.60}: a tensor of one number, or None, is expected")
            if value is not None:
                total = weight * value if total is None else total + weight * value
            if term.has_curve:
                output.figures[name] = 0.0 if value is None else _number(value)
        assert total is not None  # the photometric loss is always there
        total.backward()
        output.figures["loss"] = _number(total)
        return output, gradients

    def _render(self, k: int, active: Active, targets: PhotometricTargets, gradients: Gradients) -> RenderedFrame:
        """Render frame k, with the colors of the frame where something is burnt in: no loss, no gradient, and no window of SSIM
        that reaches across compares what the scene has there."""
        frame, config, overlay = self.observations[k], self.config, self.observations.overlay
        flow_to = None
        if frame.forward is not None and config.loss.flow > 0:
            following = self.observations[k + 1]
            flow_to = following.camera, following.time
        rendered = render_active(
            self.state.gaussians, active, frame.camera, flow_to=flow_to, flow_model=config.flow_model, gradients=gradients
        )
        if overlay is None:
            return rendered
        image = rendered.image
        covers = upload(torch.from_numpy(overlay), image.device)
        target = torch.as_tensor(targets.color, device=image.device).to(image.dtype) / 255
        return replace(rendered, image=torch.cat([torch.where(covers[..., None], target, image[..., :3]), image[..., 3:]], -1))

    @torch.no_grad()
    def _count(self, output: StepOutput) -> None:
        self._strategy.step_post_backward(self.state, output)
        if len(self.state.gaussians) == 0:
            raise InputError(f"No Gaussian is left at step {self.step}: --train.density prunes them all.")

    def _all_rows(self) -> Active:
        """Return all rows; counted anew only where something has changed, as a GPU has to be waited for."""
        if self._everyone is None or self._everyone[0] != self.state.revision:
            self._everyone = self.state.revision, all_rows(self.state.gaussians)
        return self._everyone[1]

    # -- its ends

    def begin(self) -> None:
        """Go back to the last checkpoint, or to the beginning."""
        began = clock.perf_counter()
        order = FrameOrder(len(self.observations), self.config.order, self.config.seed, self._visits)
        self._everyone = None
        kept = None if self._checkpoints is None else self._checkpoints.load(order, self._strategy, self.device)
        if kept is not None:
            self.state = kept
            return
        start = self._start or self.initialize()
        generator = torch.Generator().manual_seed(self.config.seed)
        self.state = TrainState(start.to(self.device), order, generator, self._first_step, began=began)
        self._strategy.initialize_state(self.state)
        moving = int(self.gaussians.dynamic.sum())
        report(f"Starting from {len(self.gaussians) - moving:,} background and {moving:,} moving Gaussians.")

    def initialize(self) -> Gaussians4D:
        """Return the first Gaussians, of the frames and their priors."""
        config = self.config
        with spinner("Placing the first Gaussians"):
            return initialize(self.observations, self.tracks, config.model, config.init, config.seed, config.most_at_start)

    def _stop(self, signal: int) -> NoReturn:
        """Keep what was done. The file is written first: the terminal may be gone, and then a line on it is an error."""
        kept = ""
        if self._checkpoints is not None:
            self._checkpoints.save(self.state)
            kept = " They are kept."
        report(f"Stopped after step {self.state.step} of {self.config.iterations}.{kept}")
        raise Stopped(signal)


def _number(value: Tensor) -> float | Tensor:
    """Return a figure: what is on a GPU stays there."""
    return value.detach() if value.is_cuda else float(value.detach())
