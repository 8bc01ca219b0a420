"""The fit for formats with one color a Gaussian: a scene with slopes of brightness goes on for a few steps without them."""

from __future__ import annotations

import math
from dataclasses import replace

from flowsplat.training.config import TrainConfig
from flowsplat.training.final import continuation_config

ONE_COLOR_FIT_SHARE = 0.15
"""Steps of the fit, as a share of those of the training: of .03, .075 and .15 the best on camel, and a sixth of its time
(docs/method/representation.md, "Brightness slopes")."""
FIRST_RATES = 0.3
"""Where in their fall from the beginning to the end of a training its rates begin. Chosen by eye."""


def one_color_config(config: TrainConfig) -> tuple[TrainConfig, int]:
    """Return the settings of the fit, and the step that it begins with."""
    steps = max(1, math.ceil(ONE_COLOR_FIT_SHARE * config.iterations))
    return continuation_config(replace(config, model=replace(config.model, slopes=False)), steps, FIRST_RATES)
