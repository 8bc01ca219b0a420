"""Slicing and its gradient in one sweep over the Gaussians. Oracle: ``reference`` (series motion only)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numba import float32, njit, prange
from torch import Tensor

from flowsplat.gaussians.gaussians4d import Active, ModelConfig
from flowsplat.gaussians.motion import SeriesMotion
from flowsplat.gaussians.slicing.api import Slice
from flowsplat.splatting.harmonics import C0, C1, C2, C3

OPTIONS = {"fastmath": {"reassoc", "contract", "arcp", "nsz", "afn"}, "cache": True, "error_model": "numpy"}
ONE, ZERO, HALF, TWO = np.float32(1), np.float32(0), np.float32(0.5), np.float32(2)
CHUNKS = 64
S0, S1 = np.float32(C0), np.float32(C1)
S2, S3 = np.array(C2, np.float32), np.array(C3, np.float32)

NAMES = (
    "means", "logit_opacities", "sh", "log_gains", "quats", "log_scales", "times", "log_lambdas",
    "mean_poly", "mean_cos", "mean_sin", "quat_poly", "quat_cos", "quat_sin",
)  # fmt: skip


@njit(**OPTIONS)
def _basis(tau, poly, fourier, base, values, rates, accelerations):
    """tau^n, cos(w l tau) - 1 and sin(w l tau), with their first and second derivatives."""
    power, before, twice = tau, ONE, ZERO  # tau^n, tau^(n-1), tau^(n-2)
    for n in range(poly):
        order = float32(n + 1)
        values[n] = power
        rates[n] = order * before
        accelerations[n] = order * (order - ONE) * twice
        twice = before
        before = power
        power *= tau
    for k in range(fourier):
        rate = base * float32(k + 1)
        cos, sin = math.cos(rate * tau), math.sin(rate * tau)
        c, s = poly + k, poly + fourier + k
        values[c], values[s] = cos - ONE, sin
        rates[c], rates[s] = -rate * sin, rate * cos
        accelerations[c], accelerations[s] = -rate * rate * cos, -rate * rate * sin


@njit(inline="always", **OPTIONS)
def _combine(basis, poly, cos, sin, j, d):
    total = ZERO
    orders, frequencies = poly.shape[1], cos.shape[1]
    for n in range(orders):
        total += basis[n] * poly[j, n, d]
    for k in range(frequencies):
        total += basis[orders + k] * cos[j, k, d] + basis[orders + frequencies + k] * sin[j, k, d]
    return total


@njit(inline="always", **OPTIONS)
def _spread(basis, gradient, poly, cos, sin, j, d):
    """Add basis times gradient to the coefficients' gradients."""
    orders, frequencies = poly.shape[1], cos.shape[1]
    for n in range(orders):
        poly[j, n, d] += basis[n] * gradient
    for k in range(frequencies):
        cos[j, k, d] += basis[orders + k] * gradient
        sin[j, k, d] += basis[orders + frequencies + k] * gradient


@njit(**OPTIONS)
def _harmonics(x, y, z, count, basis):
    length = math.sqrt(x * x + y * y + z * z)
    inverse = ONE / max(length, float32(1e-12))
    x *= inverse
    y *= inverse
    z *= inverse
    basis[0] = S0
    if count > 1:
        basis[1], basis[2], basis[3] = -S1 * y, S1 * z, -S1 * x
    if count > 4:
        xx, yy, zz = x * x, y * y, z * z
        basis[4], basis[5], basis[6] = S2[0] * x * y, S2[1] * y * z, S2[2] * (TWO * zz - xx - yy)
        basis[7], basis[8] = S2[3] * x * z, S2[4] * (xx - yy)
        if count > 9:
            three, four = float32(3), float32(4)
            basis[9], basis[10] = S3[0] * y * (three * xx - yy), S3[1] * x * y * z
            basis[11] = S3[2] * y * (four * zz - xx - yy)
            basis[12] = S3[3] * z * (TWO * zz - three * xx - three * yy)
            basis[13] = S3[4] * x * (four * zz - xx - yy)
            basis[14], basis[15] = S3[5] * z * (xx - yy), S3[6] * x * (xx - three * yy)


@njit(inline="always", **OPTIONS)
def _gain(log_gains, cosines, i):
    exponent = ZERO
    for k in range(log_gains.shape[1]):
        exponent += log_gains[i, k] * cosines[k]
    return math.exp(exponent)


@njit(parallel=True, **OPTIONS)
def _forward(
    means, logits, sh, log_gains, quats, log_scales, times, log_lambdas, mean_poly, mean_cos, mean_sin, quat_poly, quat_cos,
    quat_sin, resting, t, next_t, has_next, base, center, cosines, harmonics,
    out_means, out_quats, out_scales, out_opacities, out_colours, out_velocities, next_means, next_quats,
):  # fmt: skip
    count = len(means)
    mean_size, quat_size = mean_poly.shape[1] + 2 * mean_cos.shape[1], quat_poly.shape[1] + 2 * quat_cos.shape[1]
    for chunk in prange(CHUNKS):
        basis = np.empty((3, mean_size), np.float32)
        quat_basis = np.empty((3, quat_size), np.float32)
        directions = np.empty(16, np.float32)
        for i in range(count * chunk // CHUNKS, count * (chunk + 1) // CHUNKS):
            opacity, gain, j = ONE / (ONE + math.exp(-logits[i])), ONE, i - resting
            for d in range(3):
                out_means[i, d] = means[i, d]
                out_scales[i, d] = math.exp(log_scales[i, d])
            for d in range(4):
                out_quats[i, d] = quats[i, d]
            if j >= 0:
                tau = t - times[j]
                opacity *= math.exp(-HALF * math.exp(log_lambdas[j]) * tau * tau)
                _basis(tau, mean_poly.shape[1], mean_cos.shape[1], base, basis[0], basis[1], basis[2])
                for d in range(3):
                    out_means[i, d] += _combine(basis[0], mean_poly, mean_cos, mean_sin, j, d)
                    out_velocities[j, d] = _combine(basis[1], mean_poly, mean_cos, mean_sin, j, d)
                _basis(tau, quat_poly.shape[1], quat_cos.shape[1], base, quat_basis[0], quat_basis[1], quat_basis[2])
                for d in range(4):
                    out_quats[i, d] += _combine(quat_basis[0], quat_poly, quat_cos, quat_sin, j, d)
            elif log_gains.shape[1] > 0:
                gain = _gain(log_gains, cosines, i)
            if has_next:
                for d in range(3):
                    next_means[i, d] = means[i, d]
                for d in range(4):
                    next_quats[i, d] = quats[i, d]
                if j >= 0:
                    tau = next_t - times[j]
                    _basis(tau, mean_poly.shape[1], mean_cos.shape[1], base, basis[0], basis[1], basis[2])
                    for d in range(3):
                        next_means[i, d] += _combine(basis[0], mean_poly, mean_cos, mean_sin, j, d)
                    _basis(tau, quat_poly.shape[1], quat_cos.shape[1], base, quat_basis[0], quat_basis[1], quat_basis[2])
                    for d in range(4):
                        next_quats[i, d] += _combine(quat_basis[0], quat_poly, quat_cos, quat_sin, j, d)
            out_opacities[i] = opacity
            x, y, z = out_means[i, 0] - center[0], out_means[i, 1] - center[1], out_means[i, 2] - center[2]
            _harmonics(x, y, z, harmonics, directions)
            for d in range(3):
                colour = HALF
                for k in range(harmonics):
                    colour += directions[k] * sh[i, k, d]
                out_colours[i, d] = max(colour, ZERO) * gain


@njit(parallel=True, **OPTIONS)
def _backward(
    means, logits, sh, log_gains, quats, log_scales, times, log_lambdas, mean_poly, mean_cos, mean_sin, quat_poly, quat_cos,
    quat_sin, resting, t, next_t, has_next, base, center, cosines, harmonics,
    out_means, grad_means, grad_quats, grad_scales, grad_opacities, grad_colours, grad_velocities, grad_next_means,
    grad_next_quats, d_means, d_logits, d_sh, d_gains, d_quats, d_scales, d_times, d_lambdas, d_mean_poly, d_mean_cos,
    d_mean_sin, d_quat_poly, d_quat_cos, d_quat_sin,
):  # fmt: skip
    count = len(means)
    mean_size, quat_size = mean_poly.shape[1] + 2 * mean_cos.shape[1], quat_poly.shape[1] + 2 * quat_cos.shape[1]
    for chunk in prange(CHUNKS):
        basis = np.empty((3, mean_size), np.float32)
        quat_basis = np.empty((3, quat_size), np.float32)
        directions = np.empty(16, np.float32)
        for i in range(count * chunk // CHUNKS, count * (chunk + 1) // CHUNKS):
            j, gain = i - resting, ONE
            sigmoid = ONE / (ONE + math.exp(-logits[i]))
            toward_opacity = grad_opacities[i]
            for d in range(3):
                d_means[i, d] = grad_means[i, d]
                d_scales[i, d] = grad_scales[i, d] * math.exp(log_scales[i, d])
                if has_next:
                    d_means[i, d] += grad_next_means[i, d]
            for d in range(4):
                d_quats[i, d] = grad_quats[i, d]
                if has_next:
                    d_quats[i, d] += grad_next_quats[i, d]
            if j >= 0:
                tau, precision, later = t - times[j], math.exp(log_lambdas[j]), ZERO
                present = math.exp(-HALF * precision * tau * tau)
                toward_presence = toward_opacity * sigmoid * present
                toward_opacity *= present
                d_lambdas[j] = -HALF * toward_presence * precision * tau * tau
                later += toward_presence * precision * tau
                _basis(tau, mean_poly.shape[1], mean_cos.shape[1], base, basis[0], basis[1], basis[2])
                for d in range(3):
                    g, v = grad_means[i, d], grad_velocities[j, d]
                    _spread(basis[0], g, d_mean_poly, d_mean_cos, d_mean_sin, j, d)
                    _spread(basis[1], v, d_mean_poly, d_mean_cos, d_mean_sin, j, d)
                    later -= g * _combine(basis[1], mean_poly, mean_cos, mean_sin, j, d)
                    later -= v * _combine(basis[2], mean_poly, mean_cos, mean_sin, j, d)
                _basis(tau, quat_poly.shape[1], quat_cos.shape[1], base, quat_basis[0], quat_basis[1], quat_basis[2])
                for d in range(4):
                    _spread(quat_basis[0], grad_quats[i, d], d_quat_poly, d_quat_cos, d_quat_sin, j, d)
                    later -= grad_quats[i, d] * _combine(quat_basis[1], quat_poly, quat_cos, quat_sin, j, d)
                if has_next:
                    tau = next_t - times[j]
                    _basis(tau, mean_poly.shape[1], mean_cos.shape[1], base, basis[0], basis[1], basis[2])
                    for d in range(3):
                        _spread(basis[0], grad_next_means[i, d], d_mean_poly, d_mean_cos, d_mean_sin, j, d)
                        later -= grad_next_means[i, d] * _combine(basis[1], mean_poly, mean_cos, mean_sin, j, d)
                    _basis(tau, quat_poly.shape[1], quat_cos.shape[1], base, quat_basis[0], quat_basis[1], quat_basis[2])
                    for d in range(4):
                        _spread(quat_basis[0], grad_next_quats[i, d], d_quat_poly, d_quat_cos, d_quat_sin, j, d)
                        later -= grad_next_quats[i, d] * _combine(quat_basis[1], quat_poly, quat_cos, quat_sin, j, d)
                d_times[j] = later
            elif log_gains.shape[1] > 0:
                gain = _gain(log_gains, cosines, i)
            d_logits[i] = toward_opacity * sigmoid * (ONE - sigmoid)
            x, y, z = out_means[i, 0] - center[0], out_means[i, 1] - center[1], out_means[i, 2] - center[2]
            _harmonics(x, y, z, harmonics, directions)
            toward_gain = ZERO
            for d in range(3):
                colour = HALF
                for k in range(harmonics):
                    colour += directions[k] * sh[i, k, d]
                toward_colour = grad_colours[i, d] * gain if colour > ZERO else ZERO
                toward_gain += toward_colour * colour
                for k in range(harmonics):
                    d_sh[i, k, d] = directions[k] * toward_colour
            if j < 0:
                for k in range(log_gains.shape[1]):
                    d_gains[i, k] = toward_gain * cosines[k]


class _SliceFunction(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, settings: tuple[Any, ...], *tensors: Tensor) -> tuple[Tensor, ...]:
        arrays = [tensor.detach().contiguous().numpy() for tensor in tensors]
        count, moving = len(tensors[0]), len(tensors[6])
        later = count if settings[3] else 0
        shapes = ((count, 3), (count, 4), (count, 3), (count,), (count, 3), (moving, 3), (later, 3), (later, 4))
        outputs = tuple(torch.empty(shape) for shape in shapes)
        _forward(*arrays, *settings, *(output.numpy() for output in outputs))
        ctx.arrays, ctx.settings, ctx.shapes, ctx.means = arrays, settings, shapes, outputs[0].detach().numpy()
        ctx.set_materialize_grads(False)
        return outputs

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        incoming = [
            (torch.zeros(shape) if gradient is None else gradient.contiguous()).numpy()
            for gradient, shape in zip(gradients, ctx.shapes, strict=True)
        ]
        results = [torch.zeros(array.shape) for array in ctx.arrays]
        _backward(*ctx.arrays, *ctx.settings, ctx.means, *incoming, *(result.numpy() for result in results))
        return None, *results


def slice_gaussians(
    leaves: Mapping[str, Tensor],
    active: Active,
    config: ModelConfig,
    sh_degree: int,
    camera_center: Tensor,
    next_time: float | None,
) -> Slice:
    """See ``api.slice_gaussians``."""
    motion = config.motion()
    assert isinstance(motion, SeriesMotion)
    cosines = np.cos(np.pi * active.t * np.arange(1, config.gains + 1)).astype(np.float32)
    settings = (
        active.num_static, np.float32(active.t), np.float32(next_time or 0.0), next_time is not None,
        np.float32(motion.fourier_base), camera_center.numpy(), cosines, (sh_degree + 1) ** 2,
    )  # fmt: skip
    means, quats, scales, opacities, colours, velocities, next_means, next_quats = _SliceFunction.apply(
        settings, *(leaves[name] for name in NAMES)
    )
    if next_time is None:
        return Slice(means, quats, scales, None, opacities, colours, velocities, None, None)
    return Slice(means, quats, scales, None, opacities, colours, velocities, next_means, next_quats)
