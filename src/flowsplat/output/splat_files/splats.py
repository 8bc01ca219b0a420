"""Define static 3D Gaussians as they come out of a file."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from flowsplat.geometry.cameras import MAX_COORDINATE

MAX_GAUSSIANS = 10_000_000
"""Of a file: as many as a model may have. They take 2.4 GB at degree 3."""
MAX_DEGREE = 3
"""Of the harmonics of a model. Those of higher degrees in a file are left out."""
_MAX_LOG = 80.0
"""Logarithm of what still is a float32."""
_MAX_LOGIT = 16.0
"""Opacities before the sigmoid are kept within this: beyond, float32 knows nothing between them and 0 or 1."""


@dataclass(frozen=True)
class Splats:
    """N static Gaussians, float32.

    Attributes:
        means: [N, 3] in the file's own units.
        quats: [N, 4] wxyz.
        log_scales: [N, 3]
        logit_opacities: [N]
        sh: [N, K, 3] harmonics, K = 1, 4, 9 or 16.
    """

    means: np.ndarray
    quats: np.ndarray
    log_scales: np.ndarray
    logit_opacities: np.ndarray
    sh: np.ndarray

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """0 to 3."""
        return round(self.sh.shape[1] ** 0.5) - 1

    def keep_usable(self) -> Splats:
        """Return those of which all is finite and within what can be drawn; opacities of 0 and 1 become what is nearly so."""
        with np.errstate(invalid="ignore"):
            logits = np.clip(self.logit_opacities, -_MAX_LOGIT, _MAX_LOGIT)  # NaN stays
            usable = np.isfinite(logits)
            for values, low, high in (
                (self.means, -MAX_COORDINATE, MAX_COORDINATE), (self.quats, -MAX_COORDINATE, MAX_COORDINATE),
                (self.log_scales, -_MAX_LOG, _MAX_LOG), (self.sh, -MAX_COORDINATE, MAX_COORDINATE),
            ):  # fmt: skip
                inside = (values >= low) & (values <= high)  # not for NaN
                usable &= inside.all(axis=tuple(range(1, values.ndim)))
            usable &= (self.quats != 0).any(1)
        return replace(self, logit_opacities=logits).select(usable)

    def select(self, which: np.ndarray) -> Splats:
        """Return those that ``which`` [N] names."""
        return Splats(*(getattr(self, field.name)[which] for field in fields(self)))


def to_float32(values: Any) -> np.ndarray:
    """Return a contiguous array of float32; what it cannot hold becomes infinite, which ``keep_usable`` leaves out."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.ascontiguousarray(values, np.float32)
