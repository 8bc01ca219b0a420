"""A few rigid motions that all Gaussians blend, those of Shape of Motion (docs/method/representation.md, "Motion models of
others")."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from flowsplat.gaussians.model_config import ModelConfig
from flowsplat.gaussians.motion.knots import cubic_weights
from flowsplat.gaussians.motion.protocol import MotionState, Parameter, Params, presence, register
from flowsplat.gaussians.motion.sharing import SharedMotion, SharedParameter
from flowsplat.geometry.rotations import multiply_quats, normalize_quats, quats_to_rotations

BASIS_RATE = 1e-3
"""Learning rate of the bases at the start. Chosen by eye."""
CLUSTER_ROUNDS = 10
"""Rounds of k-means that group the first Gaussians. Chosen by eye."""
CLUSTER_SHARPNESS = 4.0
"""Logit that separates a group from one that is as far off as groups are from their members on average. Chosen by eye."""

RESTING_LOGIT = 2 * CLUSTER_SHARPNESS
"""Logit of the last basis for what begins at rest; the others have 0. Chosen by eye."""


@dataclass(frozen=True)
class BasesMotion(SharedMotion):
    """mu(t) = T(t) T(mu_t)^-1 mean, and so the rotation, with T a blend of B rigid motions that all Gaussians share.

    Shape of Motion: 4D Reconstruction from a Single Video, https://arxiv.org/abs/2407.13764, equation 3: T = sum_b w_b T_b, with
    weights w of each Gaussian (softmax, so that they stay positive). There a basis has a matrix for every frame and blends 6D
    rotations; here it is a cubic B-spline over the clip, which has a velocity at every time, and blends quaternions. The mean is
    where a Gaussian is at its own center time, not in the first frame.
    """

    knots: int
    bases: int

    @property
    def parameters(self) -> dict[str, Parameter]:
        """See ``MotionModel``."""
        return {**super().parameters, "basis_logits": Parameter((self.bases,), "motion", moves=True)}

    @property
    def shared_parameters(self) -> dict[str, SharedParameter]:
        """See ``SharedMotion``."""
        return {
            "basis_quats": SharedParameter((self.bases, self.knots, 4), BASIS_RATE),
            "basis_translations": SharedParameter((self.bases, self.knots, 3), BASIS_RATE),
        }

    def initial_shared(self) -> dict[str, Tensor]:
        """See ``SharedMotion``."""
        upright = torch.tensor([1.0, 0.0, 0.0, 0.0])
        return {
            "basis_quats": upright.expand(self.bases, self.knots, 4).clone(),
            "basis_translations": torch.zeros(self.bases, self.knots, 3),
        }

    def start(
        self, means: Tensor, times: Tensor, quats: Tensor, scales: Tensor, log_lambdas: Tensor, coefficients: Tensor
    ) -> dict[str, Tensor]:  # fmt: skip
        """See ``MotionModel``: Gaussians that are near each other and move alike have the same basis most, those without a path the
        last one, which rests at the start."""
        common = super().start(means, times, quats, scales, log_lambdas, coefficients)
        follow = coefficients.flatten(1).any(1)
        if not bool(follow.any()):
            # By places alone: with one blend for all, bases that begin alike would stay alike.
            return {**common, "basis_logits": _group(means, torch.zeros_like(means), self.bases)} if len(means) else common
        moving = max(self.bases - 1, 1)
        logits = means.new_zeros(len(means), self.bases)
        logits[follow, :moving] = _group(means[follow], coefficients[follow, 0], moving)
        logits[follow, moving:] = logits[follow, :moving].amin(1, keepdim=True)
        logits[~follow, moving:] = RESTING_LOGIT
        return {**common, "basis_logits": logits}

    def start_shared(self, params: Params, coefficients: Tensor, dynamic: Tensor) -> dict[str, Tensor]:
        """See ``SharedMotion``; the last basis rests, where there are others."""
        found = super().start_shared(params, coefficients, dynamic)
        if self.bases > 1:
            for name, value in self.initial_shared().items():
                found[name][-1] = value[-1]
        return found

    def state(self, params: Params, t: float | Tensor) -> MotionState:
        """See ``MotionModel``."""
        times = params["times"]
        weights, rates = cubic_weights(torch.as_tensor(t, dtype=times.dtype, device=times.device).expand_as(times), self.knots)
        blend = torch.softmax(params["basis_logits"], 1)
        own = self._blend(cubic_weights(times, self.knots)[0], blend)
        now, rate = self._blend(weights, blend), self._blend(rates, blend)
        # T(t) T(mu_t)^-1, with quaternions of any length.
        turn = multiply_quats(now[:, :4], _conjugate(own[:, :4]))
        arm = (quats_to_rotations(turn) @ (params["means"] - own[:, 4:])[..., None])[..., 0]
        squared = (now[:, :4] ** 2).sum(1, keepdim=True).clamp(min=1e-24)
        spin = 2 * multiply_quats(rate[:, :4], _conjugate(now[:, :4]))[:, 1:] / squared
        return MotionState(
            means=arm + now[:, 4:],
            velocities=torch.linalg.cross(spin, arm) + rate[:, 4:],
            presence=presence(times, params["log_lambdas"], t),
            quats=multiply_quats(normalize_quats(turn), params["quats"]),
            scales=torch.exp(params["log_scales"]),
        )

    def _blend(self, weights: Tensor, blend: Tensor) -> Tensor:
        """Return [N, 7] the quaternion and the translation of every Gaussian, from weights [N, knots] and [N, bases]."""
        together = torch.cat([self.read_shared(name, weights) for name in ("basis_quats", "basis_translations")], 2)
        each = (weights @ together.transpose(0, 1).flatten(1)).unflatten(1, (self.bases, 7))
        return torch.bmm(blend[:, None], each)[:, 0]


def _conjugate(quats: Tensor) -> Tensor:
    return quats * quats.new_tensor([1.0, -1.0, -1.0, -1.0])


def _group(means: Tensor, velocities: Tensor, count: int) -> Tensor:
    """Return [N, count] logits of groups of Gaussians by place and velocity [N, 3], both in units of their spread (k-means)."""
    features = torch.cat([_scale(means), _scale(velocities)], 1)
    centers = features[:1]
    for _ in range(1, count):  # each as far from the others as any is
        farthest = torch.cdist(features, centers).amin(1).argmax()
        centers = torch.cat([centers, features[farthest][None]])
    for _ in range(CLUSTER_ROUNDS):
        members = torch.nn.functional.one_hot(torch.cdist(features, centers).argmin(1), count).to(features)
        held = members.sum(0)[:, None]
        centers = torch.where(held > 0, members.T @ features / held.clamp(min=1), centers)
    squared = torch.cdist(features, centers) ** 2
    return -CLUSTER_SHARPNESS * squared / squared.amin(1).mean().clamp(min=1e-12)


def _scale(values: Tensor) -> Tensor:
    centered = values - values.mean(0)
    return centered / centered.norm(dim=1).mean().clamp(min=1e-12)


@register("bases", "Bases", "Blends of a few rigid motions that all share, as Shape of Motion.")
def _from_settings(settings: ModelConfig) -> BasesMotion:
    return BasesMotion(settings.knots, settings.bases)
