"""Gaussians at rest fade where they would be a guess: seen by too few frames, or from too far beside the directions of those that
did. What moves stays: it is there in its own frames, be they few, and no others could have seen it.

How much that is, and why, is told in ``visibility``, which finds what the clip has seen.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from flowsplat.gaussians.gaussians4d import Gaussians4D

MIN_FRAMES = 3
"""Frames that must have seen a point. Chosen on workshop and garden (docs/method/evaluation.md; docs/notebook/2026-11.md)."""
MAX_SPREADS = 12.0
"""Times the spread of the directions from which a point was seen is the furthest from which it is shown as it is. Chosen on
workshop and garden (docs/method/evaluation.md; docs/notebook/2026-11.md)."""
MIN_FADE_REACH = 0.02
"""What a Gaussian that too few saw may be off all the same, a degree: small swings stay whole (docs/method/evaluation.md)."""
MAX_DIRECTION_DIFFERENCE = 2.0
"""Directions cannot differ by more: the length of the difference of opposite ones."""
_MIN_OPACITY = 1e-7
"""Opacities are kept this far from 0 and 1, where their logit ends."""


def reach(seen: Tensor) -> Tensor:
    """Return [N] how far the direction from which a Gaussian is looked at may be from that of the clip's camera.

    As the length of the difference of unit vectors; of ``Gaussians4D.seen`` [N, 2].
    """
    frames, spread_of = seen.unbind(1)
    return torch.where(frames >= MIN_FRAMES, MAX_SPREADS * spread_of, torch.zeros_like(spread_of)).clamp(min=MIN_FADE_REACH)


def keep_all_seen(seen: Tensor) -> Tensor:
    """Return ``Gaussians4D.seen`` [N, 2] as if all that any frame has seen, be it once, were known from all around.

    With it only what no frame has seen fades.
    """
    known = torch.tensor([float(MIN_FRAMES), MAX_DIRECTION_DIFFERENCE]).to(seen)
    return torch.where(seen[:, :1] > 0, known, torch.zeros_like(seen))


def apply_confidence_fade(gaussians: Gaussians4D, viewer: np.ndarray, own: np.ndarray) -> Gaussians4D:
    """Return the Gaussians as far as the clip tells what they look like: beyond its ``reach`` each of the background fades, and is
    gone at twice that.

    Args:
        gaussians: with ``seen``; without, all stay.
        viewer: [3] where the camera stands, in their coordinates.
        own: [3] where the clip's camera stood at that time. From there all stay.
    """
    if gaussians.seen is None:
        return gaussians
    means, logits = gaussians.params["means"], gaussians.params["logit_opacities"]
    towards = [torch.nn.functional.normalize(torch.as_tensor(center).to(means) - means, dim=1) for center in (viewer, own)]
    kept = (2 - (towards[0] - towards[1]).norm(dim=1) / reach(gaussians.seen)).clamp(0, 1)
    kept = torch.where(gaussians.dynamic, torch.ones_like(kept), kept)
    opacities = (torch.sigmoid(logits) * kept).clamp(_MIN_OPACITY, 1 - _MIN_OPACITY)
    return replace(gaussians, params={**gaussians.params, "logit_opacities": torch.where(kept < 1, torch.logit(opacities), logits)})
