"""Configure what one Gaussian is made of: the settings of a model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Any

from msgspec import Meta

from flowsplat.common.bounds import Amount, Fraction, bounds_in_help
from flowsplat.common.registry import Registry
from flowsplat.common.settings import LEFT_OUT_BY_DEFAULT

MOTION_MODELS: Registry[Callable[..., Any]] = Registry("motion model", "flowsplat.gaussians.motion", "flowsplat.motion_models")
"""What makes a ``motion.MotionModel`` from the settings. They name its members, so it knows them not."""


@bounds_in_help
@dataclass(frozen=True)
class ModelConfig:
    """What one Gaussian is made of (docs/method/representation.md)."""

    kind: Annotated[str, MOTION_MODELS.option()] = "series"
    """Motion model."""
    move_means: bool = True
    """Means move along polynomial + Fourier series. Off: the vanilla term, a straight line (the paper's ablation)."""
    move_quats: bool = True
    """Quaternions move likewise. Off: constant rotation; with ``move_means`` off too, the linear 4D Gaussian of 4DGS."""
    mean_poly: Annotated[int, Meta(ge=0, le=64)] = 6
    """Order of the polynomial of the mean."""
    mean_fourier: Annotated[int, Meta(ge=0, le=64)] = 6
    """Order of the Fourier series of the mean."""
    quat_poly: Annotated[int, Meta(ge=0, le=64)] = 3
    """Order of the polynomial of the quaternion."""
    quat_fourier: Annotated[int, Meta(ge=0, le=64)] = 3
    """Order of the Fourier series of the quaternion."""
    fourier_base: Amount = 1.0
    """Lowest frequency of the Fourier series, radians per clip length."""
    knots: Annotated[int, Meta(ge=4, le=1_000)] = field(default=16, metadata=LEFT_OUT_BY_DEFAULT)
    """Of motion models that interpolate: knots over the clip (those with a network have none)."""
    bases: Annotated[int, Meta(ge=1, le=256)] = field(default=10, metadata=LEFT_OUT_BY_DEFAULT)
    """Of motion model ``bases``: rigid motions that all Gaussians blend."""
    sh_degree: Annotated[int, Meta(ge=0, le=3)] = 3
    """Degree of the spherical harmonics of color, 0 to 3."""
    gains: Annotated[int, Meta(ge=0, le=256)] = 0
    """Cosines of the brightness in time of the background; 0 = off (the paper)."""
    slopes: bool = field(default=False, metadata=LEFT_OUT_BY_DEFAULT)
    """Brightness varies inside a Gaussian, linearly along the first two of its axes. Off: each has one color (the paper)."""
    freeze_background: bool = False
    """The background neither moves nor fades in time (as long as it is background)."""
    p_min: Fraction = 0.05
    """A Gaussian is rendered where its presence p(t) is at least this."""
