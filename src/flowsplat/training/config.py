"""Every setting of training, and the presets."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Annotated, Any, Literal

import tyro

from flowsplat.common.errors import InputError
from flowsplat.gaussians.flow import FlowModel
from flowsplat.gaussians.initialize import InitConfig
from flowsplat.gaussians.model_config import ModelConfig
from flowsplat.gaussians.motion import motion_model


@dataclass(frozen=True)
class RatesConfig:
    """Adam's learning rates at the start. Lengths are in median depths, times in clip lengths."""

    means: float = 1.6e-4
    """Positions; falls to ``means_decay`` of this, exponentially."""
    means_pixels: float = 0.06
    """Positions at rest move at most this many pixels a step, as seen at the median depth, and ``motion`` is slowed down alike:
    pixels are small in a fine picture and behind a long lens. 0 = as fast as the rates say."""
    along_ray: float = 15.0
    """Positions at rest learn along their ray up to this many times as fast as across it: as much as the camera's travel shows
    their depth less than their place in the picture. 1 = alike in all directions."""
    times: float = 1.6e-4
    """Centre times; constant."""
    quats: float = 1e-3
    """Rotations."""
    scales: float = 0.02
    """Log scales."""
    opacities: float = 0.05
    """Logit opacities."""
    colours: float = 0.02
    """Harmonics of degree 0."""
    harmonics: float = 1e-3
    """Harmonics beyond degree 0."""
    log_lambdas: float = 0.01
    """Log temporal precision."""
    motion: float = 1e-3
    """Polynomial and Fourier coefficients."""
    gains: float = 0.015
    """Brightness in time: its slowest wave."""
    gains_falloff: float = 0.5
    """The k-th wave of brightness learns at k to the power of minus this of that rate."""
    moving: float = 3.0
    """Factor for Gaussians that move: each is seen in a few frames only, so it is stepped less often."""
    means_decay: float = 0.01
    """What remains of the rate of ``means`` at the end."""
    motion_decay: float = 0.1
    """What remains of the rate of ``motion`` at the end."""
    decay: float = 0.05
    """What remains of all other rates at the end, ``times`` excepted."""
    moving_decay: float = 0.6
    """The same of Gaussians that move."""


@dataclass(frozen=True)
class LossConfig:
    """Weights of the losses (METHOD 5)."""

    ssim: float = 0.2
    """gamma_1: share of SSIM in the colour loss."""
    flow: float = 0.03
    """gamma_2: weight of the flow loss, pixels."""
    rigid: float = 0.5
    """gamma_3: weight of the rigid loss."""
    depth: float = 0.05
    """Weight of the depth loss (ours; 0 in the paper)."""
    coverage: float = 0.0
    """Weight of the loss on training pixels that are not covered (ours; 0 in the paper)."""
    rigid_neighbours: int = 20
    """k: neighbours of every Gaussian in the rigid loss."""
    rigid_beta: float = 100.0
    """How fast the weight of a neighbour falls with distance, per median depth."""
    rigid_refresh: int = 1000
    """Steps for which the neighbours once found are used."""
    rigid_over_all: bool = False
    """The rigid loss is among all Gaussians that may move, divided by the number of all (the paper); off: among dynamic ones
    alone, divided by those active."""
    flow_by_alpha: bool = True
    """Compare flow with alpha times the prior, where alpha is at least 0.5 (ours), instead of with the prior as it is (the paper),
    which is biased where alpha < 1."""


@dataclass(frozen=True)
class DensityConfig:
    """When Gaussians are added, removed, reset, and when background becomes dynamic (METHOD 5)."""

    every: int = 100
    """Steps between two rounds."""
    start: int = 500
    """First round."""
    stop: float = 1.0
    """Last round, as a share of all iterations."""
    gradient: float = 0.0002
    """Clone or split above this mean gradient of the 2D mean, in normalised device coordinates; 0 = never."""
    clone_below: float = 0.01
    """Gaussians whose largest scale is below this are cloned, the others split. Median depths."""
    prune_opacity: float = 0.005
    """Remove below this opacity."""
    prune_scale: float = 0.1
    """Remove above this scale, once the first opacity reset is past; 0 = never. Median depths."""
    reset_every: int = 600
    """Steps between two opacity resets; 0 = never."""
    reset_to: float = 0.01
    """Opacity after a reset."""
    max_gaussians: int = 1_500_000
    """Never more than this."""
    revise: bool = True
    """Background that keeps a large residual becomes dynamic, dynamic Gaussians that rest become background (ours). Without effect
    where background is no other than what moves (``model.freeze_background`` off, as in the paper)."""
    revise_flow: float = 1.5
    """Mean flow residual in pixels from which background counts as moving."""
    revise_colour: float = 0.04
    """Mean difference of colours, 0 to 1, from which it does: where nothing is to be seen flow is a guess."""
    revise_rest: float = 0.3
    """Dynamic Gaussians that would move less than this many pixels over the whole clip, seen at the median depth, and explain the
    flow where they are seen, come to rest."""


@dataclass(frozen=True)
class TrainConfig:
    """How a scene is trained."""

    iterations: int = 1500
    """Optimizer steps."""
    frames_per_iteration: int = 1
    """Frames rendered in a step; their losses are averaged. 0 = all (the paper, read literally)."""
    order: Literal["random", "spread"] = "spread"
    """Of the frames in a round: random, or so that those of steps that follow each other lie far apart. What moves is seen in a few
    neighbouring frames, and so is stepped at even intervals."""
    flow_model: FlowModel = "displacement"
    """How flow is splatted: ``mean`` (the paper), ``displacement`` or ``affine`` (docs/method.md, section 3)."""
    average: float = 0.2
    """The result is the mean over this share of the steps, the last ones; 0 = what the last step led to."""
    seed: Annotated[int, tyro.conf.arg(aliases=("--seed",))] = 0
    """Of every random choice."""
    checkpoint_every: int | None = None
    """Steps between two checkpoints; 0 = none, None = by time: after 5 seconds, then every 20 or, where that costs more than 2 % of
    the time, less often. Stopping writes one in any case."""
    preview_every: int = 100
    """Steps between two preview pictures; 0 = none."""
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
    """Fill uncovered pixels of rendered pictures from their neighbours (ours)."""

    def check(self) -> None:
        """Refuse values that make no sense.

        Raises:
            InputError: names the option.
        """
        values = dict(_numbers(self))
        for name, value in values.items():
            if not 0 <= value < math.inf:
                raise InputError(f"--train.{name} {value:g} must be 0 or more.")
            if value > most_of(name):
                raise InputError(f"--train.{name} {value:g} must be at most {most_of(name):g}.")
        for rule, holds, names in (
            ("must be 1 or more", lambda value: value >= 1, _ONE_OR_MORE),
            ("must be more than 0", lambda value: value > 0, _POSITIVE),
            ("must be between 0 and 1", lambda value: 0 < value < 1, _BETWEEN),
        ):
            for name in names:
                if not holds(values[name]):
                    raise InputError(f"--train.{name} {values[name]:g} {rule}.")
        motion_model(self.model)


_ONE_OR_MORE = (
    "init.samples", "init.background_spacing", "init.foreground_spacing", "init.random_count", "init.motion_order",
    "loss.rigid_neighbours", "loss.rigid_refresh", "density.max_gaussians",
)  # fmt: skip
_POSITIVE = ("init.precision_factor", "init.size", "init.flatness")
_BETWEEN = ("init.opacity", "density.reset_to", "model.p_min")
_MOST: Mapping[str, float] = {
    **dict.fromkeys(("average", "loss.ssim", "density.stop", "init.opacity", "density.reset_to", "model.p_min"), 1),
    "model.sh_degree": 3,
    "init.detail": 4,
    "init.motion_order": 16,
    **dict.fromkeys(("model.mean_poly", "model.mean_fourier", "model.quat_poly", "model.quat_fourier"), 64),
    **dict.fromkeys(("model.gains", "loss.rigid_neighbours", "init.edge"), 256),
    **dict.fromkeys(("frames_per_iteration", "init.samples", "init.sample_gap", "init.motion_reach"), 10_000),
    "loss.rigid_beta": 1e6,
    **dict.fromkeys(("iterations", "checkpoint_every", "preview_every", "loss.rigid_refresh"), 10_000_000),
    **dict.fromkeys(("density.every", "density.start", "density.reset_every", "init.random_count", "density.max_gaussians"), 10**7),
    "seed": 2**63 - 1,
}
"""What makes sense at most of numbers, by dotted name: beyond it they are slips that would overflow or fill the memory."""
_MOST_OF_OTHERS = 1000.0
"""Rates, weights, lengths in median depths or pixels."""


def most_of(name: str) -> float:
    """The largest value that a number of the settings of training may have, by its dotted name."""
    return _MOST.get(name, _MOST_OF_OTHERS)


def _numbers(config: Any, prefix: str = "") -> Iterator[tuple[str, float]]:
    """Every number of a dataclass of settings by its dotted name."""
    for each in fields(config):
        value = getattr(config, each.name)
        if is_dataclass(value):
            yield from _numbers(value, f"{prefix}{each.name}.")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield f"{prefix}{each.name}", value


_OURS = TrainConfig(
    iterations=2000,
    loss=LossConfig(rigid=0.1, coverage=0.1, rigid_neighbours=10),
    model=ModelConfig(
        mean_poly=4, mean_fourier=0, quat_poly=1, quat_fourier=0, p_min=0.15, sh_degree=1, gains=16, freeze_background=True
    ),
    density=DensityConfig(every=250, start=250, stop=0.8, gradient=0.0, prune_scale=0.0, reset_every=0),
)

NOT_AFFECTING_RESULT = ("checkpoint_every", "preview_every")
"""Settings of training that change no figure."""


def affecting_result(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Those settings of training, by name, on which the result depends."""
    return {name: value for name, value in settings.items() if name not in NOT_AFFECTING_RESULT}


PRESETS: dict[str, TrainConfig] = {
    "default": _OURS,
    "paper": TrainConfig(
        iterations=1500,
        frames_per_iteration=4,
        order="random",
        flow_model="mean",
        average=0.0,
        model=ModelConfig(),
        init=InitConfig(
            foreground="tracks", samples=7, precision_factor=49 / 36, opacity=0.1, surface_aligned=False,
            background_spacing=2.0, foreground_spacing=1.0, detail=0.0, sample_gap=0, motion_order=2,
        ),
        rates=RatesConfig(
            means_pixels=0.0, along_ray=1.0, quats=0.001, scales=0.005, opacities=0.05, colours=0.0025, harmonics=0.0025 / 20,
            decay=1.0, motion=0.001, moving=1.0, moving_decay=1.0,
        ),
        loss=LossConfig(depth=0.0, rigid_over_all=True, flow_by_alpha=False),
        density=DensityConfig(revise=False),
        fill=False,
    ),
}  # fmt: skip
"""Training settings by name; ``fast`` and ``high`` are made from ``default`` in ``pipeline``."""
