"""The training loop (docs/method.md, "Training")."""

from __future__ import annotations

import functools
import math
import time as clock
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import torch
from torch import Tensor

from flowsplat.common.devices import upload
from flowsplat.common.errors import InputError
from flowsplat.common.files import check_json, write_json
from flowsplat.common.memory import keep_freed_memory
from flowsplat.common.progress import progress_bar, report, spinner
from flowsplat.common.settings import to_plain
from flowsplat.common.stopping import Stopped, stop_requests
from flowsplat.common.threads import in_one_launch
from flowsplat.gaussians.culling import RowCapacity
from flowsplat.gaussians.density import DensityResult, DensityStatistics, densify, prune, reset_opacities, revise_dynamic
from flowsplat.gaussians.gaussians4d import Active, Gaussians4D
from flowsplat.gaussians.initialize import choose_frames, initialize
from flowsplat.gaussians.motion.protocol import RateGroup
from flowsplat.gaussians.observations import Observation, Observations
from flowsplat.gaussians.render import RenderedFrame, render_active
from flowsplat.gaussians.slicing import Gradients
from flowsplat.scenes import Tracks
from flowsplat.training.adam import RowAdam
from flowsplat.training.checkpoint import (
    CheckpointFile,
    check_model,
    check_training_state,
    latest_checkpoint,
    read_tensors,
    write_tensors,
)
from flowsplat.training.config import TrainConfig, select_result_settings
from flowsplat.training.coverage import coverage_loss
from flowsplat.training.dynamic_evidence import add_residuals
from flowsplat.training.photometric_loss import PhotometricTargets, PhotometricWeights, photometric_loss
from flowsplat.training.ray_preconditioning import PathSpread, step_along_rays
from flowsplat.training.rigidity import Neighbors, find_neighbors, rigid_loss
from flowsplat.training.targets import Targets
from flowsplat.training.timing import CheckpointTimes
from flowsplat.training.weight_averaging import AVERAGE_STRIDE, TailAverage

RECORD_EVERY = 10
"""Steps that one entry of the history averages over. Chosen by eye."""

MAX_ALONE_SHARE = 0.01
"""Share of the dynamic Gaussians that may be without neighbors until the next search, which takes as long as tens of steps
(docs/method.md, "Where preset `default` differs from the paper")."""

GOLDEN_RATIO = (5**0.5 - 1) / 2
"""Its multiples, without what is whole of them, are spread most evenly (Knuth, The Art of Computer Programming 3, 6.4)."""

Preview = Callable[[int, Observation, RenderedFrame], None]
Record = Callable[[dict[str, float]], None]
Entry = dict[str, float | Tensor]
"""Figures of a step by name; tensors of the GPU as long as the host need not know them."""


class Trainer:
    """Trains 4D Gaussians on observations; can stop at any step and go on from its last checkpoint to the same bits.

    On a GPU the host runs ahead. Of a step it has to know two things only: whether there were enough rows for the active Gaussians
    (``RowCapacity``) and enough slots for their pairs with a tile (``splatting.triton.tiles.PairCapacity``). Both are counted
    before the Gaussians are blended, and read when there is more than that in the GPU's queue: the pairs after the forward pass,
    the Gaussians after the backward pass. Where there were too few, there are more from then on, and the frame is computed again
    before anything is changed. It does wait every ``RECORD_EVERY`` steps for the history, and where neighbors are searched,
    density is controlled, or a preview or a checkpoint is written.

    Attributes:
        gaussians: the model so far.
        step: steps done.
        earlier_seconds: what earlier processes took for the steps that this one went on from.
        history: one entry every ``RECORD_EVERY`` steps: step, loss, color, flow, rigid, depth, coverage, psnr,
            gaussians, active.
    """

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
        self.observations, self.tracks, self.config = observations, tracks, config
        self._checkpoints = None if checkpoints is None else Path(checkpoints)
        self._preview, self._record = preview, record
        self._start, self._device = start, torch.device(device)
        self._first_step = first_step
        self._round = np.repeat(np.arange(len(observations)), 1 if visits is None else visits)
        self._targets = Targets(observations, config.loss.flow > 0, self._device)
        self.step, self.history = 0, []  # type: tuple[int, list[dict[str, float]]]
        self.earlier_seconds, self._started = 0.0, clock.perf_counter()
        self._rng = np.random.default_rng(config.seed)
        self._generator = torch.Generator().manual_seed(config.seed)
        self._queue: list[int] = []
        self._capacity = RowCapacity()
        self._all_rows: Active | None = None
        self._neighbors: Neighbors | None = None
        self._neighbors_found = 0
        self._recent: list[Entry] = []
        self._average = TailAverage()
        self._times = np.array([frame.time for frame in observations.frames])
        centers = np.array([frame.camera.center for frame in observations.frames], np.float32)
        self._path = PathSpread.of(torch.from_numpy(centers), self._device)
        self.gaussians: Gaussians4D
        self._adam: RowAdam
        self._statistics: DensityStatistics

    # -- the loop

    def run(self) -> Gaussians4D:
        """Train from the last checkpoint, or from the beginning, to the end.

        Ctrl-C, SIGTERM and SIGHUP let the step end, and write a checkpoint.

        Raises:
            Stopped: one of them came.
        """
        self._all_rows, self._started = None, clock.perf_counter()
        if not self._load_checkpoint():
            start = self._start or self._first()
            self.gaussians, self.step = start.to(self._device), self._first_step
            self._adam = RowAdam(self.gaussians.params)
            self._statistics = DensityStatistics.zeros(len(self.gaussians), self._device)
            moving = int(self.gaussians.dynamic.sum())
            report(f"Starting from {len(self.gaussians) - moving:,} background and {moving:,} moving Gaussians.")
        config = self.config
        times = CheckpointTimes(config.checkpoint_every, clock.perf_counter())
        label = "Final fit" if self._first_step else "Training"
        with progress_bar(label, config.iterations, self.step) as bar, stop_requests() as request, keep_freed_memory():
            while self.step < config.iterations:
                entry = self._iterate()
                self._after_step(entry)
                if request.signal is not None:
                    self._stop(request.signal)
                known = entry if isinstance(entry["psnr"], float) else self.history[-1] if self.history else None
                psnr = "" if known is None else f"PSNR {known['psnr']:.2f}  "
                bar.advance(1, f"{psnr}{len(self.gaussians):,} Gaussians")
                due = times.is_due(self.step, began := clock.perf_counter())
                if self._checkpoints is not None and due and self.step < config.iterations:
                    self._save_checkpoint()
                    now = clock.perf_counter()
                    times.note_written(now, now - began)
        self._average.write(self.gaussians.params)
        return self.gaussians

    def _first(self) -> Gaussians4D:
        with spinner("Placing the first Gaussians"):
            return initialize(
                self.observations, self.tracks, self.config.model, self.config.init, self.config.seed,
                self.config.density.max_gaussians,
            )  # fmt: skip

    def _stop(self, signal: int) -> NoReturn:
        """Keep what was done. The file is written first: the terminal may be gone, and then a line on it is an error."""
        kept = ""
        if self._checkpoints is not None:
            self._save_checkpoint()
            kept = " They are kept."
        report(f"Stopped after step {self.step} of {self.config.iterations}.{kept}")
        raise Stopped(signal)

    def _next_frames(self) -> list[int]:
        count = self.config.frames_per_iteration or len(self.observations)
        chosen = []
        for _ in range(count):
            if not self._queue:
                count = len(self._round)
                order = _spread_order(count, self._rng) if self.config.order == "spread" else self._rng.permutation(count)
                self._queue = self._round[order].tolist()
            chosen.append(self._queue.pop())
        return chosen

    def _iterate(self) -> Entry:
        """Return one optimizer step over the next frames."""
        self.gaussians.sh_degree = min(self.gaussians.config.sh_degree, 4 * self.step // max(self.config.iterations, 1))
        frames = self._next_frames()
        for k in (*frames[1:2], *self._queue[-1:]):
            self._targets.prefetch(k)
        if len(frames) == 1:
            active, drawn, gradients, entry = self._differentiate(frames[0])
            self._apply(active, drawn, gradients)
            entries = [entry]
        else:
            entries = self._accumulate(frames)
        self.step += 1
        return {name: _mean([entry[name] for entry in entries]) for name in entries[0]}

    def _accumulate(self, frames: list[int]) -> list[Entry]:
        """Return one optimizer step along the mean gradient of several frames."""
        gaussians = self.gaussians
        # The last one is where padding, -1, points to.
        count = len(gaussians)
        totals = {name: value.new_zeros(count + 1, *value.shape[1:]) for name, value in gaussians.params.items()}
        touched = torch.zeros(count + 1, dtype=torch.bool, device=self._device)
        entries = []
        for k in frames:
            active, drawn, gradients, entry = self._differentiate(k)
            for name, gradient in gradients.items():
                share = drawn[gaussians.part(name, active)].to(gradient.dtype) / len(frames)
                totals[name][gaussians.rows_of(name, active)] += gradient * share.view(-1, *(1,) * (gradient.ndim - 1))
            touched[active.rows] |= drawn
            entries.append(entry)
        active = self._all_rows = self._all_rows or _all_rows(gaussians)
        self._apply(active, touched[active.rows], {n: total[gaussians.rows_of(n, active)] for n, total in totals.items()})
        return entries

    @property
    def _focal(self) -> float:
        """Pixels that a unit of length has at the median depth."""
        return float(self.observations[0].camera.K[0, 0])

    def _apply(self, active: Active, drawn: Tensor, gradients: Gradients) -> None:
        self._adam.begin_step(active.valid(active.rows), active.valid(drawn))
        rates_at_rest, rates_moving = self.rates(), self.rates(moving=True)
        with in_one_launch():
            for name, gradient in gradients.items():
                value, having = self.gaussians.params[name], self.gaussians.part(name, active)
                rows, stepped, at_rest = active.rows[having], drawn[having], active.num_static - (having.start or 0)
                given = self._adam, name, value, rows[:at_rest], stepped[:at_rest], gradient[:at_rest], rates_at_rest[name]
                if name == "means" and self.config.rates.along_ray > 1:
                    step_along_rays(*given, self._path, self._focal, self.config.rates.along_ray)
                else:
                    RowAdam.step(*given)
                self._adam.step(name, value, rows[at_rest:], stepped[at_rest:], gradient[at_rest:], rates_moving[name])

    def rates(self, moving: bool = False) -> dict[str, Tensor]:
        """Learning rates now of Gaussians at rest, or of those that move: one for every number of a row, by parameter."""
        r = self.config.rates
        progress = self.step / max(self.config.iterations, 1)
        decay = r.moving_decay if moving else r.decay
        means, motion, rest = (decay**progress for decay in (r.means_decay, r.motion_decay, decay))
        limit = r.means_pixels / self._focal
        slowed = limit / r.means if 0 < limit < r.means else 1.0
        rates = {
            "means": slowed * r.means * means, "times": r.times, "logit_opacities": r.opacities * rest, "log_gains": r.gains * rest,
        }  # fmt: skip
        groups: dict[RateGroup, float] = {
            "rotation": r.quats * rest, "scale": r.scales * rest, "precision": r.log_lambdas * rest,
            "motion": slowed * r.motion * motion,
        }  # fmt: skip
        rates |= {name: groups[parameter.rate] for name, parameter in self.gaussians.motion.parameters.items()}
        result: dict[str, np.ndarray] = {}
        for name, value in self.gaussians.params.items():
            size = math.prod(value.shape[1:])
            result[name] = np.full(size, r.harmonics * rest if name == "sh" else rates[name], np.float32)
            if name == "sh":
                result[name][:3] = r.colors * rest
            if name == "log_gains":
                result[name] *= _falloff(size, r.gains_falloff)
        # One copy to the device for all of them.
        together = upload(np.concatenate(list(result.values())) * np.float32(r.moving if moving else 1), self._device)
        return dict(zip(result, together.split([len(rate) for rate in result.values()]), strict=True))

    # -- one frame

    def _differentiate(self, k: int) -> tuple[Active, Tensor, Gradients, Entry]:
        """Render training frame k and return what was active, what was drawn [A], the gradients of its loss, and figures.

        Until the loss is differentiated nothing is kept but what only depends on the step, so that a frame with too few rows
        for its Gaussians can be computed again. Their number is asked for when all that is in the queue of the GPU.
        """
        frame, targets = self.observations[k], self._targets[k]
        while True:
            active = self.gaussians.active(frame.time, frame.camera, capacity=self._capacity)
            rendered, gradients, entry = self._backpropagate(k, active, targets)
            if active.fits():
                break
            self._capacity.grow(active.counts())
        drawn = rendered.projected.visible
        with torch.no_grad():
            self._count(targets, active, rendered, drawn)
        if self._preview is not None and self.config.preview_every and self.step % self.config.preview_every == 0:
            self._preview(self.step, frame, rendered)
        return active, drawn, gradients, {**entry, "active": float(sum(active.counts()))}

    def _backpropagate(self, k: int, active: Active, targets: PhotometricTargets) -> tuple[RenderedFrame, Gradients, Entry]:
        """Render training frame k and differentiate its loss."""
        frame, config = self.observations[k], self.config
        flow_to = None
        if frame.forward is not None and config.loss.flow > 0:
            following = self.observations[k + 1]
            flow_to = following.camera, following.time
        gradients: Gradients = {}
        rendered = render_active(
            self.gaussians, active, frame.camera, flow_to=flow_to, flow_model=config.flow_model, gradients=gradients
        )
        if config.density.gradient > 0:
            rendered.projected.means2d.retain_grad()
        rendered = self._lay_over(rendered, targets)
        total, figures = photometric_loss(rendered.image, rendered.alpha, rendered.flow_channels, targets, self._weights)
        rigid = self._rigid(active, rendered) if config.loss.rigid > 0 else None
        if rigid is not None:
            total = total + config.loss.rigid * rigid
        coverage = coverage_loss(rendered.alpha) if config.loss.coverage > 0 else None
        if coverage is not None:
            total = total + config.loss.coverage * coverage
        total.backward()
        entry = {
            "color": figures.color,
            "flow": figures.flow,
            "depth": figures.depth,
            "rigid": _number(rigid) if rigid is not None else 0.0,
            "coverage": _number(coverage) if coverage is not None else 0.0,
            "loss": _number(total),
            "psnr": _psnr(figures.squared_error),
        }
        return rendered, gradients, entry

    def _lay_over(self, rendered: RenderedFrame, targets: PhotometricTargets) -> RenderedFrame:
        """Return what was rendered with the colors of the frame where something is burnt in: no loss, no gradient, and no window of
        SSIM that reaches across compares what the scene has there."""
        if self.observations.overlay is None:
            return rendered
        image = rendered.image
        overlay = upload(torch.from_numpy(self.observations.overlay), image.device)
        target = torch.as_tensor(targets.color, device=image.device).to(image.dtype) / 255
        return replace(rendered, image=torch.cat([torch.where(overlay[..., None], target, image[..., :3]), image[..., 3:]], -1))

    @property
    def _revises(self) -> bool:
        """Whether Gaussians are told to move, or to rest, from what was seen of them."""
        return self.config.density.revise and self.config.model.freeze_background

    @property
    def _weights(self) -> PhotometricWeights:
        loss = self.config.loss
        return PhotometricWeights(loss.ssim, loss.flow, loss.depth, loss.flow_by_alpha)

    def _rigid(self, active: Active, rendered: RenderedFrame) -> Tensor | None:
        """Return the rigid loss among dynamic Gaussians; with ``rigid_over_all`` among all that may move."""
        config, moving, velocities = self.config.loss, active.rows[active.num_static :], rendered.sliced.velocities
        if min(len(moving), len(self.gaussians)) < 2:
            return None
        dynamic_only = not config.rigid_over_all
        if self._neighbors is None or self.step >= self._neighbors_found + config.rigid_refresh:
            self._neighbors = find_neighbors(
                self.gaussians, self._times.tolist(), config.rigid_neighbors, config.rigid_beta, dynamic_only
            )
            self._neighbors_found = self.step
        count: int | Tensor = len(self.gaussians)
        if not config.rigid_over_all:
            dynamic = (self.gaussians.dynamic[moving] & (moving >= 0)).sum().clamp(min=1)
            count = dynamic if dynamic.is_cuda else int(dynamic)
        return rigid_loss(velocities, moving, self._neighbors, count)

    def _count(self, targets: PhotometricTargets, active: Active, rendered: RenderedFrame, visible: Tensor) -> None:
        """Add this image to the statistics of density control."""
        statistics = self._statistics
        if self.config.density.gradient > 0:
            rows, gradient = active.valid(active.rows), rendered.projected.means2d.grad
            assert gradient is not None
            width, height = self.observations.size
            scaled = gradient * upload(torch.tensor([width / 2, height / 2], dtype=gradient.dtype), gradient.device)
            statistics.gradient[rows] += active.valid(torch.where(visible, scaled.norm(dim=1), 0))
            statistics.visits[rows] += active.valid(visible)
        # Every fourth step is enough evidence.
        sampled = self._revises and self.step % 4 == 0
        if sampled and rendered.flow is not None and targets.flow is not None:
            add_residuals(statistics, active, visible, rendered, targets)

    # -- after a step

    def _after_step(self, entry: Entry) -> None:
        self._recent.append(entry)
        if self.step % RECORD_EVERY == 0 or self.step == self.config.iterations:
            recent = _read(self._recent)
            # Those of a checkpoint that somebody changed may lack one.
            mean = {name: float(np.mean([e[name] for e in recent if name in e])) for name in entry}
            self.history.append({"step": float(self.step), **mean, "gaussians": float(len(self.gaussians))})
            self._recent = []
            if self._record is not None:
                self._record(self.history[-1])
        config, left = self.config.density, self.config.iterations - self.step
        averaged = self.step > (1 - self.config.average) * self.config.iterations
        if averaged and left % AVERAGE_STRIDE == 0:
            self._average.add(self.gaussians.params)
        # After the last step nothing would be trained any more: children would stay where chance put them.
        if left == 0:
            return
        if config.every and config.start <= self.step <= config.stop * self.config.iterations and self.step % config.every == 0:
            self._control_density()
        if config.reset_every and self.step % config.reset_every == 0 and not averaged:
            reset_opacities(self.gaussians, config.reset_to)
            self._adam.restart("logit_opacities")

    def _control_density(self) -> None:
        config = self.config.density
        if self._revises:
            _, log_lambda = choose_frames(len(self.observations), self.config.init)
            moved, rested = revise_dynamic(
                self.gaussians, self._statistics, config.revise_flow, config.revise_color, config.revise_rest, self._focal,
                log_lambda,
            )  # fmt: skip
            if moved or rested:
                self._average.restart()
                # Those that became dynamic have no neighbors yet, and are those of none. A few can wait for the next search.
                dynamic = self.gaussians.dynamic
                if self._neighbors is not None and float(self._neighbors.alone[dynamic].float().mean()) > MAX_ALONE_SHARE:
                    self._neighbors = None
                report(f"Step {self.step}: {moved:,} background Gaussians turned out to move, {rested:,} moving ones rest.")
        if config.gradient > 0:
            self._adopt(
                densify(
                    self.gaussians, self._statistics, config.gradient, config.clone_below, config.max_gaussians, self._generator
                )
            )
        large = config.prune_scale if config.reset_every and self.step > config.reset_every else 0.0
        self._adopt(prune(self.gaussians, self._times, config.prune_opacity, large))
        if len(self.gaussians) == 0:
            raise InputError(f"No Gaussian is left at step {self.step}: --train.density prunes them all.")
        self._statistics = DensityStatistics.zeros(len(self.gaussians), self._device)
        self._all_rows = None

    def _adopt(self, result: DensityResult) -> None:
        if result.gaussians is self.gaussians:
            return
        self._adam.reindex(result.index, result.is_new)
        if self._neighbors is not None:
            self._neighbors = self._neighbors.reindex(result.index)
        self._average.reindex(result.index, result.is_new)
        self.gaussians = result.gaussians

    # -- checkpoints

    def _save_checkpoint(self) -> None:
        assert self._checkpoints is not None
        tensors = {f"param.{name}": value for name, value in self.gaussians.params.items()}
        tensors |= {f"adam.{name}": value for name, value in self._adam.state().items()}
        tensors |= {f"statistics.{name}": value for name, value in vars(self._statistics).items()}
        tensors |= {f"average.{name}": value for name, value in self._average.state().items()}
        tensors |= {"dynamic": self.gaussians.dynamic, "object_ids": self.gaussians.object_ids}
        tensors |= {"generator": self._generator.get_state()}
        if self._neighbors is not None:
            tensors |= {"neighbors.indices": self._neighbors.indices, "neighbors.weights": self._neighbors.weights}
        values = {
            "step": self.step,
            "sh_degree": self.gaussians.sh_degree,
            "queue": self._queue,
            "rng": self._rng.bit_generator.state,
            "neighbors_found": self._neighbors_found,
            "recent": _read(self._recent),
            "averaged": self._average.count,
            "seconds": self.earlier_seconds + clock.perf_counter() - self._started,
            "history": self.history,
            "config": to_plain(self.config),
        }
        name = f"step_{self.step:06d}.safetensors"
        write_tensors(self._checkpoints / name, tensors, values)
        write_json(self._checkpoints / "latest.json", {"file": name, "step": self.step, "written": clock.time()})
        for old in self._checkpoints.glob("*step_*.safetensors"):
            if old.name != name:
                old.unlink()

    def _load_checkpoint(self) -> bool:
        """Go on from the last checkpoint, if there is one.

        Raises:
            InputError: it is damaged, or was written with other settings.
        """
        if self._checkpoints is None or not (self._checkpoints / "latest.json").exists():
            return False
        path = latest_checkpoint(self._checkpoints)
        if not path.exists():  # a damaged one, which was deleted
            return False
        tensors, values = read_tensors(path)
        check_json(path, values, CheckpointFile)
        if select_result_settings(values["config"]) != select_result_settings(to_plain(self.config)):
            raise InputError(f"{path} was written with other training settings. Use another output folder, or delete it.")
        try:
            self._restore(tensors, values)
            check_model(path, self.gaussians)
            check_training_state(path, tensors, self.gaussians)
            if any(k >= len(self.observations) for k in self._queue):
                raise ValueError("it names frames that are not there")
        except (KeyError, ValueError, TypeError, RuntimeError, AttributeError, ArithmeticError) as error:
            raise InputError(f"{path} is incomplete: {error}. Delete {path.parent} to train from the beginning.") from error
        report(f"Going on from step {self.step} of {self.config.iterations}.")
        return True

    def _restore(self, tensors: dict[str, Tensor], values: dict[str, Any]) -> None:
        def group(prefix: str) -> dict[str, Tensor]:
            chosen = {name[len(prefix) + 1 :]: value for name, value in tensors.items() if name.startswith(prefix + ".")}
            return {name: value.to(self._device) for name, value in chosen.items()}

        dynamic, object_ids = tensors["dynamic"].to(self._device), tensors["object_ids"].to(torch.uint8).to(self._device)
        self.gaussians = Gaussians4D(group("param"), dynamic, self.config.model, int(values["sh_degree"]), object_ids)
        self._adam = RowAdam(self.gaussians.params)
        self._adam.load_state(group("adam"))
        statistics = group("statistics")
        self._statistics = DensityStatistics(**statistics)
        self._average.load_state(int(values["averaged"]), group("average"))
        self._generator.set_state(tensors["generator"])
        self._rng.bit_generator.state = values["rng"]
        self._queue, self.step = list(values["queue"]), int(values["step"])
        self._recent = [{**entry} for entry in values["recent"]]
        self.history = values["history"]
        self._neighbors_found = int(values["neighbors_found"])
        self.earlier_seconds = float(values["seconds"])
        self._neighbors = Neighbors(**group("neighbors")) if "neighbors.indices" in tensors else None


def _spread_order(count: int, rng: np.random.Generator) -> np.ndarray:
    """Return a permutation [count] of which any few in a row lie far apart: multiples of the golden ratio, from a random one on."""
    return np.argsort(np.argsort((rng.random() + GOLDEN_RATIO * np.arange(count)) % 1))


@functools.cache
def _falloff(count: int, power: float) -> np.ndarray:
    """Return [count] factors by which the gains' frequencies learn more slowly."""
    return (torch.arange(1.0, count + 1) ** -power).numpy()


def _all_rows(gaussians: Gaussians4D) -> Active:
    """Return all of them, those at rest first. Waits for a GPU to count those."""
    rests = gaussians.at_rest
    resting = torch.nonzero(rests)
    return Active(torch.cat([resting, torch.nonzero(~rests)]).squeeze(1), len(resting), 0.0)


def _mean(values: list[float | Tensor]) -> float | Tensor:
    numbers = [value for value in values if not isinstance(value, Tensor)]
    return float(np.mean(numbers)) if len(numbers) == len(values) else sum(values) / len(values)


def _number(value: Tensor) -> float | Tensor:
    """Return a figure: what is on a GPU stays there."""
    return value.detach() if value.is_cuda else float(value.detach())


def _psnr(squared_error: float | Tensor) -> float | Tensor:
    if isinstance(squared_error, Tensor):
        return -10 * torch.log10(squared_error.clamp(min=1e-10))
    return -10 * math.log10(max(squared_error, 1e-10))


def _read(entries: list[Entry]) -> list[dict[str, float]]:
    """Wait for the figures that are still on a device, for all of them once."""
    tensors = [value.double() for entry in entries for value in entry.values() if isinstance(value, Tensor)]
    numbers = iter(torch.stack(tensors).tolist() if tensors else [])
    return [{name: next(numbers) if isinstance(value, Tensor) else value for name, value in e.items()} for e in entries]
