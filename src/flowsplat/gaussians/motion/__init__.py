"""Motion models: how a Gaussian's mean and covariance depend on time (docs/method/representation.md).

A module here, or one of another package with an entry point ``flowsplat.motion_models``, registers one. ``protocol`` says what
every model offers, ``series`` is polynomial + Fourier (the paper's), ``linear`` the 4D Gaussian of 4DGS (the "vanilla"
representation of the paper's ablation), and ``rigid`` what models share whose Gaussians keep their scales. Those of other papers,
to compare with: ``splines``, ``marbles``, ``bases``, ``hexplane`` and ``deformation``; ``knots`` interpolates for them, ``sharing``
is of those with parameters that all Gaussians share, ``fields`` of those that ask a field.
"""

from flowsplat.gaussians.motion.linear import LinearMotion, covariances_4d
from flowsplat.gaussians.motion.protocol import (
    MotionModel,
    MotionState,
    Parameter,
    Params,
    Shape,
    motion_model,
    presence,
    register,
)
from flowsplat.gaussians.motion.rigid import RigidMotion
from flowsplat.gaussians.motion.series import SeriesMotion
from flowsplat.gaussians.motion.sharing import SharedMotion, SharedParameter

__all__ = [
    "LinearMotion",
    "MotionModel",
    "MotionState",
    "Parameter",
    "Params",
    "RigidMotion",
    "SeriesMotion",
    "Shape",
    "SharedMotion",
    "SharedParameter",
    "covariances_4d",
    "motion_model",
    "presence",
    "register",
]
