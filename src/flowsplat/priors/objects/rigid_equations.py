"""The equations of a rigid motion: residuals and their derivatives, normal equations with the points eliminated, their solution.

A pose is six numbers: a small turn from the left in the object's axes of the camera, then a shift.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solveh_banded

from flowsplat.common.kernels import helper, kernel

_MIN_BANDED_RATIO = 1.5
"""Times the width of its band that a system is large at least to be solved as one. Chosen by eye."""


def solve_band(H: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the solution of H x = b, H symmetric and positive, as a band: [n, w] holds its entries (i, i + d)."""
    n, band = H.shape
    try:
        if _MIN_BANDED_RATIO * band > n:
            return np.asarray(cho_solve(cho_factor(unpack_band(H), overwrite_a=True, check_finite=False), b, check_finite=False))
        return np.asarray(solveh_banded(H.T, b, lower=True, check_finite=False))
    except np.linalg.LinAlgError:  # It is positive but for rounding.
        return np.linalg.solve(unpack_band(H), b)


@helper
def rotation(v: np.ndarray) -> np.ndarray:
    """Rodrigues' formula."""
    angle = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    K = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    if angle < 1e-9:
        return np.eye(3) + K
    return np.eye(3) + np.sin(angle) / angle * K + (1 - np.cos(angle)) / angle**2 * (K @ K)


@kernel
def turn(turns: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Turns [F, 3, 3] after a step [6F] of the poses."""
    result = np.empty_like(turns)
    for f in range(len(turns)):
        result[f] = rotation(step[6 * f : 6 * f + 3]) @ turns[f]
    return result


@kernel
def second_differences(turns: np.ndarray, shifts: np.ndarray, weight: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Return squared second differences of the poses over time, times ``weight``: a band [6F, 13], the right side [6F], and the
    cost."""
    F = len(turns)
    A, b, cost = np.zeros((6 * F, 13)), np.zeros(6 * F), 0.0
    c, r = np.array([1.0, -2.0, 1.0]), np.zeros(6)
    for i in range(1, F - 1):
        D = (turns[i + 1] @ turns[i].T) @ (turns[i] @ turns[i - 1].T).T
        r[0], r[1], r[2] = 0.5 * (D[2, 1] - D[1, 2]), 0.5 * (D[0, 2] - D[2, 0]), 0.5 * (D[1, 0] - D[0, 1])
        for d in range(3):
            r[3 + d] = shifts[i - 1, d] - 2 * shifts[i, d] + shifts[i + 1, d]
        for d in range(6):
            cost += weight * r[d] * r[d]
            for p in range(3):
                b[6 * (i + p - 1) + d] -= weight * c[p] * r[d]
                for q in range(p, 3):
                    A[6 * (i + p - 1) + d, 6 * (q - p)] += weight * c[p] * c[q]
    return A, b, cost


@helper
def derivatives(
    Q: np.ndarray, tau: np.ndarray, S: np.ndarray, x: np.ndarray, focal: float, r: np.ndarray, J: np.ndarray, B: np.ndarray
) -> None:
    """Residual r [2] of one observation, its derivatives J [2, 6] by the pose and B [2, 3] by the point."""
    y0 = Q[0, 0] * S[0] + Q[0, 1] * S[1] + Q[0, 2] * S[2]
    y1 = Q[1, 0] * S[0] + Q[1, 1] * S[1] + Q[1, 2] * S[2]
    y2 = Q[2, 0] * S[0] + Q[2, 1] * S[1] + Q[2, 2] * S[2]
    X, Y, Z = y0 + tau[0], y1 + tau[1], max(y2 + tau[2], 0.05)
    u, v, f = X / Z, Y / Z, focal / Z
    r[0], r[1] = focal * (u - x[0]), focal * (v - x[1])
    # d(pixel) / d(point in camera axes) = f (1, 0, -u; 0, 1, -v); turning by w moves y by w x y.
    J[0, 0], J[0, 1], J[0, 2] = -f * u * y1, f * (y2 + u * y0), -f * y1
    J[1, 0], J[1, 1], J[1, 2] = -f * (y2 + v * y1), f * v * y0, f * y0
    J[0, 3], J[0, 4], J[0, 5] = f, 0.0, -f * u
    J[1, 3], J[1, 4], J[1, 5] = 0.0, f, -f * v
    for d in range(3):
        B[0, d] = f * (Q[0, d] - u * Q[2, d])
        B[1, d] = f * (Q[1, d] - v * Q[2, d])


@kernel
def robust_cost(
    turns: np.ndarray, shifts: np.ndarray, points: np.ndarray, first: np.ndarray, frame_of: np.ndarray, x: np.ndarray,
    known: np.ndarray, focal: float, width: float, ridge: float,
) -> float:  # fmt: skip
    """Cauchy cost of all observations, in square pixels, and of points far from the middle."""
    total = 0.0
    for n in range(len(points)):
        if not known[n]:
            continue
        S = points[n]
        total += ridge * (S[0] * S[0] + S[1] * S[1] + S[2] * S[2])
        for m in range(first[n], first[n + 1]):
            t = frame_of[m]
            if t < 0:
                continue
            Q, tau = turns[t], shifts[t]
            X = Q[0, 0] * S[0] + Q[0, 1] * S[1] + Q[0, 2] * S[2] + tau[0]
            Y = Q[1, 0] * S[0] + Q[1, 1] * S[1] + Q[1, 2] * S[2] + tau[1]
            Z = max(Q[2, 0] * S[0] + Q[2, 1] * S[1] + Q[2, 2] * S[2] + tau[2], 0.05)
            a, b = focal * (X / Z - x[m, 0]), focal * (Y / Z - x[m, 1])
            total += width**2 * np.log1p((a * a + b * b) / width**2)
    return total


@helper
def _ends_of_runs(first: np.ndarray, frame_of: np.ndarray) -> np.ndarray:
    """For each observation [M], the one after the last of its point that follow it in consecutive frames."""
    ends = np.arange(1, len(frame_of) + 1)
    for n in range(len(first) - 1):
        for m in range(first[n + 1] - 2, first[n] - 1, -1):
            if frame_of[m] >= 0 and frame_of[m + 1] == frame_of[m] + 1:
                ends[m] = ends[m + 1]
    return ends


@helper
def _subtract(row: np.ndarray, w: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> None:
    """Subtract w [3] times rows a, b and c from a row. Most of the time goes here: of long rows of numbers a compiler computes
    several at a time."""
    w0, w1, w2 = w[0], w[1], w[2]
    for q in range(len(row)):
        row[q] -= w0 * a[q] + w1 * b[q] + w2 * c[q]


@kernel
def reduce_system(
    turns: np.ndarray, shifts: np.ndarray, points: np.ndarray, first: np.ndarray, frame_of: np.ndarray, x: np.ndarray,
    known: np.ndarray, focal: float, width: float, ridge: float, damping: float, reach: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Normal equations of the poses with the points eliminated. ``reach``: as from ``widest_link``.

    Returns:
        H, of whose row i [6F, 6 (reach + 1)] holds the columns from i on, b [6F]; the diagonal [6F] of the poses' own block;
        and to get the points' steps: inverse [N, 3, 3] of each point's block, its right side [N, 3], and the blocks [3, 6M]
        between the point and the pose of an observation, six columns each.
    """
    F, N, M = len(turns), len(points), len(x)
    H, b, own = np.zeros((6 * F, 6 * (reach + 1))), np.zeros(6 * F), np.zeros(6 * F)
    inverses, gradients, links = np.zeros((N, 3, 3)), np.zeros((N, 3)), np.zeros((3, 6 * M))
    r, J, B = np.zeros(2), np.zeros((2, 6)), np.zeros((2, 3))
    V, WV = np.zeros((3, 3)), np.zeros((6, 3))
    for n in range(N):
        if not known[n]:
            continue
        V[:] = 0.0
        for d in range(3):
            V[d, d] = ridge
            gradients[n, d] = -ridge * points[n, d]
        for m in range(first[n], first[n + 1]):
            t = frame_of[m]
            if t < 0:
                continue
            derivatives(turns[t], shifts[t], points[n], x[m], focal, r, J, B)
            u = 1.0 / (1.0 + (r[0] * r[0] + r[1] * r[1]) / width**2)
            for i in range(6):
                b[6 * t + i] -= u * (J[0, i] * r[0] + J[1, i] * r[1])
                for j in range(i, 6):
                    H[6 * t + i, j - i] += u * (J[0, i] * J[0, j] + J[1, i] * J[1, j])
                for j in range(3):
                    links[j, 6 * m + i] = u * (J[0, i] * B[0, j] + J[1, i] * B[1, j])
            for i in range(3):
                gradients[n, i] -= u * (B[0, i] * r[0] + B[1, i] * r[1])
                for j in range(3):
                    V[i, j] += u * (B[0, i] * B[0, j] + B[1, i] * B[1, j])
        for d in range(3):
            V[d, d] *= 1 + damping
        inverses[n] = np.linalg.inv(V)
    for d in range(6 * F):
        own[d] = H[d, 0]
    ends, x_of, y_of, z_of = _ends_of_runs(first, frame_of), links[0], links[1], links[2]
    for n in range(N):
        if not known[n]:
            continue
        P = inverses[n]
        for m in range(first[n], first[n + 1]):
            t = frame_of[m]
            if t < 0:
                continue
            for i in range(6):
                l0, l1, l2 = links[0, 6 * m + i], links[1, 6 * m + i], links[2, 6 * m + i]
                for j in range(3):
                    WV[i, j] = l0 * P[0, j] + l1 * P[1, j] + l2 * P[2, j]
                b[6 * t + i] -= WV[i, 0] * gradients[n, 0] + WV[i, 1] * gradients[n, 1] + WV[i, 2] * gradients[n, 2]
            k = m
            while k < first[n + 1]:  # Frames rise, so this is the upper half.
                s = frame_of[k]
                if s >= 0:
                    for i in range(6):
                        row, shift = H[6 * t + i], 6 * (s - t) - i
                        begin = 6 * k + (i if k == m else 0)
                        end, to = 6 * ends[k], shift - 6 * k
                        _subtract(row[begin + to : end + to], WV[i], x_of[begin:end], y_of[begin:end], z_of[begin:end])
                k = ends[k]
    return H, b, own, inverses, gradients, links


@kernel
def unpack_band(H: np.ndarray) -> np.ndarray:
    """Return the whole symmetric matrix [n, n] of a band [n, w]."""
    n, band = H.shape
    whole = np.zeros((n, n))
    for i in range(n):
        for d in range(min(band, n - i)):
            whole[i, i + d] = whole[i + d, i] = H[i, d]
    return whole


@kernel
def widest_link(first: np.ndarray, frame_of: np.ndarray, known: np.ndarray) -> int:
    """Return how many frames apart poses are at most that one equation joins: those of a point, and the next but one."""
    most = 2
    for n in range(len(known)):
        low, high = -1, -1
        for m in range(first[n], first[n + 1]):
            t = frame_of[m]
            if known[n] and t >= 0:
                low, high = t if low < 0 else min(low, t), max(high, t)
        most = max(most, high - low)
    return most


@kernel
def move_points(
    points: np.ndarray, step: np.ndarray, first: np.ndarray, frame_of: np.ndarray, inverses: np.ndarray, gradients: np.ndarray,
    links: np.ndarray, known: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Return points [N, 3] after the step [6F] of the poses, by what ``reduce_system`` returned."""
    result, g = points.copy(), np.zeros(3)
    for n in range(len(points)):
        if not known[n]:
            continue
        g[:] = gradients[n]
        for m in range(first[n], first[n + 1]):
            t = frame_of[m]
            if t < 0:
                continue
            for j in range(3):
                for i in range(6):
                    g[j] -= links[j, 6 * m + i] * step[6 * t + i]
        result[n] += inverses[n] @ g
    return result


@kernel
def refine_pose(
    Q: np.ndarray, tau: np.ndarray, points: np.ndarray, x: np.ndarray, focal: float, width: float, iterations: int
) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Newton for one pose, held against turning far."""
    r, J, B = np.zeros(2), np.zeros((2, 6)), np.zeros((2, 3))
    for _ in range(iterations):
        H, b = 1e-6 * np.eye(6), np.zeros(6)
        for d in range(3):
            H[d, d] += 0.5 * len(points)
        for n in range(len(points)):
            derivatives(Q, tau, points[n], x[n], focal, r, J, B)
            u = 1.0 / (1.0 + (r[0] * r[0] + r[1] * r[1]) / width**2)
            for i in range(6):
                b[i] -= u * (J[0, i] * r[0] + J[1, i] * r[1])
                for j in range(6):
                    H[i, j] += u * (J[0, i] * J[0, j] + J[1, i] * J[1, j])
        step = np.linalg.solve(H, b)
        Q, tau = rotation(step[:3]) @ Q, tau + step[3:]
    return Q, tau
