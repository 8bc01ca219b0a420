"""What one Gaussian is made of: the settings of a model."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ModelConfig:
    """What one Gaussian is made of (METHOD 1)."""

    kind: str = "series"
    """Motion model: ``series``, which the next settings describe, ``linear`` (the linear 4D Gaussian of 4DGS), or one of your own
    (CONTRIBUTING.md)."""
    move_means: bool = True
    """Means move along polynomial + Fourier series. Off: the vanilla term, a straight line (the paper's ablation)."""
    move_quats: bool = True
    """Quaternions move likewise. Off: constant rotation; with ``move_means`` off too, the linear 4D Gaussian of 4DGS."""
    mean_poly: int = 6
    """Order of the polynomial of the mean."""
    mean_fourier: int = 6
    """Order of the Fourier series of the mean."""
    quat_poly: int = 3
    """Order of the polynomial of the quaternion."""
    quat_fourier: int = 3
    """Order of the Fourier series of the quaternion."""
    fourier_base: float = 1.0
    """Lowest frequency of the Fourier series, radians per clip length."""
    sh_degree: int = 3
    """Degree of the spherical harmonics of colour, 0 to 3."""
    gains: int = 0
    """Cosines of the brightness in time of the background; 0 = off (the paper)."""
    freeze_background: bool = False
    """The background neither moves nor fades in time (as long as it is background)."""
    p_min: float = 0.05
    """A Gaussian is rendered where its presence p(t) is at least this."""
