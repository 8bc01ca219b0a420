"""Gaussians as bright as they are without the shadows of what moves (``shadows.add_shadow_free`` finds that)."""

from __future__ import annotations

from dataclasses import replace

from flowsplat.gaussians.gaussians4d import Gaussians4D
from flowsplat.splatting.rules import C0


def without_shadows(gaussians: Gaussians4D) -> Gaussians4D:
    """Return the same Gaussians as bright as they are without what moves; as they are where that is not known."""
    if gaussians.shadow_free is None:
        return gaussians
    factor = gaussians.shadow_free[:, 0].exp()[:, None]
    sh = gaussians.params["sh"] * factor[..., None]
    sh[:, 0] += (factor - 1) * (0.5 / C0)
    params = {**gaussians.params, "sh": sh, "log_gains": gaussians.shadow_free[:, 1:].contiguous()}
    return replace(gaussians, params=params)
