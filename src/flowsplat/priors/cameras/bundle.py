"""Bundle adjustment: poses, points and one shared focal length that together explain where points were seen.

Levenberg-Marquardt with a Cauchy cost and the Schur complement over the points (Triggs et al., "Bundle adjustment - a
modern synthesis", https://doi.org/10.1007/3-540-44480-7_21). The sums over observations are Numba loops.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
from numba import njit
from scipy.spatial.transform import Rotation

NEAR = 1e-4
"""Depths below this are replaced by it: such an observation is an outlier and only has to stay finite."""
GROUP = 256
"""Points that are eliminated together."""


@dataclass(frozen=True)
class Reconstruction:
    """Poses, points and focal length.

    Attributes:
        rotations: [T, 3, 3] world to camera.
        translations: [T, 3] world to camera.
        focal: pixels.
        points: [N, 3] world.
    """

    rotations: np.ndarray
    translations: np.ndarray
    focal: float
    points: np.ndarray

    @property
    def centers(self) -> np.ndarray:
        """[T, 3] the cameras' positions in the world."""
        return -np.einsum("tji,tj->ti", self.rotations, self.translations)


@dataclass(frozen=True)
class Observations:
    """Which camera saw which point where, ordered by point.

    Attributes:
        camera: [M] int64.
        point: [M] int64, not falling.
        uv: [M, 2] float64 pixels from the principal point.
    """

    camera: np.ndarray
    point: np.ndarray
    uv: np.ndarray

    @staticmethod
    def of(positions: np.ndarray, seen: np.ndarray) -> Observations:
        """From positions [N, T, 2] and which of them count [N, T]."""
        point, camera = np.nonzero(seen)
        return Observations(camera, point, np.asarray(positions[point, camera], np.float64))


@dataclass(frozen=True)
class FocalPrior:
    """Pulls the logarithm of the focal length: cost = weight * (log focal - log expected)^2 in square pixels."""

    expected: float
    weight: float


@dataclass(frozen=True)
class Adjusted:
    """What ``adjust`` found.

    Attributes:
        reconstruction: the best state.
        cost: the robust cost without the prior, square pixels.
        focal_precision: curvature of the cost along log focal once all else has adapted (square pixels); 0 where fixed.
    """

    reconstruction: Reconstruction
    cost: float
    focal_precision: float


def adjust(
    start: Reconstruction,
    seen: Observations,
    *,
    iterations: int,
    scale: float,
    fixed_camera: int,
    free_focal: bool = True,
    free_translations: bool = True,
    prior: FocalPrior | None = None,
    tolerance: float = 1e-4,
) -> Adjusted:
    """Minimise the sum of scale^2 log(1 + |residual|^2 / scale^2) over poses, points and focal length.

    Args:
        scale: pixels; residuals beyond it lose their influence.
        fixed_camera: the camera whose pose defines the world.
        free_translations: off, cameras only rotate.
        tolerance: stop when an iteration lowers the cost by less than this fraction.
    """
    count = len(start.rotations)
    first = np.searchsorted(seen.point, np.arange(len(start.points) + 1))
    free = np.ones(6 * count + 1, bool)
    free[6 * fixed_camera : 6 * fixed_camera + 6] = False
    if not free_translations:
        free[:-1].reshape(count, 6)[:, 3:] = False
    free[-1] = free_focal
    index = np.flatnonzero(free)
    state, damping, precision = start, 1e-4, 0.0
    cost = _total(state, seen, scale, prior)
    for _ in range(iterations):
        normal = _linearise(state.rotations, state.translations, state.focal, state.points, seen.camera, seen.point, seen.uv, scale)
        H, g, Hp, gp, cross, cross_focal = normal
        if prior is not None and free_focal:
            H[-1, -1] += prior.weight
            g[-1] -= prior.weight * np.log(state.focal / prior.expected)
        for _attempt in range(8):
            inverse = _damped_inverses(Hp, damping)
            S, b = H + np.diag(np.diag(H) * damping + 1e-9), g.copy()
            _eliminate_points(first, seen.camera, cross, cross_focal, inverse, gp, S, b)
            step = np.zeros(len(g))
            try:
                factor = scipy.linalg.cho_factor(S[np.ix_(index, index)], lower=True, overwrite_a=True, check_finite=False)
                step[index] = scipy.linalg.cho_solve(factor, b[index], check_finite=False)
            except scipy.linalg.LinAlgError:
                damping *= 10
                continue
            trial = _moved(state, step, _point_steps(first, seen.camera, cross, cross_focal, inverse, gp, step))
            trial_cost = _total(trial, seen, scale, prior)
            if trial_cost <= cost:
                precision = float(factor[0][-1, -1] ** 2) if free_focal else 0.0
                break
            damping *= 8
        else:
            break
        converged = cost - trial_cost <= tolerance * cost
        state, cost, damping = trial, trial_cost, max(damping / 6, 1e-8)
        if converged:
            break
    return Adjusted(state, _total(state, seen, scale, None), precision)


def residuals(state: Reconstruction, seen: Observations) -> tuple[np.ndarray, np.ndarray]:
    """Reprojection errors [M] in pixels and depths [M] of all observations."""
    return _reproject(state.rotations, state.translations, state.focal, state.points, seen.camera, seen.point, seen.uv)


def _total(state: Reconstruction, seen: Observations, scale: float, prior: FocalPrior | None) -> float:
    errors, _ = residuals(state, seen)
    cost = scale**2 * float(np.log1p((errors / scale) ** 2).sum())
    if prior is not None:
        cost += prior.weight * float(np.log(state.focal / prior.expected)) ** 2
    return cost if np.isfinite(cost) else np.inf


def _moved(state: Reconstruction, step: np.ndarray, point_steps: np.ndarray) -> Reconstruction:
    poses = step[:-1].reshape(-1, 6)
    return replace(
        state,
        rotations=Rotation.from_rotvec(poses[:, :3]).as_matrix() @ state.rotations,
        translations=state.translations + poses[:, 3:],
        focal=state.focal * float(np.exp(np.clip(step[-1], -0.5, 0.5))),
        points=state.points + point_steps,
    )


def _damped_inverses(Hp: np.ndarray, damping: float) -> np.ndarray:
    diagonal = np.einsum("nii->ni", Hp)
    # Far points and pure rotations leave the depth free: a floor relative to the whole block keeps it invertible.
    floor = 1e-9 * diagonal.sum(1, keepdims=True) + 1e-12
    damped = Hp.copy()
    np.einsum("nii->ni", damped)[:] += damping * diagonal + floor
    return np.linalg.inv(damped)


@njit(cache=True)
def _linearise(R, t, focal, X, camera, point, uv, scale):
    """Normal equations: cameras with log focal H, g; points Hp, gp; and the blocks between them, one an observation."""
    size = 6 * len(R) + 1
    H, g = np.zeros((size, size)), np.zeros(size)
    Hp, gp = np.zeros((len(X), 3, 3)), np.zeros((len(X), 3))
    cross, cross_focal = np.zeros((len(camera), 6, 3)), np.zeros((len(X), 3))
    Jc, Jp, r, f = np.zeros((2, 6)), np.zeros((2, 3)), np.zeros(2), np.zeros(2)
    for m in range(len(camera)):
        c, n = camera[m], point[m]
        M = R[c]
        x = M[0, 0] * X[n, 0] + M[0, 1] * X[n, 1] + M[0, 2] * X[n, 2]
        y = M[1, 0] * X[n, 0] + M[1, 1] * X[n, 1] + M[1, 2] * X[n, 2]
        z = M[2, 0] * X[n, 0] + M[2, 1] * X[n, 1] + M[2, 2] * X[n, 2]
        inverse = 1.0 / max(z + t[c, 2], NEAR)
        f[0], f[1] = focal * (x + t[c, 0]) * inverse, focal * (y + t[c, 1]) * inverse
        r[0], r[1] = f[0] - uv[m, 0], f[1] - uv[m, 1]
        w = 1.0 / (1.0 + (r[0] * r[0] + r[1] * r[1]) / (scale * scale))
        a = focal * inverse
        for k in range(2):
            dx, dy, dz = (a, 0.0, -f[0] * inverse) if k == 0 else (0.0, a, -f[1] * inverse)
            Jc[k, 0], Jc[k, 1], Jc[k, 2] = dz * y - dy * z, dx * z - dz * x, dy * x - dx * y
            Jc[k, 3], Jc[k, 4], Jc[k, 5] = dx, dy, dz
            for j in range(3):
                Jp[k, j] = dx * M[0, j] + dy * M[1, j] + dz * M[2, j]
        o = 6 * c
        for i in range(6):
            for j in range(6):
                H[o + i, o + j] += w * (Jc[0, i] * Jc[0, j] + Jc[1, i] * Jc[1, j])
            for j in range(3):
                cross[m, i, j] = w * (Jc[0, i] * Jp[0, j] + Jc[1, i] * Jp[1, j])
            H[o + i, -1] += w * (Jc[0, i] * f[0] + Jc[1, i] * f[1])
            g[o + i] -= w * (Jc[0, i] * r[0] + Jc[1, i] * r[1])
        H[-1, -1] += w * (f[0] * f[0] + f[1] * f[1])
        g[-1] -= w * (f[0] * r[0] + f[1] * r[1])
        for i in range(3):
            for j in range(3):
                Hp[n, i, j] += w * (Jp[0, i] * Jp[0, j] + Jp[1, i] * Jp[1, j])
            cross_focal[n, i] += w * (f[0] * Jp[0, i] + f[1] * Jp[1, i])
            gp[n, i] -= w * (Jp[0, i] * r[0] + Jp[1, i] * r[1])
    for i in range(size - 1):
        H[size - 1, i] = H[i, size - 1]
    return H, g, Hp, gp, cross, cross_focal


def _eliminate_points(first, camera, cross, cross_focal, inverse, gp, S, b):
    """Subtract from S and b what the points take up, in place.

    Tracks are taken in groups; within the frames that a group spans the blocks are a dense matrix, so that the product
    is one call to BLAS. Tracks in the order of their birth make groups that span few frames.
    """
    roots = np.linalg.cholesky(inverse)
    for low in range(0, len(gp), GROUP):
        high = min(low + GROUP, len(gp))
        m = slice(first[low], first[high])
        if m.start == m.stop:
            continue
        begin, end = int(camera[m].min()), int(camera[m].max()) + 1
        factor = _group_factor(
            first[low : high + 1] - first[low], camera[m] - begin, cross[m], cross_focal[low:high], roots[low:high],
            end - begin,
        )  # fmt: skip
        rows = np.append(np.arange(6 * begin, 6 * end), len(b) - 1)
        S[rows[:, None], rows] -= factor @ factor.T
        b[rows] -= factor @ np.einsum("nji,nj->ni", roots[low:high], gp[low:high]).ravel()


@njit(cache=True)
def _group_factor(first, camera, cross, cross_focal, roots, cameras):
    """[6 cameras + 1, 3 points]: the blocks between cameras with log focal and points, times the roots of the inverses."""
    count = len(roots)
    result = np.zeros((6 * cameras + 1, 3 * count))
    for n in range(count):
        L = roots[n]
        for j in range(3):
            for k in range(j, 3):
                result[6 * cameras, 3 * n + j] += cross_focal[n, k] * L[k, j]
        for m in range(first[n], first[n + 1]):
            o = 6 * camera[m]
            for i in range(6):
                for j in range(3):
                    total = 0.0
                    for k in range(j, 3):
                        total += cross[m, i, k] * L[k, j]
                    result[o + i, 3 * n + j] = total
    return result


@njit(cache=True)
def _reproject(R, t, focal, X, camera, point, uv):
    errors, depths = np.empty(len(camera)), np.empty(len(camera))
    for m in range(len(camera)):
        c, n = camera[m], point[m]
        M = R[c]
        x = M[0, 0] * X[n, 0] + M[0, 1] * X[n, 1] + M[0, 2] * X[n, 2] + t[c, 0]
        y = M[1, 0] * X[n, 0] + M[1, 1] * X[n, 1] + M[1, 2] * X[n, 2] + t[c, 1]
        z = M[2, 0] * X[n, 0] + M[2, 1] * X[n, 1] + M[2, 2] * X[n, 2] + t[c, 2]
        a = focal / max(z, NEAR)
        errors[m], depths[m] = np.hypot(a * x - uv[m, 0], a * y - uv[m, 1]), z
    return errors, depths


@njit(cache=True)
def _point_steps(first, camera, cross, cross_focal, inverse, gp, step):
    """Steps [N, 3] of the points, given the step of the cameras and the focal length."""
    result = np.zeros_like(gp)
    v = np.zeros(3)
    for n in range(len(gp)):
        for j in range(3):
            v[j] = gp[n, j] - cross_focal[n, j] * step[-1]
        for m in range(first[n], first[n + 1]):
            o = 6 * camera[m]
            for j in range(3):
                for i in range(6):
                    v[j] -= cross[m, i, j] * step[o + i]
        for i in range(3):
            result[n, i] = inverse[n, i, 0] * v[0] + inverse[n, i, 1] * v[1] + inverse[n, i, 2] * v[2]
    return result
