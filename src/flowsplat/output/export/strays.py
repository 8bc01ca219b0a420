"""Bring near what lies so far away that formats which round coordinates would round all others coarsely for it."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from flowsplat.common.progress import report
from flowsplat.gaussians.gaussians4d import Gaussians4D
from flowsplat.gaussians.model import SceneModel
from flowsplat.output.player.chebyshev import visible_interval

MAX_DISTANCE = 1000.0
"""Median depths from the middle of the scene. Trained scenes reach 32, and 22 bits round a thousand to a two-thousandth."""


@torch.no_grad()
def bring_strays_near(model: SceneModel, to: str) -> SceneModel:
    """Return the scene with everything within ``MAX_DISTANCE``, and tell how many Gaussians were not; itself where all are.

    What rests comes nearer and becomes smaller by the same factor, so that it looks the same from the clip's cameras; what moves,
    or could (all where the background is not kept still), is left out.

    Args:
        model: the scene.
        to: name of the format, for what is told.
    """
    gaussians = model.gaussians
    far = _find_strays(gaussians)
    if not far.any():
        return model
    resting, moving = (torch.nonzero(far & which).squeeze(1) for which in (gaussians.at_rest, ~gaussians.at_rest))
    told = []
    if len(resting):
        gaussians = _shrink(gaussians, resting)
        told.append(f"{len(resting):,} at rest are shown nearer, and as much smaller")
    if len(moving):
        kept = torch.ones_like(far)
        kept[moving] = False
        gaussians = gaussians.select(torch.nonzero(kept).squeeze(1))
        told.append(f"{len(moving):,} that move, or could, are left out")
    report(f"{to} cannot hold Gaussians beyond {MAX_DISTANCE:,.0f} times the median depth: {'; '.join(told)}.")
    return replace(model, gaussians=gaussians)


def _find_strays(gaussians: Gaussians4D) -> Tensor:
    """Return [N] bool: too far away, at its center or at the beginning, the middle or the end of the time in which it is seen."""
    params = gaussians.params
    far = ~(params["means"].norm(dim=1) <= MAX_DISTANCE)
    moving = torch.nonzero(~gaussians.at_rest).squeeze(1)
    chosen = {name: value[moving] for name, value in params.items()}
    middle, half = visible_interval(chosen["times"], gaussians.motion.log_precision(chosen), gaussians.config.p_min)
    for side in (-1, 0, 1):
        far[moving] |= ~(gaussians.motion.state(chosen, middle + side * half).means.norm(dim=1) <= MAX_DISTANCE)
    return far


def _shrink(gaussians: Gaussians4D, rows: Tensor) -> Gaussians4D:
    """Return the Gaussians with those ``rows`` brought to ``MAX_DISTANCE``."""
    parts = []
    for row in rows[:, None]:
        one = gaussians.select(row)
        distance = float(one.params["means"].double().norm())
        smaller = gaussians.motion.shrunk(one.params, math.log(distance / MAX_DISTANCE), torch.zeros_like(one.dynamic))
        parts.append({**smaller, "means": one.params["means"] * (MAX_DISTANCE / distance)})
    params = {name: value.clone() for name, value in gaussians.params.items()}
    for name, value in params.items():
        value[rows] = torch.cat([part[name] for part in parts])
    return replace(gaussians, params=params)
