"""A scene without motion, to compare with: the same Gaussians, objects as they were in one frame."""

from __future__ import annotations

from dataclasses import replace

import torch

from flowsplat.gaussians.gaussians4d import Gaussians4D
from flowsplat.gaussians.initialize import initialize
from flowsplat.gaussians.observations import Observations
from flowsplat.scenes import Tracks
from flowsplat.training.config import TrainConfig


def static_config(config: TrainConfig) -> TrainConfig:
    """Return the settings without anything that moves."""
    return replace(
        config,
        gaussians=0,
        model=replace(config.model, freeze_background=True),
        loss=replace(config.loss, flow=0.0, rigid=0.0),
        density=replace(
            config.density,
            revise=False,
            prune_change=0.0,
            max_gaussians=min(config.density.max_gaussians, config.gaussians or config.density.max_gaussians),
        ),
    )


def static_start(observations: Observations, tracks: Tracks | None, config: TrainConfig) -> Gaussians4D:
    """Return the first Gaussians of a static scene: the background, and the objects as in their middle frame. A random start stays
    whole.

    Args:
        observations: the training frames.
        tracks: for an initialization from tracks.
        config: from ``static_config``.
    """
    start = initialize(observations, tracks, config.model, config.init, config.seed, config.most_at_start, moves=False)
    keep = ~start.dynamic
    if not config.init.from_priors:
        keep[:] = True
    elif start.dynamic.any():
        times = start.params["times"]
        seen = torch.unique(times[start.dynamic])
        keep |= start.dynamic & (times == seen[len(seen) // 2])
    start = start.select(torch.nonzero(keep).squeeze(1))
    start.dynamic[:] = False
    return start
