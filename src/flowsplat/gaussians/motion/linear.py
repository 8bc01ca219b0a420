"""The linear 4D Gaussian of 4DGS: a 4D normal distribution, cut at a time (docs/method/representation.md)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from flowsplat.gaussians.model_config import ModelConfig
from flowsplat.gaussians.motion.protocol import FusedKernels, MotionState, Parameter, Params, Shape, register
from flowsplat.geometry.rotations import covariances, normalize_quats


def _make_left_matrix(q: Tensor) -> Tensor:
    """Return [N, 4, 4] with q p = L(q) p for quaternions wxyz."""
    w, x, y, z = q.unbind(-1)
    return torch.stack([w, -x, -y, -z, x, w, -z, y, y, z, w, -x, z, -y, x, w], -1).unflatten(-1, (4, 4))


def _right_matrix(q: Tensor) -> Tensor:
    """Return [N, 4, 4] with p q = R(q) p for quaternions wxyz."""
    w, x, y, z = q.unbind(-1)
    return torch.stack([w, -x, -y, -z, x, w, z, -y, y, -z, w, x, z, y, -x, w], -1).unflatten(-1, (4, 4))


def covariances_4d(log_scales4: Tensor, quats_left: Tensor, quats_right: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Sigma_4D = R4 S4 S4^T R4^T as its blocks U [N, 3, 3], V [N, 3] and W [N]; scales4 in the order x, y, z, t.

    R4 is the product of a left and a right isoclinic rotation, the quaternion's scalar axis being time.
    """
    R = _make_left_matrix(normalize_quats(quats_left)) @ _right_matrix(normalize_quats(quats_right))
    M = R * torch.exp(log_scales4)[:, None, [3, 0, 1, 2]]
    sigma = M @ M.transpose(1, 2)
    return sigma[:, 1:, 1:], sigma[:, 1:, 0], sigma[:, 0, 0]


def _conditional_covariances(log_scales4: Tensor, quats_left: Tensor, quats_right: Tensor) -> Tensor:
    """U - V V^T / W [N, 3, 3], as the inverse of the spatial block of Sigma_4D^-1.

    That is the same, but the difference is lost in float32 where a Gaussian lasts long: of background with W = 1e6, U is millions
    of times the covariance that is left.
    """
    R = _make_left_matrix(normalize_quats(quats_left)) @ _right_matrix(normalize_quats(quats_right))
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
    def parameters(self) -> dict[str, Parameter]:
        """See ``MotionModel``."""
        return {
            "log_scales4": Parameter((4,), "scale", fades=True),
            "quats_left": Parameter((4,), "rotation", fades=True),
            "quats_right": Parameter((4,), "rotation", fades=True),
        }

    @property
    def kernels(self) -> FusedKernels | None:
        """None: see ``MotionModel``."""
        return None

    def log_precision(self, params: Params) -> Tensor:
        """See ``MotionModel``."""
        return -torch.log(_variance_in_time(params["log_scales4"], params["quats_left"], params["quats_right"]))

    def state(self, params: Params, t: float | Tensor) -> MotionState:
        """See ``MotionModel``."""
        _, V, W = covariances_4d(params["log_scales4"], params["quats_left"], params["quats_right"])
        tau = t - params["times"]
        velocity = V / W[:, None]
        return MotionState(
            means=params["means"] + tau[:, None] * velocity,
            velocities=velocity,
            presence=torch.exp(-0.5 * tau * tau / W),
            covars=_conditional_covariances(params["log_scales4"], params["quats_left"], params["quats_right"]),
        )

    def at_rest(self, params: Params) -> Shape:
        """See ``MotionModel``."""
        return Shape(covars=_conditional_covariances(params["log_scales4"], params["quats_left"], params["quats_right"]))

    def log_scales(self, params: Params) -> Tensor | None:
        """None: see ``MotionModel``."""
        return None

    def start(
        self, means: Tensor, times: Tensor, quats: Tensor, scales: Tensor, log_lambdas: Tensor, coefficients: Tensor
    ) -> dict[str, Tensor]:  # fmt: skip
        """See ``MotionModel``; of the coefficients the first one, the velocity, is used."""
        velocities = coefficients[:, 0] if coefficients.shape[1] else torch.zeros(len(quats), 3)
        return self.from_moments(covariances(quats, scales), velocities, log_lambdas)

    def recenter(self, params: Params, shift: Tensor) -> dict[str, Tensor]:
        """See ``MotionModel``."""
        _, V, W = covariances_4d(params["log_scales4"], params["quats_left"], params["quats_right"])
        moved = params["means"] + shift[:, None] * V / W[:, None]
        return {**params, "means": moved, "times": params["times"] + shift}

    def with_precision(self, params: Params, log_lambda: float) -> dict[str, Tensor]:
        """See ``MotionModel``."""
        host = {name: value.cpu() for name, value in params.items()}
        state = self.state(host, 0.0)
        assert state.covars is not None
        moments = self.from_moments(state.covars, state.velocities, torch.full((len(state.means),), log_lambda))
        return {**params, **{name: value.to(params[name]) for name, value in moments.items()}}

    def shrunk(self, params: Params, log_factor: float, in_time: Tensor) -> dict[str, Tensor]:
        """See ``MotionModel``; the temporal one shrinks like the other scales, in time or not."""
        return {**params, "log_scales4": params["log_scales4"] - log_factor}

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
        left, right = _make_left_matrix(units), _right_matrix(units)
        products = torch.einsum("aij,bjk->abik", left, right)
        associate = torch.einsum("nij,abij->nab", R, products) / 4
        u, _, v = torch.linalg.svd(associate)
        scales = 0.5 * torch.log(values)
        return {
            "log_scales4": scales[:, [1, 2, 3, 0]].float(),
            "quats_left": u[:, :, 0].float(),
            "quats_right": v[:, 0].float(),
        }


@register("linear", "Linear", "The linear 4D Gaussian of 4DGS.")
def _from_settings(_: ModelConfig) -> LinearMotion:
    return LinearMotion()
