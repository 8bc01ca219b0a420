"""Polynomial + Fourier series, the paper's motion (docs/method/representation.md)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from flowsplat.gaussians.model_config import ModelConfig
from flowsplat.gaussians.motion.protocol import FusedKernels, MotionState, Parameter, Params, presence, register
from flowsplat.gaussians.motion.rigid import RigidMotion


def series_basis(tau: Tensor, poly_order: int, fourier_order: int, fourier_base: float) -> Tensor:
    """Return [N] times since the center to [N, poly + 2 fourier] basis values: tau^n, cos(w l tau) - 1, sin(w l tau)."""
    phases = [fourier_base * k * tau for k in range(1, fourier_order + 1)]
    columns = [tau**n for n in range(1, poly_order + 1)]
    columns += [torch.cos(phase) - 1 for phase in phases] + [torch.sin(phase) for phase in phases]
    return torch.stack(columns, 1) if columns else tau.new_zeros(len(tau), 0)


def series_basis_rate(tau: Tensor, poly_order: int, fourier_order: int, fourier_base: float) -> Tensor:
    """Return the derivative of ``series_basis`` with respect to tau."""
    rates = [fourier_base * k for k in range(1, fourier_order + 1)]
    columns = [n * tau ** (n - 1) for n in range(1, poly_order + 1)]
    columns += [-w * torch.sin(w * tau) for w in rates] + [w * torch.cos(w * tau) for w in rates]
    return torch.stack(columns, 1) if columns else tau.new_zeros(len(tau), 0)


def _combine(basis: Tensor, poly: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    coefficients = torch.cat([poly, cos, sin], 1)
    return torch.bmm(basis[:, None], coefficients)[:, 0] if coefficients.shape[1] else coefficients.sum(1)


@dataclass(frozen=True)
class SeriesMotion(RigidMotion):
    """Polynomial + Fourier series for the mean and the quaternion; constant scales.

    mu(t) = mean + sum a_n tau^n + sum (b_l (cos(w l tau) - 1) + c_l sin(w l tau)), and q(t) of the same form. *Repair:* the
    paper writes b_l cos(l tau), with which mu(mu_t) is not the mean; its sum for q starts at 0 and duplicates q_0.
    """

    mean_poly: int = 6
    mean_fourier: int = 6
    quat_poly: int = 3
    quat_fourier: int = 3
    fourier_base: float = 1.0

    @property
    def parameters(self) -> dict[str, Parameter]:
        """See ``MotionModel``."""
        shapes = {
            "mean_poly": (self.mean_poly, 3),
            "mean_cos": (self.mean_fourier, 3),
            "mean_sin": (self.mean_fourier, 3),
            "quat_poly": (self.quat_poly, 4),
            "quat_cos": (self.quat_fourier, 4),
            "quat_sin": (self.quat_fourier, 4),
        }
        own = {name: Parameter(shape, "motion", moves=True, powers=name.endswith("poly")) for name, shape in shapes.items()}
        return {**super().parameters, **own}

    @property
    def kernels(self) -> FusedKernels | None:
        """See ``MotionModel``."""
        return "series"

    def start(
        self, means: Tensor, times: Tensor, quats: Tensor, scales: Tensor, log_lambdas: Tensor, coefficients: Tensor
    ) -> dict[str, Tensor]:  # fmt: skip
        """See ``MotionModel``; coefficients beyond the order of the polynomial are left out."""
        poly = coefficients.new_zeros(len(coefficients), self.mean_poly, 3)
        order = min(coefficients.shape[1], self.mean_poly)
        poly[:, :order] = coefficients[:, :order]
        return {**super().start(means, times, quats, scales, log_lambdas, coefficients), "mean_poly": poly}

    def state(self, params: Params, t: float | Tensor) -> MotionState:
        """See ``MotionModel``."""
        tau = t - params["times"]
        mean_orders = self.mean_poly, self.mean_fourier, self.fourier_base
        quat_orders = self.quat_poly, self.quat_fourier, self.fourier_base
        mean_terms = params["mean_poly"], params["mean_cos"], params["mean_sin"]
        quat_terms = params["quat_poly"], params["quat_cos"], params["quat_sin"]
        return MotionState(
            means=params["means"] + _combine(series_basis(tau, *mean_orders), *mean_terms),
            velocities=_combine(series_basis_rate(tau, *mean_orders), *mean_terms),
            presence=presence(params["times"], params["log_lambdas"], t),
            quats=params["quats"] + _combine(series_basis(tau, *quat_orders), *quat_terms),
            scales=torch.exp(params["log_scales"]),
        )

    def recenter(self, params: Params, shift: Tensor) -> dict[str, Tensor]:
        """See ``MotionModel``."""
        result = dict(params)
        moved = self.state({**params, "times": torch.zeros_like(shift) - shift}, 0.0)
        assert moved.quats is not None
        result["means"], result["quats"], result["times"] = moved.means, moved.quats, params["times"] + shift
        for kind in ("mean", "quat"):
            poly, cos, sin = params[f"{kind}_poly"], params[f"{kind}_cos"], params[f"{kind}_sin"]
            d = shift[:, None]
            expanded = torch.zeros_like(poly)
            for n in range(1, poly.shape[1] + 1):
                for m in range(n, poly.shape[1] + 1):
                    expanded[:, n - 1] += math.comb(m, n) * poly[:, m - 1] * d ** (m - n)
            result[f"{kind}_poly"] = expanded
            frequency = self.fourier_base * torch.arange(1, cos.shape[1] + 1, dtype=cos.dtype, device=cos.device)
            phase = (frequency * d)[..., None]
            result[f"{kind}_cos"] = cos * torch.cos(phase) + sin * torch.sin(phase)
            result[f"{kind}_sin"] = sin * torch.cos(phase) - cos * torch.sin(phase)
        return result


@register("series", "Series", "Polynomials and Fourier series, which the next settings describe.")
def _from_settings(settings: ModelConfig) -> SeriesMotion:
    mean_orders = (settings.mean_poly, settings.mean_fourier) if settings.move_means else (1, 0)
    quat_orders = (settings.quat_poly, settings.quat_fourier) if settings.move_quats else (0, 0)
    return SeriesMotion(*mean_orders, *quat_orders, settings.fourier_base)
