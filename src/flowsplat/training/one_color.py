"""The fit for formats with one color a Gaussian: a scene with slopes of brightness goes on for a few steps without them."""

from __future__ import annotations

import math
from dataclasses import replace

from flowsplat.training.config import TrainConfig
from flowsplat.training.final import AVERAGED_SHARE

ONE_COLOR_FIT_SHARE = 0.15
"""Steps of the fit, as a share of those of the training (docs/method.md, "Brightness slopes")."""
FIRST_RATES = 0.3
"""Where in their fall from the beginning to the end of a training its rates begin (docs/method.md, "Brightness slopes")."""


def one_color_config(config: TrainConfig) -> tuple[TrainConfig, int]:
    """Return the settings of the fit, and the step that it begins with.

    It is the end of a training that is as much longer as puts the first rates where ``FIRST_RATES`` says. Gaussians are neither
    added nor removed, and none begins to move or comes to rest.
    """
    steps = max(1, math.ceil(ONE_COLOR_FIT_SHARE * config.iterations))
    iterations = round(steps / (1 - FIRST_RATES))
    settings = replace(
        config,
        iterations=iterations,
        average=min(config.average, AVERAGED_SHARE * steps / iterations),
        density=replace(config.density, every=0, reset_every=0, gradient=0.0, revise=False),
        model=replace(config.model, slopes=False),
    )
    return settings, iterations - steps
