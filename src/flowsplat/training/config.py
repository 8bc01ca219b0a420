"""Configure training: every setting, and the presets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

import tyro
from msgspec import Meta

from flowsplat.common.bounds import Amount, AtLeastOne, Count, Fraction, Positive, Share, bounds_in_help, check_bounds
from flowsplat.common.errors import InputError
from flowsplat.common.settings import LEFT_OUT_BY_DEFAULT
from flowsplat.gaussians.flow import FlowModel
from flowsplat.gaussians.initialize import InitConfig
from flowsplat.gaussians.model_config import ModelConfig
from flowsplat.gaussians.motion import motion_model
from flowsplat.training.frame_order import Order
from flowsplat.training.losses import LOSSES, LossTerm, add_weights
from flowsplat.training.strategies import STRATEGIES

START_FACTOR = 2
"""How many times as many Gaussians are placed as are to stay (``TrainConfig.gaussians``), at most. Chosen by eye."""


@bounds_in_help
@dataclass(frozen=True)
class RatesConfig:
    """Adam's learning rates at the start. Lengths are in median depths, times in clip lengths."""

    means: Amount = 1.6e-4
    """Positions; falls to ``means_decay`` of this, exponentially."""
    means_pixels: Amount = 0.06
    """Positions at rest move at most this many pixels a step, as seen at the median depth, and ``motion`` is slowed down alike:
    pixels are small in a fine image and behind a long lens. 0 = as fast as the rates say."""
    along_ray: Amount = 15.0
    """Positions at rest learn along their ray up to this many times as fast as across it: as much as the camera's travel shows
    their depth less than their place in the image. 1 = alike in all directions."""
    times: Amount = 1.6e-4
    """Center times; constant."""
    quats: Amount = 1e-3
    """Rotations."""
    scales: Amount = 0.02
    """Log scales."""
    opacities: Amount = 0.05
    """Logit opacities."""
    colors: Amount = 0.02
    """Harmonics of degree 0."""
    harmonics: Amount = 1e-3
    """Harmonics beyond degree 0."""
    log_lambdas: Amount = 0.01
    """Log temporal precision."""
    motion: Amount = 1e-3
    """Polynomial and Fourier coefficients."""
    gains: Amount = 0.015
    """Brightness in time: its slowest wave."""
    slopes: Amount = field(default=0.03, metadata=LEFT_OUT_BY_DEFAULT)
    """Brightness inside a Gaussian, per standard deviation."""
    gains_falloff: Amount = 0.5
    """The k-th wave of brightness learns at k to the power of minus this of that rate."""
    moving: Positive = 3.0
    """Factor for Gaussians that move: each is seen in a few frames only, so it is stepped less often."""
    time_factor: Positive = field(default=1.0, metadata=LEFT_OUT_BY_DEFAULT)
    """How many times as long the clip is as one that ``times`` and ``motion`` are meant for: center times learn so many times as
    slowly, and coefficients of a power of time that power of it faster, so that all is as fast in seconds."""
    means_decay: Amount = 0.01
    """What remains of the rate of ``means`` at the end."""
    motion_decay: Amount = 0.1
    """What remains of the rate of ``motion`` at the end."""
    decay: Amount = 0.05
    """What remains of all other rates at the end, ``times`` excepted."""
    moving_decay: Amount = 0.6
    """The same of Gaussians that move."""


@bounds_in_help
@dataclass(frozen=True)
@add_weights
class LossConfig:
    """Weights of the losses (docs/method/training.md)."""

    ssim: Share = 0.2
    """gamma_1: share of SSIM in the color loss."""
    flow: Amount = 0.03
    """gamma_2: weight of the flow loss, pixels."""
    rigid: Amount = 0.5
    """gamma_3: weight of the rigid loss."""
    depth: Amount = 0.05
    """Weight of the depth loss (ours; 0 in the paper)."""
    coverage: Amount = 0.0
    """Weight of the loss on training pixels that are not covered (ours; 0 in the paper)."""
    rigid_neighbors: Annotated[int, Meta(ge=1, le=256)] = 20
    """k: neighbors of every Gaussian in the rigid loss."""
    rigid_beta: Annotated[float, Meta(ge=0, le=1_000_000)] = 100.0
    """How fast the weight of a neighbor falls with distance, per median depth."""
    rigid_refresh: AtLeastOne = 1000
    """Steps for which the neighbors once found are used."""
    rigid_over_all: bool = False
    """The rigid loss is among all Gaussians that may move, divided by the number of all (the paper); off: among dynamic ones
    alone, divided by those active."""
    flow_by_alpha: bool = True
    """Compare flow with alpha times the prior, where alpha is at least 0.5 (ours), instead of with the prior as it is (the paper),
    which is biased where alpha < 1."""

    def terms(self) -> list[tuple[str, float, LossTerm]]:
        """Return the name, weight and function of every term whose weight is not 0, in order."""
        terms = [(entry.name, float(getattr(self, entry.name, 1.0)), entry.value) for entry in LOSSES.entries()]
        return [term for term in terms if term[1] > 0]


@bounds_in_help
@dataclass(frozen=True)
class DensityConfig:
    """When Gaussians are added, removed, reset, and when background becomes dynamic (docs/method/training.md)."""

    every: Count = 100
    """Steps between two rounds."""
    start: Count = 500
    """First round."""
    stop: Share = 1.0
    """Last round, as a share of all iterations."""
    gradient: Amount = 0.0002
    """Clone or split above this mean gradient of the 2D mean, in normalized device coordinates; 0 = never."""
    clone_below: Amount = 0.01
    """Gaussians whose largest scale is below this are cloned, the others split. Median depths."""
    prune_opacity: Amount = 0.005
    """Remove below this opacity."""
    prune_scale: Amount = 0.1
    """Remove above this scale, once the first opacity reset is past; 0 = never. Median depths."""
    reset_every: Count = 600
    """Steps between two opacity resets; 0 = never."""
    reset_to: Fraction = 0.01
    """Opacity after a reset."""
    max_gaussians: AtLeastOne = 1_500_000
    """Never more than this."""
    prune_change: Amount = field(default=0.0, metadata=LEFT_OUT_BY_DEFAULT)
    """Gaussians without which the training frames change least are removed once: as many as add no more than this share to the
    squared error in the pixels of their object, or of the background (ours): .01 takes a fifth of the Gaussians and costs .04 dB
    along the path (bear, camel, train), .2 from aside (workshop). 0 = none. Of strategy ``default``."""
    prune_after: AtLeastOne = field(default=100, metadata=LEFT_OUT_BY_DEFAULT)
    """Steps after which that is done, and after which the first of those go that ``gaussians`` has no room for."""
    revise: bool = True
    """Background that keeps a large residual becomes dynamic, dynamic Gaussians that rest become background (ours). Of strategy
    ``default``, and without effect where background is no other than what moves (``model.freeze_background`` off, as in the
    paper)."""
    revise_flow: Amount = 1.5
    """Mean flow residual in pixels from which background counts as moving."""
    revise_color: Amount = 0.04
    """Mean difference of colors, 0 to 1, from which it does: where nothing is to be seen flow is a guess."""
    revise_rest: Amount = 0.3
    """Dynamic Gaussians that would move less than this many pixels over the whole clip, seen at the median depth, and explain the
    flow where they are seen, come to rest."""


@bounds_in_help
@dataclass(frozen=True)
class TrainConfig:
    """How a scene is trained."""

    iterations: Count = 1500
    """Optimizer steps."""
    adapt_to_length: bool = field(default=False, metadata=LEFT_OUT_BY_DEFAULT)
    """A clip of more than 100 frames takes as many times more steps (ours), so that each of its frames is drawn as often as each of
    a shorter clip, and what counts in clip lengths is as fine in seconds: rates, ``model.gains``, ``model.knots``."""
    strategy: Annotated[str, STRATEGIES.option()] = field(default="default", metadata=LEFT_OUT_BY_DEFAULT)
    """Who adds and removes Gaussians, and when."""
    gaussians: Annotated[Count, tyro.conf.arg(aliases=("--gaussians",))] = field(default=0, metadata=LEFT_OUT_BY_DEFAULT)
    """At most this many Gaussians in the end, as good as that allows: up to twice as many are placed, and from
    ``density.prune_after`` on those that are needed least go, a fifth every 50 steps. 0 = as many as are placed. Of strategy
    ``default``."""
    frames_per_iteration: Annotated[int, Meta(ge=0, le=10_000)] = 1
    """Frames rendered in a step; their losses are averaged. 0 = all (the paper, read literally)."""
    order: Order = "spread"
    """Of the frames in a round: random, or so that those of steps that follow each other lie far apart. What moves is seen in a few
    neighboring frames, and so is stepped at even intervals."""
    flow_model: FlowModel = "displacement"
    """How flow is splatted: ``mean`` (the paper), ``displacement`` or ``affine`` (docs/method/flow.md)."""
    average: Share = 0.2
    """The result is the mean over this share of the steps, the last ones; 0 = what the last step led to."""
    seed: Annotated[int, Meta(ge=0, le=2**63 - 1), tyro.conf.arg(aliases=("--seed",))] = 0
    """Of every random choice."""
    checkpoint_every: Annotated[int | None, Meta(ge=0, le=10_000_000)] = None
    """Steps between two checkpoints; 0 = none, None = by time: after 5 seconds, then every 20 or, where that costs more than 2 % of
    the time, less often. Stopping writes one in any case."""
    preview_every: Count = 100
    """Steps between two preview images; 0 = none."""
    model: ModelConfig = field(default_factory=ModelConfig)
    """What a Gaussian is made of."""
    init: InitConfig = field(default_factory=InitConfig)
    """How Gaussians start."""
    rates: RatesConfig = field(default_factory=RatesConfig)
    """Learning rates."""
    loss: LossConfig = field(default_factory=LossConfig)
    """Loss weights."""
    density: DensityConfig = field(default_factory=DensityConfig)
    """Density control."""
    fill: bool = True
    """Fill uncovered pixels of rendered images from their neighbors (ours)."""

    def check(self) -> None:
        """Refuse values that make no sense.

        Raises:
            InputError: names the option.
        """
        check_bounds(self, "--train.")
        motion_model(self.model)
        STRATEGIES.entry(self.strategy)
        if self.gaussians and self.strategy != "default":
            raise InputError(f"--gaussians is of --train.strategy default: of {self.strategy} give --train.density.max-gaussians.")

    @property
    def most_at_start(self) -> int:
        """How many Gaussians may be placed."""
        most = self.density.max_gaussians
        if not self.gaussians:
            return most
        is_long = self.iterations > self.density.prune_after  # else none would ever go
        return min(most, (START_FACTOR if is_long else 1) * self.gaussians)

    def is_averaged(self, step: int) -> bool:
        """Return whether the parameters after so many steps are among those whose mean is the result."""
        return step > (1 - self.average) * self.iterations


_OURS = TrainConfig(
    iterations=1600,
    adapt_to_length=True,
    loss=LossConfig(rigid=0.1, coverage=0.1, rigid_neighbors=10),
    model=ModelConfig(
        mean_poly=4,
        mean_fourier=0,
        quat_poly=1,
        quat_fourier=0,
        p_min=0.15,
        sh_degree=1,
        gains=16,
        slopes=True,
        freeze_background=True,
    ),
    density=DensityConfig(every=250, start=250, stop=0.8, gradient=0.0, prune_scale=0.0, reset_every=0),
)

NOT_AFFECTING_RESULT = ("checkpoint_every", "preview_every")
"""Settings of training that change no figure."""


def select_result_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return those settings of training, by name, on which the result depends."""
    return {name: value for name, value in settings.items() if name not in NOT_AFFECTING_RESULT}


PRESETS: dict[str, TrainConfig] = {
    "default": _OURS,
    "paper": TrainConfig(
        iterations=1500,
        strategy="paper",
        frames_per_iteration=4,
        order="random",
        flow_model="mean",
        average=0.0,
        model=ModelConfig(),
        init=InitConfig(
            foreground="tracks", samples=7, precision_factor=49 / 36, opacity=0.1, surface_aligned=False,
            background_spacing=2.0, foreground_spacing=1.0, spacing_growth=0.0, detail=0.0, sample_gap=0, motion_order=2,
        ),
        rates=RatesConfig(
            means_pixels=0.0, along_ray=1.0, quats=0.001, scales=0.005, opacities=0.05, colors=0.0025, harmonics=0.0025 / 20,
            decay=1.0, motion=0.001, moving=1.0, moving_decay=1.0,
        ),
        loss=LossConfig(depth=0.0, rigid_over_all=True, flow_by_alpha=False),
        density=DensityConfig(revise=False),
        fill=False,
    ),
}  # fmt: skip
"""Training settings by name; ``fast`` and ``high`` are made from ``default`` in ``pipeline``."""
