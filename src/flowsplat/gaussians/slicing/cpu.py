"""Slicing and its gradient in one sweep over the Gaussians. Oracle: ``reference`` (series motion only)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numba import float32
from torch import Tensor
from torch.autograd.function import once_differentiable

from flowsplat.common.kernels import exp, helper, inline, kernel
from flowsplat.common.threads import parallel_for
from flowsplat.gaussians.gaussians4d import Active, Gaussians4D
from flowsplat.gaussians.motion import SeriesMotion
from flowsplat.gaussians.slicing.api import NAMES, Gradients, Slice
from flowsplat.splatting.cpu.harmonics import basis_of, color_of

ONE, ZERO, HALF = np.float32(1), np.float32(0), np.float32(0.5)
CHUNKS = 64
"""Ranges into which Gaussians are cut, whatever the number of threads."""


@helper
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


@helper
def _sum3(basis, poly, cos, sin, j):
    """The series of a mean, or of a derivative of it: all three numbers in one sweep over the terms."""
    x, y, z = ZERO, ZERO, ZERO
    orders, frequencies = poly.shape[1], cos.shape[1]
    for n in range(orders):
        b = basis[n]
        x += b * poly[j, n, 0]
        y += b * poly[j, n, 1]
        z += b * poly[j, n, 2]
    for k in range(frequencies):
        b, c = basis[orders + k], basis[orders + frequencies + k]
        x += b * cos[j, k, 0] + c * sin[j, k, 0]
        y += b * cos[j, k, 1] + c * sin[j, k, 1]
        z += b * cos[j, k, 2] + c * sin[j, k, 2]
    return x, y, z


@helper
def _sum4(basis, poly, cos, sin, j):
    """The same of a quaternion."""
    w, x, y, z = ZERO, ZERO, ZERO, ZERO
    orders, frequencies = poly.shape[1], cos.shape[1]
    for n in range(orders):
        b = basis[n]
        w += b * poly[j, n, 0]
        x += b * poly[j, n, 1]
        y += b * poly[j, n, 2]
        z += b * poly[j, n, 3]
    for k in range(frequencies):
        b, c = basis[orders + k], basis[orders + frequencies + k]
        w += b * cos[j, k, 0] + c * sin[j, k, 0]
        x += b * cos[j, k, 1] + c * sin[j, k, 1]
        y += b * cos[j, k, 2] + c * sin[j, k, 2]
        z += b * cos[j, k, 3] + c * sin[j, k, 3]
    return w, x, y, z


@helper
def _spread3(now, rate, later, g, v, w, poly, cos, sin, j):
    """Gradients of the coefficients of a mean, from those of its value now (g), its velocity (v) and its value later (w)."""
    orders, frequencies = poly.shape[1], cos.shape[1]
    for n in range(orders):
        a, b, c = now[n], rate[n], later[n]
        poly[j, n, 0] = a * g[0] + b * v[0] + c * w[0]
        poly[j, n, 1] = a * g[1] + b * v[1] + c * w[1]
        poly[j, n, 2] = a * g[2] + b * v[2] + c * w[2]
    for k in range(frequencies):
        m = orders + k
        a, b, c = now[m], rate[m], later[m]
        cos[j, k, 0] = a * g[0] + b * v[0] + c * w[0]
        cos[j, k, 1] = a * g[1] + b * v[1] + c * w[1]
        cos[j, k, 2] = a * g[2] + b * v[2] + c * w[2]
        m += frequencies
        a, b, c = now[m], rate[m], later[m]
        sin[j, k, 0] = a * g[0] + b * v[0] + c * w[0]
        sin[j, k, 1] = a * g[1] + b * v[1] + c * w[1]
        sin[j, k, 2] = a * g[2] + b * v[2] + c * w[2]


@helper
def _spread4(now, later, g, w, poly, cos, sin, j):
    """The same of a quaternion, whose velocity nothing depends on."""
    orders, frequencies = poly.shape[1], cos.shape[1]
    for n in range(orders):
        a, c = now[n], later[n]
        poly[j, n, 0] = a * g[0] + c * w[0]
        poly[j, n, 1] = a * g[1] + c * w[1]
        poly[j, n, 2] = a * g[2] + c * w[2]
        poly[j, n, 3] = a * g[3] + c * w[3]
    for k in range(frequencies):
        m = orders + k
        a, c = now[m], later[m]
        cos[j, k, 0] = a * g[0] + c * w[0]
        cos[j, k, 1] = a * g[1] + c * w[1]
        cos[j, k, 2] = a * g[2] + c * w[2]
        cos[j, k, 3] = a * g[3] + c * w[3]
        m += frequencies
        a, c = now[m], later[m]
        sin[j, k, 0] = a * g[0] + c * w[0]
        sin[j, k, 1] = a * g[1] + c * w[1]
        sin[j, k, 2] = a * g[2] + c * w[2]
        sin[j, k, 3] = a * g[3] + c * w[3]


@inline
def _gain(log_gains, cosines, i):
    even, odd = ZERO, ZERO  # Two sums, because each waits for its last addition.
    count = log_gains.shape[1]
    for k in range(0, count - 1, 2):
        even += log_gains[i, k] * cosines[k]
        odd += log_gains[i, k + 1] * cosines[k + 1]
    if count % 2 == 1:
        even += log_gains[i, count - 1] * cosines[count - 1]
    return exp(even + odd)


@kernel
def _forward(
    begin, end, rows, means, logits, sh, log_gains, quats, log_scales, times, log_lambdas, mean_poly, mean_cos, mean_sin, quat_poly,
    quat_cos, quat_sin, resting, t, next_t, has_next, base, center, cosines, harmonics,
    out_means, out_quats, out_scales, out_opacities, out_colors, out_velocities, next_means, next_quats,
):  # fmt: skip
    count = len(rows)
    mean_size, quat_size = mean_poly.shape[1] + 2 * mean_cos.shape[1], quat_poly.shape[1] + 2 * quat_cos.shape[1]
    for chunk in range(begin, end):
        # Arrays of their own: a view that is made for every Gaussian is counted, which costs more than what is read through it.
        now, rate, bend = np.empty(mean_size, np.float32), np.empty(mean_size, np.float32), np.empty(mean_size, np.float32)
        turn, turning, bending = np.empty(quat_size, np.float32), np.empty(quat_size, np.float32), np.empty(quat_size, np.float32)
        directions = np.empty(16, np.float32)
        for a in range(count * chunk // CHUNKS, count * (chunk + 1) // CHUNKS):
            i, m = rows[a], a - resting
            opacity, gain = ONE / (ONE + exp(-logits[i])), ONE
            for d in range(3):
                out_means[a, d] = means[i, d]
                out_scales[a, d] = exp(log_scales[i, d])
            for d in range(4):
                out_quats[a, d] = quats[i, d]
            if m >= 0:
                tau = t - times[i]
                opacity *= exp(-HALF * exp(log_lambdas[i]) * tau * tau)
                _basis(tau, mean_poly.shape[1], mean_cos.shape[1], base, now, rate, bend)
                x, y, z = _sum3(now, mean_poly, mean_cos, mean_sin, i)
                out_means[a, 0] += x
                out_means[a, 1] += y
                out_means[a, 2] += z
                out_velocities[m, 0], out_velocities[m, 1], out_velocities[m, 2] = _sum3(rate, mean_poly, mean_cos, mean_sin, i)
                _basis(tau, quat_poly.shape[1], quat_cos.shape[1], base, turn, turning, bending)
                w, x, y, z = _sum4(turn, quat_poly, quat_cos, quat_sin, i)
                out_quats[a, 0] += w
                out_quats[a, 1] += x
                out_quats[a, 2] += y
                out_quats[a, 3] += z
            elif log_gains.shape[1] > 0:
                gain = _gain(log_gains, cosines, i)
            if has_next:
                for d in range(3):
                    next_means[a, d] = means[i, d]
                for d in range(4):
                    next_quats[a, d] = quats[i, d]
                if m >= 0:
                    tau = next_t - times[i]
                    _basis(tau, mean_poly.shape[1], mean_cos.shape[1], base, now, rate, bend)
                    x, y, z = _sum3(now, mean_poly, mean_cos, mean_sin, i)
                    next_means[a, 0] += x
                    next_means[a, 1] += y
                    next_means[a, 2] += z
                    _basis(tau, quat_poly.shape[1], quat_cos.shape[1], base, turn, turning, bending)
                    w, x, y, z = _sum4(turn, quat_poly, quat_cos, quat_sin, i)
                    next_quats[a, 0] += w
                    next_quats[a, 1] += x
                    next_quats[a, 2] += y
                    next_quats[a, 3] += z
            out_opacities[a] = opacity
            x, y, z = out_means[a, 0] - center[0], out_means[a, 1] - center[1], out_means[a, 2] - center[2]
            basis_of(x, y, z, harmonics, directions)
            red, green, blue = color_of(directions, sh, i, harmonics)
            out_colors[a, 0] = max(red, ZERO) * gain
            out_colors[a, 1] = max(green, ZERO) * gain
            out_colors[a, 2] = max(blue, ZERO) * gain


@kernel
def _backward(
    begin, end, rows, means, logits, sh, log_gains, quats, log_scales, times, log_lambdas, mean_poly, mean_cos, mean_sin, quat_poly,
    quat_cos, quat_sin, resting, t, next_t, has_next, base, center, cosines, harmonics,
    out_means, grad_means, grad_quats, grad_scales, grad_opacities, grad_colors, grad_velocities, grad_next_means,
    grad_next_quats, d_means, d_logits, d_sh, d_gains, d_quats, d_scales, d_times, d_lambdas, d_mean_poly, d_mean_cos,
    d_mean_sin, d_quat_poly, d_quat_cos, d_quat_sin,
):  # fmt: skip
    """Every number of every d_... is written, so that they need not be cleared before."""
    count = len(rows)
    mean_size, quat_size = mean_poly.shape[1] + 2 * mean_cos.shape[1], quat_poly.shape[1] + 2 * quat_cos.shape[1]
    for chunk in range(begin, end):
        now, rate, bend = np.zeros(mean_size, np.float32), np.zeros(mean_size, np.float32), np.zeros(mean_size, np.float32)
        later, later_rate, later_bend = (
            np.zeros(mean_size, np.float32),
            np.zeros(mean_size, np.float32),
            np.zeros(mean_size, np.float32),
        )
        turn, turning, bending = np.zeros(quat_size, np.float32), np.zeros(quat_size, np.float32), np.zeros(quat_size, np.float32)
        turn_later, turning_later, later_bending = (
            np.zeros(quat_size, np.float32),
            np.zeros(quat_size, np.float32),
            np.zeros(quat_size, np.float32),
        )
        directions = np.empty(16, np.float32)
        for a in range(count * chunk // CHUNKS, count * (chunk + 1) // CHUNKS):
            i, m, gain = rows[a], a - resting, ONE
            sigmoid = ONE / (ONE + exp(-logits[i]))
            toward_opacity = grad_opacities[a]
            for d in range(3):
                d_means[a, d] = grad_means[a, d] + (grad_next_means[a, d] if has_next else ZERO)
                d_scales[a, d] = grad_scales[a, d] * exp(log_scales[i, d])
            for d in range(4):
                d_quats[a, d] = grad_quats[a, d] + (grad_next_quats[a, d] if has_next else ZERO)
            if m >= 0:
                tau, precision = t - times[i], exp(log_lambdas[i])
                present = exp(-HALF * precision * tau * tau)
                toward_presence = toward_opacity * sigmoid * present
                toward_opacity *= present
                d_lambdas[m] = -HALF * toward_presence * precision * tau * tau
                toward_time = toward_presence * precision * tau
                _basis(tau, mean_poly.shape[1], mean_cos.shape[1], base, now, rate, bend)
                _basis(tau, quat_poly.shape[1], quat_cos.shape[1], base, turn, turning, bending)
                if has_next:
                    tau = next_t - times[i]
                    _basis(tau, mean_poly.shape[1], mean_cos.shape[1], base, later, later_rate, later_bend)
                    _basis(tau, quat_poly.shape[1], quat_cos.shape[1], base, turn_later, turning_later, later_bending)
                g = grad_means[a, 0], grad_means[a, 1], grad_means[a, 2]
                v = grad_velocities[m, 0], grad_velocities[m, 1], grad_velocities[m, 2]
                turned = grad_quats[a, 0], grad_quats[a, 1], grad_quats[a, 2], grad_quats[a, 3]
                w, turned_later = (ZERO, ZERO, ZERO), (ZERO, ZERO, ZERO, ZERO)
                if has_next:
                    w = grad_next_means[a, 0], grad_next_means[a, 1], grad_next_means[a, 2]
                    turned_later = grad_next_quats[a, 0], grad_next_quats[a, 1], grad_next_quats[a, 2], grad_next_quats[a, 3]
                _spread3(now, rate, later, g, v, w, d_mean_poly, d_mean_cos, d_mean_sin, m)
                _spread4(turn, turn_later, turned, turned_later, d_quat_poly, d_quat_cos, d_quat_sin, m)
                x, y, z = _sum3(rate, mean_poly, mean_cos, mean_sin, i)
                toward_time -= grad_means[a, 0] * x + grad_means[a, 1] * y + grad_means[a, 2] * z
                x, y, z = _sum3(bend, mean_poly, mean_cos, mean_sin, i)
                toward_time -= grad_velocities[m, 0] * x + grad_velocities[m, 1] * y + grad_velocities[m, 2] * z
                q, x, y, z = _sum4(turning, quat_poly, quat_cos, quat_sin, i)
                toward_time -= grad_quats[a, 0] * q + grad_quats[a, 1] * x + grad_quats[a, 2] * y + grad_quats[a, 3] * z
                if has_next:
                    x, y, z = _sum3(later_rate, mean_poly, mean_cos, mean_sin, i)
                    toward_time -= grad_next_means[a, 0] * x + grad_next_means[a, 1] * y + grad_next_means[a, 2] * z
                    q, x, y, z = _sum4(turning_later, quat_poly, quat_cos, quat_sin, i)
                    toward_time -= grad_next_quats[a, 0] * q + grad_next_quats[a, 1] * x
                    toward_time -= grad_next_quats[a, 2] * y + grad_next_quats[a, 3] * z
                d_times[m] = toward_time
            elif log_gains.shape[1] > 0:
                gain = _gain(log_gains, cosines, i)
            d_logits[a] = toward_opacity * sigmoid * (ONE - sigmoid)
            x, y, z = out_means[a, 0] - center[0], out_means[a, 1] - center[1], out_means[a, 2] - center[2]
            basis_of(x, y, z, harmonics, directions)
            red, green, blue = color_of(directions, sh, i, harmonics)
            toward_red = grad_colors[a, 0] * gain if red > ZERO else ZERO
            toward_green = grad_colors[a, 1] * gain if green > ZERO else ZERO
            toward_blue = grad_colors[a, 2] * gain if blue > ZERO else ZERO
            toward_gain = toward_red * red + toward_green * green + toward_blue * blue
            for k in range(harmonics):
                d_sh[a, k, 0] = directions[k] * toward_red
                d_sh[a, k, 1] = directions[k] * toward_green
                d_sh[a, k, 2] = directions[k] * toward_blue
            for k in range(harmonics, sh.shape[1]):
                d_sh[a, k, 0], d_sh[a, k, 1], d_sh[a, k, 2] = ZERO, ZERO, ZERO
            if m < 0:
                for k in range(log_gains.shape[1]):
                    d_gains[a, k] = toward_gain * cosines[k]


class _SliceFunction(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, _: Tensor, gaussians: Gaussians4D, active: Active, settings: tuple[Any, ...], gradients: Gradients | None
    ) -> tuple[Tensor, ...]:
        params = [gaussians.params[name] for name in NAMES]
        inputs = [tensor.numpy() for tensor in (active.rows, *params)]
        count = len(active.rows)
        moving, later = count - active.num_static, count if settings[3] else 0
        shapes = ((count, 3), (count, 4), (count, 3), (count,), (count, 3), (moving, 3), (later, 3), (later, 4))
        outputs = tuple(torch.empty(shape) for shape in shapes)
        parallel_for(_forward, CHUNKS, *inputs, *settings, *(output.numpy() for output in outputs))
        # Parameters are no inputs (see below), and yet saved: torch then refuses a gradient of others than were sliced.
        ctx.save_for_backward(active.rows, *params, outputs[0])
        ctx.settings, ctx.shapes = settings, shapes
        ctx.gaussians, ctx.active, ctx.gradients = gaussians, active, gradients
        ctx.set_materialize_grads(False)
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *incoming: Tensor | None) -> tuple[None, ...]:
        *inputs, means = (tensor.detach().numpy() for tensor in ctx.saved_tensors)
        arriving = [
            (torch.zeros(shape) if gradient is None else gradient.contiguous()).numpy()
            for gradient, shape in zip(incoming, ctx.shapes, strict=True)
        ]
        counts = {name: len(ctx.gaussians.rows_of(name, ctx.active)) for name in NAMES}
        results = {name: torch.empty(counts[name], *ctx.gaussians.params[name].shape[1:]) for name in NAMES}
        parallel_for(_backward, CHUNKS, *inputs, *ctx.settings, means, *arriving, *(result.numpy() for result in results.values()))
        ctx.gradients.update(results)
        return None, None, None, None, None


def slice_gaussians(
    gaussians: Gaussians4D, active: Active, camera_center: Tensor, next_time: float | None, gradients: Gradients | None
) -> Slice:
    """See ``api.slice_gaussians``."""
    motion = gaussians.motion
    assert isinstance(motion, SeriesMotion)
    cosines = np.cos(np.pi * active.t * np.arange(1, gaussians.config.gains + 1)).astype(np.float32)
    settings = (
        active.num_static, np.float32(active.t), np.float32(next_time or 0.0), next_time is not None,
        np.float32(motion.fourier_base), camera_center.numpy(), cosines, (gaussians.sh_degree + 1) ** 2,
    )  # fmt: skip
    # The parameters are not inputs of the function, because their gradients would have their full size: it has one in name.
    anchor = torch.zeros((), requires_grad=gradients is not None)
    outputs = _SliceFunction.apply(anchor, gaussians, active, settings, gradients)
    means, quats, scales, opacities, colors, velocities, next_means, next_quats = outputs
    if next_time is None:
        next_means = next_quats = None
    return Slice(means, quats, scales, None, opacities, colors, velocities, next_means, next_quats)
