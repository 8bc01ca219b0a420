"""Training settings of a long clip: what its settings count in steps or in clip lengths is as fine in its seconds as in a short
one's."""

from __future__ import annotations

import math
from dataclasses import replace

from flowsplat.common.bounds import bounds_of
from flowsplat.gaussians.model_config import ModelConfig
from flowsplat.training.config import TrainConfig

FULL_FRAMES = 100
"""Frames of a clip, those held out among them, up to which the settings of a training are taken as they are: as many as a clip is
thinned to by default."""


def adapt_to_length(config: TrainConfig, frames: int) -> TrainConfig:
    """Return the settings of training for a clip of so many frames, those held out among them.

    Each frame of a long clip is drawn as often as each of one of ``FULL_FRAMES``: steps, and the rounds of density control, which
    have to see every frame, are as many times more. Brightness and motion have as many frequencies and knots a second, and learn as
    fast in seconds (docs/method/training.md).
    """
    if frames <= FULL_FRAMES or not config.adapt_to_length:
        return config
    factor = frames / FULL_FRAMES

    def longer(steps: int) -> int:
        return round(factor * steps)

    def more(name: str) -> int:
        """As many times as many of something of the model, or as many as it may have."""
        return int(min(longer(getattr(config.model, name)), most[name].le or math.inf))

    most = bounds_of(ModelConfig)
    density, model = config.density, config.model
    return replace(
        config,
        iterations=longer(config.iterations),
        density=replace(
            density, every=longer(density.every), start=longer(density.start), reset_every=longer(density.reset_every),
            prune_after=longer(density.prune_after),
        ),
        model=replace(model, gains=more("gains"), knots=more("knots"), fourier_base=factor * model.fourier_base),
        rates=replace(config.rates, time_factor=factor * config.rates.time_factor),
    )  # fmt: skip
