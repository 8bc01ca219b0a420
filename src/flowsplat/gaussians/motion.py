"""Motion models: how a Gaussian's mean and covariance depend on time (METHOD 1).

A model names its parameters, gives the state at a time, and can move the centre time of a Gaussian without changing its
motion. Two exist: ``SeriesMotion`` (polynomial + Fourier, the paper's) and ``LinearMotion`` (the 4D Gaussian of 4DGS, the
"vanilla" representation of the paper's ablation).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from flowsplat.geometry.rotations import normalize_quats

Params = Mapping[str, Tensor]


@dataclass(frozen=True)
class MotionState:
    """Gaussians at one time. Either ``quats`` and ``scales`` are given, or ``covars``.

    Attributes:
        means: [N, 3]
        velocities: [N, 3] d mean / dt, per clip length.
        presence: [N] p(t), between 0 and 1.
        quats: [N, 4] not normalised.
        scales: [N, 3]
        covars: [N, 3, 3]
    """

    means: Tensor
    velocities: Tensor
    presence: Tensor
    quats: Tensor | None = None
    scales: Tensor | None = None
    covars: Tensor | None = None


class MotionModel(Protocol):
    """What every motion model offers."""

    @property
    def parameter_shapes(self) -> dict[str, tuple[int, ...]]:
        """Trailing shapes of the parameters that the model needs besides ``means`` and ``times``."""
        ...

    @property
    def motion_names(self) -> tuple[str, ...]:
        """Those of them that a Gaussian at rest does not use."""
        ...

    def log_precision(self, params: Params) -> Tensor:
        """[N] log of lambda, the temporal precision."""
        ...

    def state(self, params: Params, t: float) -> MotionState:
        """The Gaussians at clip time ``t``."""
        ...

    def recentred(self, params: Params, shift: Tensor) -> dict[str, Tensor]:
        """The parameters that describe the same motion about the centre times moved by ``shift`` [N]."""
        ...

    def with_precision(self, params: Params, log_lambda: float) -> dict[str, Tensor]:
        """The parameters of the same Gaussians with another temporal precision."""
        ...


def presence(times: Tensor, log_lambdas: Tensor, t: float) -> Tensor:
    """p(t) = exp(-lambda (t - mu_t)^2 / 2) [N]."""
    tau = t - times
    return torch.exp(-0.5 * torch.exp(log_lambdas) * tau * tau)


def series_basis(tau: Tensor, poly_order: int, fourier_order: int, fourier_base: float) -> Tensor:
    """[N] times since the centre to [N, poly + 2 fourier] basis values: tau^n, cos(w l tau) - 1, sin(w l tau)."""
    phases = [fourier_base * k * tau for k in range(1, fourier_order + 1)]
    columns = [tau**n for n in range(1, poly_order + 1)]
    columns += [torch.cos(phase) - 1 for phase in phases] + [torch.sin(phase) for phase in phases]
    return torch.stack(columns, 1) if columns else tau.new_zeros(len(tau), 0)


def series_basis_rate(tau: Tensor, poly_order: int, fourier_order: int, fourier_base: float) -> Tensor:
    """The derivative of ``series_basis`` with respect to tau."""
    rates = [fourier_base * k for k in range(1, fourier_order + 1)]
    columns = [n * tau ** (n - 1) for n in range(1, poly_order + 1)]
    columns += [-w * torch.sin(w * tau) for w in rates] + [w * torch.cos(w * tau) for w in rates]
    return torch.stack(columns, 1) if columns else tau.new_zeros(len(tau), 0)


def _combine(basis: Tensor, poly: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    coefficients = torch.cat([poly, cos, sin], 1)
    return torch.bmm(basis[:, None], coefficients)[:, 0] if coefficients.shape[1] else coefficients.sum(1)


@dataclass(frozen=True)
class SeriesMotion:
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
    def parameter_shapes(self) -> dict[str, tuple[int, ...]]:
        return {
            "log_lambdas": (),
            "quats": (4,),
            "log_scales": (3,),
            "mean_poly": (self.mean_poly, 3),
            "mean_cos": (self.mean_fourier, 3),
            "mean_sin": (self.mean_fourier, 3),
            "quat_poly": (self.quat_poly, 4),
            "quat_cos": (self.quat_fourier, 4),
            "quat_sin": (self.quat_fourier, 4),
        }

    @property
    def motion_names(self) -> tuple[str, ...]:
        return "mean_poly", "mean_cos", "mean_sin", "quat_poly", "quat_cos", "quat_sin"

    def log_precision(self, params: Params) -> Tensor:
        return params["log_lambdas"]

    def state(self, params: Params, t: float) -> MotionState:
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

    def recentred(self, params: Params, shift: Tensor) -> dict[str, Tensor]:
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

    def with_precision(self, params: Params, log_lambda: float) -> dict[str, Tensor]:
        return {**params, "log_lambdas": torch.full_like(params["log_lambdas"], log_lambda)}


def _left_matrix(q: Tensor) -> Tensor:
    """[N, 4, 4] with q p = L(q) p for quaternions wxyz."""
    w, x, y, z = q.unbind(-1)
    return torch.stack([w, -x, -y, -z, x, w, -z, y, y, z, w, -x, z, -y, x, w], -1).unflatten(-1, (4, 4))


def _right_matrix(q: Tensor) -> Tensor:
    """[N, 4, 4] with p q = R(q) p for quaternions wxyz."""
    w, x, y, z = q.unbind(-1)
    return torch.stack([w, -x, -y, -z, x, w, z, -y, y, -z, w, x, z, y, -x, w], -1).unflatten(-1, (4, 4))


def covariances_4d(log_scales4: Tensor, quats_left: Tensor, quats_right: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Sigma_4D = R4 S4 S4^T R4^T as its blocks U [N, 3, 3], V [N, 3] and W [N]; scales4 in the order x, y, z, t.

    R4 is the product of a left and a right isoclinic rotation, the quaternion's scalar axis being time.
    """
    R = _left_matrix(normalize_quats(quats_left)) @ _right_matrix(normalize_quats(quats_right))
    M = R * torch.exp(log_scales4)[:, None, [3, 0, 1, 2]]
    sigma = M @ M.transpose(1, 2)
    return sigma[:, 1:, 1:], sigma[:, 1:, 0], sigma[:, 0, 0]


def _conditional_covariances(log_scales4: Tensor, quats_left: Tensor, quats_right: Tensor) -> Tensor:
    """U - V V^T / W [N, 3, 3], as the inverse of the spatial block of Sigma_4D^-1.

    That is the same, but the difference is lost in float32 where a Gaussian lasts long: of background with W = 1e6, U is millions
    of times the covariance that is left.
    """
    R = _left_matrix(normalize_quats(quats_left)) @ _right_matrix(normalize_quats(quats_right))
    M = R[:, 1:] * torch.exp(-log_scales4)[:, None, [3, 0, 1, 2]]
    a, b, c = (M @ M.transpose(1, 2)).unbind(1)
    columns = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], 2)
    return columns / (a * columns[:, :, 0]).sum(1)[:, None, None]


def _variance_in_time(log_scales4: Tensor, quats_left: Tensor, quats_right: Tensor) -> Tensor:
    """W [N] alone, from the first row of R4: it is needed of all Gaussians at every time, also of those that do not show."""
    a, b, c, d = normalize_quats(quats_left).unbind(-1)
    w, x, y, z = normalize_quats(quats_right).unbind(-1)
    row = a * w - b * x - c * y - d * z, c * z - a * x - b * w - d * y, d * x - a * y - b * z - c * w, b * y - a * z - c * x - d * w
    variances = torch.exp(2 * log_scales4)
    return sum((row[k] ** 2 * variances[:, (k + 3) % 4] for k in range(1, 4)), row[0] ** 2 * variances[:, 3])


@dataclass(frozen=True)
class LinearMotion:
    """The linear 4D Gaussian: a 4D normal distribution cut at time t (its conditional), so the mean moves on a line.

    mu(t) = mean + tau V / W, Sigma_3D = U - V V^T / W, lambda = 1 / W.
    """

    @property
    def parameter_shapes(self) -> dict[str, tuple[int, ...]]:
        return {"log_scales4": (4,), "quats_left": (4,), "quats_right": (4,)}

    @property
    def motion_names(self) -> tuple[str, ...]:
        return ()

    def log_precision(self, params: Params) -> Tensor:
        return -torch.log(_variance_in_time(params["log_scales4"], params["quats_left"], params["quats_right"]))

    def state(self, params: Params, t: float) -> MotionState:
        _, V, W = covariances_4d(params["log_scales4"], params["quats_left"], params["quats_right"])
        tau = t - params["times"]
        velocity = V / W[:, None]
        return MotionState(
            means=params["means"] + tau[:, None] * velocity,
            velocities=velocity,
            presence=torch.exp(-0.5 * tau * tau / W),
            covars=_conditional_covariances(params["log_scales4"], params["quats_left"], params["quats_right"]),
        )

    def recentred(self, params: Params, shift: Tensor) -> dict[str, Tensor]:
        _, V, W = covariances_4d(params["log_scales4"], params["quats_left"], params["quats_right"])
        moved = params["means"] + shift[:, None] * V / W[:, None]
        return {**params, "means": moved, "times": params["times"] + shift}

    def with_precision(self, params: Params, log_lambda: float) -> dict[str, Tensor]:
        host = {name: value.cpu() for name, value in params.items()}
        state = self.state(host, 0.0)
        assert state.covars is not None
        moments = self.from_moments(state.covars, state.velocities, torch.full((len(state.means),), log_lambda))
        return {**params, **{name: value.to(params[name]) for name, value in moments.items()}}

    @staticmethod
    def from_moments(covars: Tensor, velocities: Tensor, log_lambdas: Tensor) -> dict[str, Tensor]:
        """Parameters whose conditional covariance is ``covars`` [N, 3, 3], with velocities [N, 3] and precision [N]."""
        W = torch.exp(-log_lambdas.double())
        V = velocities.double() * W[:, None]
        sigma = torch.zeros(len(W), 4, 4, dtype=torch.float64)
        sigma[:, 0, 0], sigma[:, 1:, 0], sigma[:, 0, 1:] = W, V, V
        sigma[:, 1:, 1:] = covars.double() + V[:, :, None] * V[:, None, :] / W[:, None, None]
        values, R = torch.linalg.eigh(sigma)
        # Time last in scales4: put the eigenvector that is closest to the time axis first.
        order = R[:, 0].abs().argmax(1)
        columns = (order[:, None] + torch.arange(4)) % 4
        R = torch.gather(R, 2, columns[:, None].expand(-1, 4, -1))
        values = torch.gather(values, 1, columns).clamp(min=1e-16)
        R[:, :, 0] *= torch.linalg.det(R).sign()[:, None]
        # Isoclinic decomposition: the associate matrix of a rotation has rank one, left times right quaternion. Its entries are
        # projections of R on the products of the left and right basis matrices.
        units = torch.eye(4, dtype=torch.float64)
        left, right = _left_matrix(units), _right_matrix(units)
        products = torch.einsum("aij,bjk->abik", left, right)
        associate = torch.einsum("nij,abij->nab", R, products) / 4
        u, _, v = torch.linalg.svd(associate)
        scales = 0.5 * torch.log(values)
        return {
            "log_scales4": scales[:, [1, 2, 3, 0]].float(),
            "quats_left": u[:, :, 0].float(),
            "quats_right": v[:, 0].float(),
        }
