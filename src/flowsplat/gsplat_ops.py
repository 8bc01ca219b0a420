"""gsplat's operators without a GPU: its strategies, its optimizer and its functions then work unchanged on the CPU.

gsplat (https://github.com/nerfstudio-project/gsplat) calls compiled operators by name, and where nothing was compiled these are
missing. ``install`` puts ours there, of those that ``MCMCStrategy``, ``SelectiveAdam``, ``quat_scale_to_covar_preci`` and
``spherical_harmonics`` need; ``DefaultStrategy`` needs none:

    import flowsplat.gsplat_ops
    from gsplat import MCMCStrategy

    flowsplat.gsplat_ops.install()

The functions here have the names and arguments of gsplat 1.5's (https://docs.gsplat.studio/main/apis/utils.html) and can be called
without it. They are computed by torch, on any device, in any float type, and are differentiable where gsplat's are.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable
from importlib import import_module
from typing import Any

import torch
from torch import Tensor

from flowsplat.geometry.rotations import quats_to_rotations
from flowsplat.splatting.harmonics import MAX_DEGREE, harmonics_basis, harmonics_count
from flowsplat.splatting.relocation import share_place

_UPPER = ((0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2))
"""Rows and columns of the upper triangle of a matrix [3, 3], in gsplat's order."""


def compute_relocation(opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor) -> tuple[Tensor, Tensor]:
    """Return what each of several Gaussians must look like to look together as one did (Kheradmand et al. 2024, eq. 9).

    Args:
        opacities: [N] or [N, 1] of the ones.
        scales: [N, 3] of them.
        ratios: [N] int, how many come into the place of each; fewer than one counts as one. Unlike gsplat's, it is left as it is.
        binoms: [n_max, n_max] whose size alone is looked at: more than n_max count as n_max.

    Returns:
        opacities, in the shape that they had, and scales [N, 3].

    Raises:
        ValueError: a shape does not fit.
    """
    column = (1,) if opacities.ndim == 2 else ()
    _check(opacities=(opacities, (None, *column)), scales=(scales, (len(opacities), 3)), ratios=(ratios, (len(opacities),)))
    return _relocation(opacities, scales, ratios, binoms, len(binoms))


def quat_scale_to_covar_preci(
    quats: Tensor, scales: Tensor, compute_covar: bool = True, compute_preci: bool = True, triu: bool = False
) -> tuple[Tensor | None, Tensor | None]:
    """Return covariances R S^2 R^T and their inverses.

    Args:
        quats: [..., 4] wxyz, any length.
        scales: [..., 3] standard deviations.
        compute_covar: False = no covariances.
        compute_preci: False = no inverses.
        triu: the upper triangles alone: xx, xy, xz, yy, yz, zz.

    Returns:
        each [..., 3, 3], or [..., 6] with ``triu``, or None.

    Raises:
        ValueError: a shape does not fit.
    """
    batch = tuple(quats.shape[:-1])
    _check(quats=(quats, (*batch, 4)), scales=(scales, (*batch, 3)))
    rotations = quats_to_rotations(quats)

    def spread(lengths: Tensor) -> Tensor:
        axes = rotations * lengths[..., None, :]
        matrices = axes @ axes.transpose(-1, -2)
        return matrices[..., _UPPER[0], _UPPER[1]] if triu else matrices

    return spread(scales) if compute_covar else None, spread(1 / scales) if compute_preci else None


def spherical_harmonics(degrees_to_use: int, dirs: Tensor, coeffs: Tensor, masks: Tensor | None = None) -> Tensor:
    """Return the sum of spherical harmonics, with the constants and signs of 3D Gaussian Splatting, neither shifted nor clamped.

    Args:
        degrees_to_use: 0 to 4; coefficients of higher degrees do not count.
        dirs: [..., 3] of any length.
        coeffs: [..., K, 3].
        masks: [...] bool, which to compute; the others are 0.

    Returns:
        [..., 3].

    Raises:
        ValueError: a shape does not fit, or there are fewer coefficients than the degree has.
    """
    batch, count = tuple(dirs.shape[:-1]), harmonics_count(degrees_to_use)
    if not 0 <= degrees_to_use <= MAX_DEGREE:
        raise ValueError(f"degrees_to_use must be 0 to {MAX_DEGREE}, not {degrees_to_use}")
    _check(dirs=(dirs, (*batch, 3)), coeffs=(coeffs, (*batch, None, 3)))
    if coeffs.shape[-2] < count:
        raise ValueError(f"coeffs must hold [{count} or more, 3] for degrees_to_use {degrees_to_use}, not {list(coeffs.shape)}")
    basis = harmonics_basis(torch.nn.functional.normalize(dirs, dim=-1), degrees_to_use)
    colors = (basis[..., None] * coeffs[..., :count, :]).sum(-2)
    if masks is None:
        return colors
    _check(masks=(masks, batch))
    return torch.where(masks[..., None], colors, torch.zeros_like(colors))


@torch.no_grad()
def adam(
    param: Tensor,
    param_grad: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    valid: Tensor | None,
    lr: float,
    b1: float,
    b2: float,
    eps: float,
) -> None:
    """Take one step of Adam for some rows, in place, and leave the others and their moments as they are.

    That is what Taming 3DGS (Mallick et al. 2024, https://arxiv.org/abs/2406.15643) does with what a camera does not see. As in
    gsplat's operator the moments are not corrected for having begun at 0.

    Args:
        param: [N, ...].
        param_grad: [N, ...].
        exp_avg: [N, ...] mean of the gradients, changed in place.
        exp_avg_sq: [N, ...] mean of their squares, changed in place.
        valid: [N] which rows; None = all.
        lr: learning rate.
        b1: how much of ``exp_avg`` stays.
        b2: how much of ``exp_avg_sq`` stays.
        eps: added to the root.

    Raises:
        ValueError: a shape does not fit.
    """
    shape = tuple(param.shape)
    _check(param_grad=(param_grad, shape), exp_avg=(exp_avg, shape), exp_avg_sq=(exp_avg_sq, shape))
    if valid is not None:
        _check(valid=(valid, (len(param),)))
    rows: Any = slice(None) if valid is None else torch.nonzero(valid).squeeze(1)
    gradient = param_grad[rows]
    mean = b1 * exp_avg[rows] + (1 - b1) * gradient
    square = b2 * exp_avg_sq[rows] + (1 - b2) * gradient * gradient
    exp_avg[rows], exp_avg_sq[rows] = mean, square
    param[rows] -= lr * mean / (square.sqrt() + eps)


def install() -> None:
    """Put the operators of this module where gsplat calls its own, for the rest of the process.

    Where gsplat has compiled operators they stay, and compute what is on a GPU. Where it would compile some when it first needs
    them (it does where it finds ``nvcc``), it does not any more: import ``gsplat.cuda._backend`` before, to have both.

    Raises:
        ImportError: gsplat is not installed, or of another version than 1.5, whose operators have other names.
    """
    gsplat: Any = import_module("gsplat")
    version = str(getattr(gsplat, "__version__", "unknown"))
    if not version.startswith("1.5"):
        raise ImportError(f"flowsplat.gsplat_ops has the operators of gsplat 1.5, and this is gsplat {version}")
    backend: Any = sys.modules.get("gsplat.cuda._backend")
    if backend is None:
        theirs = getattr(gsplat, "csrc", None)
        with contextlib.suppress(ImportError):
            theirs = theirs or import_module("gsplat.csrc")
        gsplat.csrc = _Operators(theirs)  # gsplat looks here first, and compiles nothing where it finds something
        backend = import_module("gsplat.cuda._backend")
    if not hasattr(backend, "_C"):
        raise ImportError(f"gsplat {version} keeps its operators elsewhere than 1.5 does")
    if not isinstance(backend._C, _Operators):
        backend._C = _Operators(backend._C)


class _Operators:
    """What gsplat takes for its compiled module: ours by name, and for tensors on a GPU gsplat's own where it has them."""

    def __init__(self, theirs: Any):
        self._theirs = theirs

    def __getattr__(self, name: str) -> Callable[..., Any]:
        ours: Any = _OPERATORS.get(name)
        theirs: Any = getattr(self._theirs, name, None)
        if ours is None and theirs is None:
            raise AttributeError(f"gsplat's operator {name} needs a GPU: flowsplat.gsplat_ops has {', '.join(_OPERATORS)}")
        if ours is None or theirs is None:
            return ours or theirs

        def call(*args: Any) -> Any:
            on_gpu = any(isinstance(value, Tensor) and value.is_cuda for value in args)
            return (theirs if on_gpu else ours)(*args)

        return call


def _relocation(opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor, n_max: int) -> tuple[Tensor, Tensor]:
    new, factors = share_place(opacities.flatten(), ratios.flatten(), n_max)
    return new.reshape(opacities.shape), factors[:, None] * scales


def _covar_preci_fwd(*args: Any) -> tuple[Tensor, Tensor]:
    covars, precis = quat_scale_to_covar_preci(*args)
    nothing = args[0].new_zeros(0)  # gsplat's function returns tensors, and drops those that were not asked for
    return nothing if covars is None else covars, nothing if precis is None else precis


def _covar_preci_bwd(
    quats: Tensor, scales: Tensor, triu: bool, v_covars: Tensor | None, v_precis: Tensor | None
) -> tuple[Tensor, Tensor]:
    given = [value for value in (v_covars, v_precis) if value is not None]
    with torch.enable_grad():
        leaves = quats.detach().requires_grad_(), scales.detach().requires_grad_()
        results = quat_scale_to_covar_preci(*leaves, v_covars is not None, v_precis is not None, triu)
        v_quats, v_scales = torch.autograd.grad([value for value in results if value is not None], leaves, given)
    return v_quats, v_scales


def _harmonics_bwd(
    num_bases: int, degree: int, dirs: Tensor, coeffs: Tensor, masks: Tensor | None, v_colors: Tensor, compute_v_dirs: bool
) -> tuple[Tensor, Tensor | None]:
    with torch.enable_grad():
        leaves = coeffs.detach().requires_grad_(), dirs.detach().requires_grad_()
        colors = spherical_harmonics(degree, leaves[1], leaves[0], masks)
        v_coeffs, v_dirs = torch.autograd.grad(colors, leaves, v_colors, allow_unused=True)
    if not compute_v_dirs:
        return v_coeffs, None
    return v_coeffs, torch.zeros_like(dirs) if v_dirs is None else v_dirs  # degree 0 looks at no direction


_OPERATORS: dict[str, Callable[..., Any]] = {
    "adam": adam,
    "quat_scale_to_covar_preci_bwd": _covar_preci_bwd,
    "quat_scale_to_covar_preci_fwd": _covar_preci_fwd,
    "relocation": _relocation,
    "spherical_harmonics_bwd": _harmonics_bwd,
    "spherical_harmonics_fwd": spherical_harmonics,
}
"""As gsplat's compiled module names them."""


def _check(**values: tuple[Tensor, tuple[int | None, ...]]) -> None:
    """Raise a ValueError that names the first tensor that has not its shape; None = any number."""
    for name, (value, shape) in values.items():
        fits = value.ndim == len(shape) and all(n is None or n == m for n, m in zip(shape, value.shape, strict=True))
        if not fits:
            wanted = ", ".join("K" if n is None else str(n) for n in shape)
            raise ValueError(f"{name} must be [{wanted}], not {list(value.shape)}")
