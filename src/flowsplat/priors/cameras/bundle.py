"""Bundle adjustment: poses, points and one shared lens that together explain where points were seen.

Levenberg-Marquardt with a Cauchy cost and the Schur complement over the points (Triggs et al., "Bundle adjustment - a
modern synthesis", https://doi.org/10.1007/3-540-44480-7_21). The sums over observations are Numba loops.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import scipy.linalg
from scipy.spatial.transform import Rotation

from flowsplat.common.kernels import kernel
from flowsplat.priors.cameras.observations import Observations

MIN_DEPTH = 1e-4
"""Depths below this are replaced by it: such an observation is an outlier and only has to stay finite."""
POINTS_PER_GROUP = 256
"""Points that are eliminated together. Chosen by eye."""
LENS_PARAMETERS = 2
"""Parameters that all cameras share: the distortion, then the logarithm of the focal length."""
MIN_INVERSE_LEFT = 0.1
"""Share of a point's inverse distance that a step leaves at least. Chosen by eye."""
USUAL_DISTORTION = 0.3
"""Distortion that costs as much as a focal length that is wrong by a factor of e. Chosen by eye."""


@dataclass(frozen=True)
class Reconstruction:
    """Poses, points and the lens.

    Attributes:
        rotations: [T, 3, 3] world to camera.
        translations: [T, 3] world to camera.
        focal: pixels.
        points: [N, 3] world.
        distortion: k1 of the radial model x_d = x (1 + k1 |x|^2), x = (X/Z, Y/Z).
    """

    rotations: np.ndarray
    translations: np.ndarray
    focal: float
    points: np.ndarray
    distortion: float = 0.0

    @property
    def centers(self) -> np.ndarray:
        """[T, 3] the cameras' positions in the world."""
        return -np.einsum("tji,tj->ti", self.rotations, self.translations)


class CameraPrior(Protocol):
    """What is expected of cameras before tracks are looked at."""

    def compute_cost(self, state: Reconstruction) -> float:
        """Return square pixels."""

    def add_to(self, H: np.ndarray, g: np.ndarray, state: Reconstruction) -> None:
        """Add the gradient and the curvature to the normal equations [6T + LENS_PARAMETERS], in place."""


@dataclass(frozen=True)
class LensPrior:
    """Pulls the lens to an expected focal length and to no distortion.

    cost = weight * ((log focal - log expected)^2 + (distortion / USUAL_DISTORTION)^2) in square pixels.
    """

    expected: float
    weight: float

    def compute_cost(self, state: Reconstruction) -> float:
        """Return square pixels."""
        return self.weight * float(np.log(state.focal / self.expected) ** 2 + (state.distortion / USUAL_DISTORTION) ** 2)

    def add_to(self, H: np.ndarray, g: np.ndarray, state: Reconstruction) -> None:
        """Add the gradient and the curvature to the normal equations, in place."""
        H[-1, -1] += self.weight
        g[-1] -= self.weight * np.log(state.focal / self.expected)
        H[-2, -2] += self.weight / USUAL_DISTORTION**2
        g[-2] -= self.weight * state.distortion / USUAL_DISTORTION**2


@dataclass(frozen=True)
class Adjusted:
    """What ``adjust`` found.

    Attributes:
        reconstruction: the best state.
        cost: the robust cost without the prior, square pixels.
        focal_precision: curvature of the cost along log focal once all else has adapted (square pixels); 0 where fixed.
        distortion_precision: the same along the distortion.
    """

    reconstruction: Reconstruction
    cost: float
    focal_precision: float
    distortion_precision: float = 0.0


def adjust(
    start: Reconstruction,
    seen: Observations,
    *,
    iterations: int,
    scale: float,
    fixed_camera: int,
    free_focal: bool = True,
    free_translations: bool = True,
    free_distortion: bool = False,
    priors: Sequence[CameraPrior] = (),
    tolerance: float = 1e-4,
) -> Adjusted:
    """Minimize the sum of scale^2 log(1 + |residual|^2 / scale^2) over poses, points, focal length and distortion.

    Args:
        scale: pixels; residuals beyond it lose their influence.
        fixed_camera: the camera whose pose defines the world.
        free_translations: off, cameras only rotate.
        priors: what is expected of lens and path; their costs are added.
        tolerance: stop when an iteration lowers the cost by less than this fraction.
    """
    count = len(start.rotations)
    first = seen.first
    index = free_parameters(count, fixed_camera, free_focal, free_distortion, free_translations)
    state, damping, precisions = start, 1e-4, (0.0, 0.0)
    cost = _total(state, seen, scale, priors)
    for _ in range(iterations):
        H, g, Hp, gp, cross, cross_lens = _linearize(*_plain(state, seen), scale)
        for each in priors:
            each.add_to(H, g, state)
        for _attempt in range(8):
            inverse = _invert_damped(Hp, damping)
            S, b = H + np.diag(np.diag(H) * damping + 1e-9), g.copy()
            _eliminate_points(first, seen.camera, cross, cross_lens, inverse, gp, S, b)
            step = np.zeros(len(g))
            try:
                factor = scipy.linalg.cho_factor(S[np.ix_(index, index)], lower=True, overwrite_a=True, check_finite=False)
                step[index] = scipy.linalg.cho_solve(factor, b[index], check_finite=False)
            except scipy.linalg.LinAlgError:
                damping *= 10
                continue
            point_steps = _point_steps(first, seen.camera, cross, cross_lens, inverse, gp, step)
            if free_translations:
                step, point_steps = _remove_scale(state, step, point_steps, fixed_camera)
                points = _step(state.points, point_steps, state.centers.mean(0))
            else:
                points = state.points + point_steps
            trial = _move(state, step, points)
            trial_cost = _total(trial, seen, scale, priors)
            if trial_cost <= cost:
                precisions = _precisions(factor[0], free_focal, free_distortion)
                break
            damping *= 8
        else:
            break
        converged = cost - trial_cost <= tolerance * cost
        state, cost, damping = trial, trial_cost, max(damping / 6, 1e-8)
        if converged:
            break
    return Adjusted(state, _total(state, seen, scale, ()), *precisions)


def free_parameters(count: int, fixed_camera: int, focal: bool, distortion: bool, translations: bool = True) -> np.ndarray:
    """Return indices of the parameters [6 count + LENS_PARAMETERS] of poses and lens that may change."""
    free = np.ones(6 * count + LENS_PARAMETERS, bool)
    free[6 * fixed_camera : 6 * fixed_camera + 6] = False
    if not translations:
        free[:-LENS_PARAMETERS].reshape(count, 6)[:, 3:] = False
    free[-LENS_PARAMETERS:] = distortion, focal
    return np.flatnonzero(free)


def compute_scale_direction(state: Reconstruction, fixed_camera: int) -> np.ndarray:
    """Return [T, 3] by how much translations change where all becomes larger about the fixed camera, which no image tells."""
    return np.einsum("tij,tj->ti", state.rotations, state.centers[fixed_camera] - state.centers)


def information(state: Reconstruction, seen: Observations, scale: float, priors: Sequence[CameraPrior]) -> np.ndarray:
    """Curvature [6T + LENS_PARAMETERS, 6T + LENS_PARAMETERS] of the cost along poses and lens, once all points have adapted."""
    first = seen.first
    H, g, Hp, gp, cross, cross_lens = _linearize(*_plain(state, seen), scale)
    for each in priors:
        each.add_to(H, g, state)
    _eliminate_points(first, seen.camera, cross, cross_lens, _invert_damped(Hp, 0.0), gp, H, g)
    lower = np.tril(H)
    return lower + np.tril(lower, -1).T


def _precisions(L: np.ndarray, focal: bool, distortion: bool) -> tuple[float, float]:
    """Return the standard deviations of log focal and of the distortion, from the Cholesky factor of the normal equations; 0 where
    fixed."""
    last = float(L[-1, -1] ** 2)
    if not (focal and distortion):
        return last * focal, last * distortion
    return last, float(L[-2, -2] ** 2) * last / (last + float(L[-1, -2] ** 2))


def rays(uv: np.ndarray, focal: float, distortion: float) -> np.ndarray:
    """Return (X/Z, Y/Z) [..., 2] of the points that are seen at ``uv`` [..., 2], pixels from the principal point."""
    bent = np.asarray(uv, np.float64) / focal
    if distortion == 0:
        return bent
    far = np.linalg.norm(bent, axis=-1, keepdims=True)
    # Beyond the fold of a strong barrel nothing is seen: there the slope is kept positive and the result only finite.
    straight = far.copy()
    for _ in range(12):
        slope = np.maximum(1 + 3 * distortion * straight**2, 0.1)
        straight = np.maximum(straight - (straight * (1 + distortion * straight**2) - far) / slope, 0)
    return bent * (straight / np.maximum(far, 1e-12))


def residuals(state: Reconstruction, seen: Observations) -> tuple[np.ndarray, np.ndarray]:
    """Reprojection errors [M] in pixels and depths [M] of all observations."""
    return _reproject(*_plain(state, seen))


def _plain(state: Reconstruction, seen: Observations) -> tuple:
    """Return what the compiled loops take."""
    lens = (state.focal, state.distortion)
    return (state.rotations, state.translations, *lens, state.points, seen.camera, seen.point, seen.uv)


def _total(state: Reconstruction, seen: Observations, scale: float, priors: Sequence[CameraPrior]) -> float:
    errors, _ = residuals(state, seen)
    cost = scale**2 * float(np.log1p((errors / scale) ** 2).sum()) + sum(prior.compute_cost(state) for prior in priors)
    return cost if np.isfinite(cost) else np.inf


def _move(state: Reconstruction, step: np.ndarray, points: np.ndarray) -> Reconstruction:
    poses = step[:-LENS_PARAMETERS].reshape(-1, 6)
    return replace(
        state,
        rotations=Rotation.from_rotvec(poses[:, :3]).as_matrix() @ state.rotations,
        translations=state.translations + poses[:, 3:],
        focal=state.focal * float(np.exp(np.clip(step[-1], -0.5, 0.5))),
        points=points,
        distortion=state.distortion + float(np.clip(step[-2], -0.1, 0.1)),
    )


def _remove_scale(
    state: Reconstruction, step: np.ndarray, point_steps: np.ndarray, fixed_camera: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return a step without its share of a change of scale about the fixed camera, which no image tells: it is small where all
    is."""
    middle, travel = state.centers[fixed_camera], compute_scale_direction(state, fixed_camera)
    poses = step[:-LENS_PARAMETERS].reshape(-1, 6)
    scale = float((travel * poses[:, 3:]).sum()) / max(float((travel**2).sum()), 1e-18)
    kept = step.copy()
    kept[:-LENS_PARAMETERS].reshape(-1, 6)[:, 3:] -= scale * travel
    return kept, point_steps - scale * (state.points - middle)


def _step(points: np.ndarray, steps: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Return points [N, 3] after steps [N, 3] that are linear in the inverse of their distance from the cameras, as images nearly
    are.

    The same to first order as adding the steps, but a far point, whose distance the images hardly tell, is neither sent behind
    the cameras nor does it hold up all others.
    """
    offset = points - center
    square = np.maximum((offset**2).sum(1, keepdims=True), 1e-24)
    outwards = (offset * steps).sum(1, keepdims=True) / square
    aside = steps - outwards * offset
    return center + (offset + aside) / np.maximum(1 - outwards, MIN_INVERSE_LEFT)


def _invert_damped(Hp: np.ndarray, damping: float) -> np.ndarray:
    diagonal = np.einsum("nii->ni", Hp)
    # Far points and pure rotations leave the depth free: a floor relative to the whole block keeps it invertible.
    floor = 1e-9 * diagonal.sum(1, keepdims=True) + 1e-12
    damped = Hp.copy()
    np.einsum("nii->ni", damped)[:] += damping * diagonal + floor
    return np.linalg.inv(damped)


@kernel
def _linearize(R, t, focal, k1, X, camera, point, uv, scale):
    """Normal equations: cameras and lens H, g; points Hp, gp; and the blocks between them.

    Those between cameras and points are one an observation [M, 6, 3], those between lens and points one a point [N, 3, 2].
    """
    size = 6 * len(R) + LENS_PARAMETERS
    H, g = np.zeros((size, size)), np.zeros(size)
    Hp, gp = np.zeros((len(X), 3, 3)), np.zeros((len(X), 3))
    cross, cross_lens = np.zeros((len(camera), 6, 3)), np.zeros((len(X), 3, LENS_PARAMETERS))
    Jc, Jp, Jl, r = np.zeros((2, 6)), np.zeros((2, 3)), np.zeros((2, LENS_PARAMETERS)), np.zeros(2)
    for m in range(len(camera)):
        c, n = camera[m], point[m]
        M = R[c]
        x = M[0, 0] * X[n, 0] + M[0, 1] * X[n, 1] + M[0, 2] * X[n, 2]
        y = M[1, 0] * X[n, 0] + M[1, 1] * X[n, 1] + M[1, 2] * X[n, 2]
        z = M[2, 0] * X[n, 0] + M[2, 1] * X[n, 1] + M[2, 2] * X[n, 2]
        inverse = 1.0 / max(z + t[c, 2], MIN_DEPTH)
        a, b = (x + t[c, 0]) * inverse, (y + t[c, 1]) * inverse
        square = a * a + b * b
        bend = 1.0 + k1 * square
        Jl[0, 0], Jl[1, 0] = focal * a * square, focal * b * square
        Jl[0, 1], Jl[1, 1] = focal * a * bend, focal * b * bend
        r[0], r[1] = Jl[0, 1] - uv[m, 0], Jl[1, 1] - uv[m, 1]
        w = 1.0 / (1.0 + (r[0] * r[0] + r[1] * r[1]) / (scale * scale))
        f = focal * inverse
        mixed = 2.0 * k1 * a * b * f
        for k in range(2):
            dx = f * (bend + 2.0 * k1 * a * a) if k == 0 else mixed
            dy = mixed if k == 0 else f * (bend + 2.0 * k1 * b * b)
            dz = -(dx * a + dy * b)
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
            for j in range(LENS_PARAMETERS):
                H[size - LENS_PARAMETERS + j, o + i] += w * (Jc[0, i] * Jl[0, j] + Jc[1, i] * Jl[1, j])
            g[o + i] -= w * (Jc[0, i] * r[0] + Jc[1, i] * r[1])
        for i in range(LENS_PARAMETERS):
            for j in range(LENS_PARAMETERS):
                H[size - LENS_PARAMETERS + i, size - LENS_PARAMETERS + j] += w * (Jl[0, i] * Jl[0, j] + Jl[1, i] * Jl[1, j])
            g[size - LENS_PARAMETERS + i] -= w * (Jl[0, i] * r[0] + Jl[1, i] * r[1])
        for i in range(3):
            for j in range(3):
                Hp[n, i, j] += w * (Jp[0, i] * Jp[0, j] + Jp[1, i] * Jp[1, j])
            for j in range(LENS_PARAMETERS):
                cross_lens[n, i, j] += w * (Jl[0, j] * Jp[0, i] + Jl[1, j] * Jp[1, i])
            gp[n, i] -= w * (Jp[0, i] * r[0] + Jp[1, i] * r[1])
    for i in range(size - LENS_PARAMETERS):
        for j in range(LENS_PARAMETERS):
            H[i, size - LENS_PARAMETERS + j] = H[size - LENS_PARAMETERS + j, i]
    return H, g, Hp, gp, cross, cross_lens


def _eliminate_points(
    first: np.ndarray, camera: np.ndarray, cross: np.ndarray, cross_lens: np.ndarray, inverse: np.ndarray, gp: np.ndarray,
    S: np.ndarray, b: np.ndarray,
) -> None:  # fmt: skip
    """Subtract from the lower half of S, which is all that is read, and from b what the points take up, in place.

    Tracks are taken in groups; within the frames that a group spans the blocks are a dense matrix, so that the product
    is one call to BLAS. Tracks in the order of their birth make groups that span few frames.
    """
    roots = np.linalg.cholesky(inverse)
    for low in range(0, len(gp), POINTS_PER_GROUP):
        high = min(low + POINTS_PER_GROUP, len(gp))
        m = slice(first[low], first[high])
        if m.start == m.stop:
            continue
        begin, end = int(camera[m].min()), int(camera[m].max()) + 1
        factor = _group_factor(
            first[low : high + 1] - first[low], camera[m] - begin, cross[m], cross_lens[low:high], roots[low:high],
            end - begin,
        )  # fmt: skip
        # Blocks are addressed by slices: gathering rows would cost as much as the product.
        product = factor @ factor.T
        right = factor @ np.einsum("nji,nj->ni", roots[low:high], gp[low:high]).ravel()
        cameras = slice(6 * begin, 6 * end)
        S[cameras, cameras] -= product[:-LENS_PARAMETERS, :-LENS_PARAMETERS]
        S[-LENS_PARAMETERS:, cameras] -= product[-LENS_PARAMETERS:, :-LENS_PARAMETERS]
        S[-LENS_PARAMETERS:, -LENS_PARAMETERS:] -= product[-LENS_PARAMETERS:, -LENS_PARAMETERS:]
        b[cameras] -= right[:-LENS_PARAMETERS]
        b[-LENS_PARAMETERS:] -= right[-LENS_PARAMETERS:]


@kernel
def _group_factor(first, camera, cross, cross_lens, roots, cameras):
    """[6 cameras + 2, 3 points]: the blocks between cameras with lens and points, times the roots of the inverses."""
    count = len(roots)
    result = np.zeros((6 * cameras + LENS_PARAMETERS, 3 * count))
    for n in range(count):
        L = roots[n]
        for j in range(3):
            for k in range(j, 3):
                for i in range(LENS_PARAMETERS):
                    result[6 * cameras + i, 3 * n + j] += cross_lens[n, k, i] * L[k, j]
        for m in range(first[n], first[n + 1]):
            o = 6 * camera[m]
            for i in range(6):
                for j in range(3):
                    total = 0.0
                    for k in range(j, 3):
                        total += cross[m, i, k] * L[k, j]
                    result[o + i, 3 * n + j] = total
    return result


@kernel
def _reproject(R, t, focal, k1, X, camera, point, uv):
    errors, depths = np.empty(len(camera)), np.empty(len(camera))
    for m in range(len(camera)):
        c, n = camera[m], point[m]
        M = R[c]
        x = M[0, 0] * X[n, 0] + M[0, 1] * X[n, 1] + M[0, 2] * X[n, 2] + t[c, 0]
        y = M[1, 0] * X[n, 0] + M[1, 1] * X[n, 1] + M[1, 2] * X[n, 2] + t[c, 1]
        z = M[2, 0] * X[n, 0] + M[2, 1] * X[n, 1] + M[2, 2] * X[n, 2] + t[c, 2]
        a, b = x / max(z, MIN_DEPTH), y / max(z, MIN_DEPTH)
        f = focal * (1.0 + k1 * (a * a + b * b))
        errors[m], depths[m] = np.hypot(f * a - uv[m, 0], f * b - uv[m, 1]), z
    return errors, depths


@kernel
def _point_steps(first, camera, cross, cross_lens, inverse, gp, step):
    """Steps [N, 3] of the points, given the step of the cameras and the lens."""
    result = np.zeros_like(gp)
    v = np.zeros(3)
    for n in range(len(gp)):
        for j in range(3):
            v[j] = gp[n, j]
            for i in range(LENS_PARAMETERS):
                v[j] -= cross_lens[n, j, i] * step[len(step) - LENS_PARAMETERS + i]
        for m in range(first[n], first[n + 1]):
            o = 6 * camera[m]
            for j in range(3):
                for i in range(6):
                    v[j] -= cross[m, i, j] * step[o + i]
        for i in range(3):
            result[n, i] = inverse[n, i, 0] * v[0] + inverse[n, i, 1] * v[1] + inverse[n, i, 2] * v[2]
    return result
