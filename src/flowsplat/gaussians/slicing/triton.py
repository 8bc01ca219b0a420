"""Slicing and its gradient as two Triton kernels, a lane a Gaussian. Oracle: ``reference`` (series motion only).

Rows are read where they lie. Blocks in which everything rests skip the series. A row of -1 is padding: it is written as a Gaussian
of opacity 0 and its gradient is 0, so that buffers of a fixed size can be filled in part.
"""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from flowsplat.common.devices import upload
from flowsplat.common.triton import device_of
from flowsplat.gaussians.camera_buffer import CENTER, COSINES, NEXT_TIME, TIME, pack_moment
from flowsplat.gaussians.gaussians4d import Active, Gaussians4D
from flowsplat.gaussians.motion import SeriesMotion
from flowsplat.gaussians.slicing.api import NAMES, Gradients, Slice
from flowsplat.splatting.rules import C0, C1, C2, C3

BLOCK = 128
"""Gaussians of one program. A power of two, as Triton asks."""

S0, S1 = tl.constexpr(C0), tl.constexpr(C1)
S20, S21, S22, S23, S24 = (tl.constexpr(c) for c in C2)
S30, S31, S32, S33, S34, S35, S36 = (tl.constexpr(c) for c in C3)


@triton.jit
def _harmonic(k: tl.constexpr, x, y, z):
    """Basis function number k of a unit direction."""
    xx, yy, zz = x * x, y * y, z * z
    if k == 0:
        value = tl.zeros_like(x) + S0
    elif k == 1:
        value = -S1 * y
    elif k == 2:
        value = S1 * z
    elif k == 3:
        value = -S1 * x
    elif k == 4:
        value = S20 * x * y
    elif k == 5:
        value = S21 * y * z
    elif k == 6:
        value = S22 * (2.0 * zz - xx - yy)
    elif k == 7:
        value = S23 * x * z
    elif k == 8:
        value = S24 * (xx - yy)
    elif k == 9:
        value = S30 * y * (3.0 * xx - yy)
    elif k == 10:
        value = S31 * x * y * z
    elif k == 11:
        value = S32 * y * (4.0 * zz - xx - yy)
    elif k == 12:
        value = S33 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy)
    elif k == 13:
        value = S34 * x * (4.0 * zz - xx - yy)
    elif k == 14:
        value = S35 * z * (xx - yy)
    else:
        value = S36 * x * (xx - 3.0 * yy)
    return value


@triton.jit
def _direction(x, y, z, moment):
    """Unit vector from the camera's center."""
    x, y, z = x - tl.load(moment + CENTER), y - tl.load(moment + CENTER + 1), z - tl.load(moment + CENTER + 2)
    inverse = 1.0 / tl.maximum(tl.sqrt(x * x + y * y + z * z), 1e-12)
    return x * inverse, y * inverse, z * inverse


@triton.jit
def _color(sh, i, mask, x, y, z, harmonics, STORED: tl.constexpr):
    """Red, green and blue in a direction by the first harmonics, before negative ones become 0.

    How many they are grows in training: it is no constant, so that the kernel is compiled once.
    """
    red, green, blue = tl.zeros_like(x) + 0.5, tl.zeros_like(x) + 0.5, tl.zeros_like(x) + 0.5
    for k in tl.static_range(STORED):
        basis = _harmonic(k, x, y, z)
        at, used = sh + (i * STORED + k) * 3, mask & (k < harmonics)
        red += basis * tl.load(at, mask=used, other=0.0)
        green += basis * tl.load(at + 1, mask=used, other=0.0)
        blue += basis * tl.load(at + 2, mask=used, other=0.0)
    return red, green, blue


@triton.jit
def _gain(log_gains, i, mask, moment, GAINS: tl.constexpr):
    """Brightness in time, 1 where masked."""
    total = tl.zeros_like(mask.to(tl.float32))
    for k in range(GAINS):
        total += tl.load(log_gains + i * GAINS + k, mask=mask, other=0.0) * tl.load(moment + COSINES + k)
    return tl.exp(total)


@triton.jit
def _wave(tau, base, FOURIER: tl.constexpr):
    """Cosine and sine of the first frequency, of which the others follow; 1 and 0 where there is none."""
    if FOURIER > 0:
        c, s = tl.cos(base * tau), tl.sin(base * tau)
    else:
        c, s = tl.zeros_like(tau) + 1.0, tl.zeros_like(tau)
    return c, s


@triton.jit
def _series(
    poly, cos, sin, i, mask, d: tl.constexpr, tau, first_c, first_s, base, POLY: tl.constexpr, FOURIER: tl.constexpr,
    DIM: tl.constexpr,
):  # fmt: skip
    """Coordinate d of a series, with its first and second derivative with respect to tau. first_c, first_s: ``_wave``."""
    value, rate, acceleration = tl.zeros_like(tau), tl.zeros_like(tau), tl.zeros_like(tau)
    power, before, twice = tau, tl.zeros_like(tau) + 1.0, tl.zeros_like(tau)  # tau^n, tau^(n-1), tau^(n-2)
    for n in range(POLY):
        coefficient = tl.load(poly + (i * POLY + n) * DIM + d, mask=mask, other=0.0)
        value += coefficient * power
        rate += coefficient * (before * (n + 1))
        acceleration += coefficient * (twice * ((n + 1) * n))
        twice = before
        before = power
        power = power * tau
    c, s = first_c, first_s
    for k in range(FOURIER):
        speed = base * (k + 1)
        of_cos = tl.load(cos + (i * FOURIER + k) * DIM + d, mask=mask, other=0.0)
        of_sin = tl.load(sin + (i * FOURIER + k) * DIM + d, mask=mask, other=0.0)
        value += of_cos * (c - 1.0) + of_sin * s
        rate += speed * (of_sin * c - of_cos * s)
        acceleration -= speed * speed * (of_cos * c + of_sin * s)
        c, s = c * first_c - s * first_s, s * first_c + c * first_s
    return value, rate, acceleration


@triton.jit
def _spread(
    d_poly, d_cos, d_sin, m, mask, d: tl.constexpr, tau, later, first_c, first_s, later_c, later_s, base, g, v, w,
    POLY: tl.constexpr, FOURIER: tl.constexpr, DIM: tl.constexpr,
):  # fmt: skip
    """The coefficients' gradients, from those of the value now (g), of its velocity (v) and of the value later (w)."""
    power, before, power_later = tau, tl.zeros_like(tau) + 1.0, later
    for n in range(POLY):
        gradient = power * g + before * (n + 1) * v + power_later * w
        tl.store(d_poly + (m * POLY + n) * DIM + d, gradient, mask=mask)
        before = power
        power = power * tau
        power_later = power_later * later
    c, s, c_later, s_later = first_c, first_s, later_c, later_s
    for k in range(FOURIER):
        speed = base * (k + 1)
        at = (m * FOURIER + k) * DIM + d
        tl.store(d_cos + at, (c - 1.0) * g - speed * s * v + (c_later - 1.0) * w, mask=mask)
        tl.store(d_sin + at, s * g + speed * c * v + s_later * w, mask=mask)
        c, s = c * first_c - s * first_s, s * first_c + c * first_s
        c_later, s_later = c_later * later_c - s_later * later_s, s_later * later_c + c_later * later_s


@triton.jit(do_not_specialize=["count", "resting", "harmonics"], do_not_specialize_on_alignment=["out_velocities"])
def _forward(
    rows, moment, means, logits, sh, log_gains, quats, log_scales, times, log_lambdas, mean_poly, mean_cos, mean_sin, quat_poly,
    quat_cos, quat_sin, out_means, out_quats, out_scales, out_opacities, out_colors, out_velocities, next_means, next_quats,
    count, resting, harmonics, base,
    HAS_NEXT: tl.constexpr, MEAN_POLY: tl.constexpr, MEAN_FOURIER: tl.constexpr, QUAT_POLY: tl.constexpr,
    QUAT_FOURIER: tl.constexpr, GAINS: tl.constexpr, STORED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    block = tl.program_id(0)
    a = block * BLOCK + tl.arange(0, BLOCK)
    inside = a < count
    i = tl.load(rows + a, mask=inside, other=-1)
    there = i >= 0
    i = tl.maximum(i, 0)
    moving = there & (a >= resting)
    m = a - resting
    moves = inside & (a >= resting)
    opacity = tl.where(there, 1.0 / (1.0 + tl.exp(-tl.load(logits + i, mask=there, other=0.0))), 0.0)
    tau = tl.load(moment + TIME) - tl.load(times + i, mask=moving, other=0.0)
    later = tl.load(moment + NEXT_TIME) - tl.load(times + i, mask=moving, other=0.0)
    some_move = (block + 1) * BLOCK > resting
    if some_move:
        precision = tl.exp(tl.load(log_lambdas + i, mask=moving, other=0.0))
        opacity *= tl.where(moving, tl.exp(-0.5 * precision * tau * tau), 1.0)
    c, s = _wave(tau, base, MEAN_FOURIER + QUAT_FOURIER)
    c_later, s_later = _wave(later, base, MEAN_FOURIER + QUAT_FOURIER)
    x, y, z = tl.zeros_like(tau), tl.zeros_like(tau), tl.zeros_like(tau)
    for d in tl.static_range(3):
        mean = tl.load(means + i * 3 + d, mask=there, other=0.0)
        mean_later = mean
        if some_move:
            value, rate, _ = _series(mean_poly, mean_cos, mean_sin, i, moving, d, tau, c, s, base, MEAN_POLY, MEAN_FOURIER, 3)
            tl.store(out_velocities + m * 3 + d, rate, mask=moves)
            if HAS_NEXT:
                moved, _, _ = _series(
                    mean_poly, mean_cos, mean_sin, i, moving, d, later, c_later, s_later, base, MEAN_POLY, MEAN_FOURIER, 3
                )
                mean_later += moved
            mean += value
        tl.store(out_means + a * 3 + d, mean, mask=inside)
        if HAS_NEXT:
            tl.store(next_means + a * 3 + d, mean_later, mask=inside)
        scale = tl.exp(tl.load(log_scales + i * 3 + d, mask=there, other=0.0))
        tl.store(out_scales + a * 3 + d, scale, mask=inside)
        if d == 0:
            x = mean
        elif d == 1:
            y = mean
        else:
            z = mean
    for d in tl.static_range(4):
        quat = tl.load(quats + i * 4 + d, mask=there, other=1.0)
        quat_later = quat
        if some_move:
            value, _, _ = _series(quat_poly, quat_cos, quat_sin, i, moving, d, tau, c, s, base, QUAT_POLY, QUAT_FOURIER, 4)
            if HAS_NEXT:
                moved, _, _ = _series(
                    quat_poly, quat_cos, quat_sin, i, moving, d, later, c_later, s_later, base, QUAT_POLY, QUAT_FOURIER, 4
                )
                quat_later += moved
            quat += value
        tl.store(out_quats + a * 4 + d, quat, mask=inside)
        if HAS_NEXT:
            tl.store(next_quats + a * 4 + d, quat_later, mask=inside)
    tl.store(out_opacities + a, opacity, mask=inside)
    x, y, z = _direction(x, y, z, moment)
    red, green, blue = _color(sh, i, there, x, y, z, harmonics, STORED)
    gain = _gain(log_gains, i, there & (a < resting), moment, GAINS)
    tl.store(out_colors + a * 3, tl.maximum(red, 0.0) * gain, mask=inside)
    tl.store(out_colors + a * 3 + 1, tl.maximum(green, 0.0) * gain, mask=inside)
    tl.store(out_colors + a * 3 + 2, tl.maximum(blue, 0.0) * gain, mask=inside)


@triton.jit(do_not_specialize=["count", "resting", "harmonics"])
def _backward(
    rows, moment, means, logits, sh, log_gains, quats, log_scales, times, log_lambdas, mean_poly, mean_cos, mean_sin, quat_poly,
    quat_cos, quat_sin, out_means, grad_means, grad_quats, grad_scales, grad_opacities, grad_colors, grad_velocities,
    grad_next_means, grad_next_quats, d_means, d_logits, d_sh, d_gains, d_quats, d_scales, d_times, d_lambdas, d_mean_poly,
    d_mean_cos, d_mean_sin, d_quat_poly, d_quat_cos, d_quat_sin,
    count, resting, harmonics, base,
    HAS_NEXT: tl.constexpr, MEAN_POLY: tl.constexpr, MEAN_FOURIER: tl.constexpr, QUAT_POLY: tl.constexpr,
    QUAT_FOURIER: tl.constexpr, GAINS: tl.constexpr, STORED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Every number of every d_... is written, so that they need not be cleared before; that of padding is 0, whatever arrives."""
    block = tl.program_id(0)
    a = block * BLOCK + tl.arange(0, BLOCK)
    inside = a < count
    i = tl.load(rows + a, mask=inside, other=-1)
    there = i >= 0
    i = tl.maximum(i, 0)
    moving, still = there & (a >= resting), there & (a < resting)
    m = a - resting
    moves, stays = inside & (a >= resting), inside & (a < resting)
    sigmoid = 1.0 / (1.0 + tl.exp(-tl.load(logits + i, mask=there, other=0.0)))
    toward_opacity = tl.load(grad_opacities + a, mask=there, other=0.0)
    some_move = (block + 1) * BLOCK > resting
    tau = tl.load(moment + TIME) - tl.load(times + i, mask=moving, other=0.0)
    later = tl.load(moment + NEXT_TIME) - tl.load(times + i, mask=moving, other=0.0)
    toward_time = tl.zeros_like(tau)
    c, s = _wave(tau, base, MEAN_FOURIER + QUAT_FOURIER)
    c_later, s_later = _wave(later, base, MEAN_FOURIER + QUAT_FOURIER)
    if some_move:
        precision = tl.exp(tl.load(log_lambdas + i, mask=moving, other=0.0))
        presence = tl.where(moving, tl.exp(-0.5 * precision * tau * tau), 1.0)
        toward_presence = toward_opacity * sigmoid * presence
        toward_opacity *= presence
        tl.store(d_lambdas + m, -0.5 * toward_presence * precision * tau * tau, mask=moves)
        toward_time += toward_presence * precision * tau
    tl.store(d_logits + a, toward_opacity * sigmoid * (1.0 - sigmoid), mask=inside)
    for d in tl.static_range(3):
        g = tl.load(grad_means + a * 3 + d, mask=there, other=0.0)
        w = tl.zeros_like(g)
        if HAS_NEXT:
            w = tl.load(grad_next_means + a * 3 + d, mask=there, other=0.0)
        tl.store(d_means + a * 3 + d, g + w, mask=inside)
        scale = tl.exp(tl.load(log_scales + i * 3 + d, mask=there, other=0.0))
        tl.store(d_scales + a * 3 + d, tl.load(grad_scales + a * 3 + d, mask=there, other=0.0) * scale, mask=inside)
        if some_move:
            v = tl.load(grad_velocities + m * 3 + d, mask=moving, other=0.0)
            _, rate, acceleration = _series(
                mean_poly, mean_cos, mean_sin, i, moving, d, tau, c, s, base, MEAN_POLY, MEAN_FOURIER, 3
            )
            toward_time -= g * rate + v * acceleration
            if HAS_NEXT:
                _, rate, _ = _series(
                    mean_poly, mean_cos, mean_sin, i, moving, d, later, c_later, s_later, base, MEAN_POLY, MEAN_FOURIER, 3
                )
                toward_time -= w * rate
            _spread(
                d_mean_poly, d_mean_cos, d_mean_sin, m, moves, d, tau, later, c, s, c_later, s_later, base, g, v, w, MEAN_POLY,
                MEAN_FOURIER, 3,
            )  # fmt: skip
    for d in tl.static_range(4):
        g = tl.load(grad_quats + a * 4 + d, mask=there, other=0.0)
        w = tl.zeros_like(g)
        if HAS_NEXT:
            w = tl.load(grad_next_quats + a * 4 + d, mask=there, other=0.0)
        tl.store(d_quats + a * 4 + d, g + w, mask=inside)
        if some_move:
            _, rate, _ = _series(quat_poly, quat_cos, quat_sin, i, moving, d, tau, c, s, base, QUAT_POLY, QUAT_FOURIER, 4)
            toward_time -= g * rate
            if HAS_NEXT:
                _, rate, _ = _series(
                    quat_poly, quat_cos, quat_sin, i, moving, d, later, c_later, s_later, base, QUAT_POLY, QUAT_FOURIER, 4
                )
                toward_time -= w * rate
            _spread(
                d_quat_poly, d_quat_cos, d_quat_sin, m, moves, d, tau, later, c, s, c_later, s_later, base, g, tl.zeros_like(g),
                w, QUAT_POLY, QUAT_FOURIER, 4,
            )  # fmt: skip
    tl.store(d_times + m, toward_time, mask=moves)
    x = tl.load(out_means + a * 3, mask=there, other=0.0)
    y = tl.load(out_means + a * 3 + 1, mask=there, other=0.0)
    z = tl.load(out_means + a * 3 + 2, mask=there, other=0.0)
    x, y, z = _direction(x, y, z, moment)
    red, green, blue = _color(sh, i, there, x, y, z, harmonics, STORED)
    gain = _gain(log_gains, i, still, moment, GAINS)
    toward_red = tl.where(red > 0.0, tl.load(grad_colors + a * 3, mask=there, other=0.0) * gain, 0.0)
    toward_green = tl.where(green > 0.0, tl.load(grad_colors + a * 3 + 1, mask=there, other=0.0) * gain, 0.0)
    toward_blue = tl.where(blue > 0.0, tl.load(grad_colors + a * 3 + 2, mask=there, other=0.0) * gain, 0.0)
    for k in tl.static_range(STORED):
        at = d_sh + (a * STORED + k) * 3
        basis = tl.where(k < harmonics, _harmonic(k, x, y, z), 0.0)
        tl.store(at, basis * toward_red, mask=inside)
        tl.store(at + 1, basis * toward_green, mask=inside)
        tl.store(at + 2, basis * toward_blue, mask=inside)
    toward_gain = toward_red * red + toward_green * green + toward_blue * blue
    for k in range(GAINS):
        tl.store(d_gains + a * GAINS + k, toward_gain * tl.load(moment + COSINES + k), mask=stays)


def _constants(gaussians: Gaussians4D, has_next: bool) -> dict[str, Any]:
    motion = gaussians.motion
    assert isinstance(motion, SeriesMotion)
    params = gaussians.params
    return {
        "base": float(motion.fourier_base), "HAS_NEXT": has_next, "MEAN_POLY": params["mean_poly"].shape[1],
        "MEAN_FOURIER": params["mean_cos"].shape[1], "QUAT_POLY": params["quat_poly"].shape[1],
        "QUAT_FOURIER": params["quat_cos"].shape[1], "GAINS": gaussians.config.gains,
        "harmonics": (gaussians.sh_degree + 1) ** 2, "STORED": params["sh"].shape[1], "BLOCK": BLOCK,
    }  # fmt: skip


def slice_rows(gaussians: Gaussians4D, rows: Tensor, resting: int, moment: Tensor, has_next: bool) -> tuple[Tensor, ...]:
    """Return the kernel alone, without gradients and without a word from the host to wait for.

    Args:
        gaussians: the model.
        rows: [A] int64; -1 = padding.
        resting: how many of the rows, the first ones, are for Gaussians at rest.
        moment: its numbers on the device (``camera_buffer``).
        has_next: whether means and quats at the other time are wanted.

    Returns:
        means, quats, scales, opacities, colors, velocities, next_means and next_quats; see ``Slice``.
    """
    count = len(rows)
    later = count if has_next else 0
    shapes = ((count, 3), (count, 4), (count, 3), (count,), (count, 3), (count - resting, 3), (later, 3), (later, 4))
    outputs = tuple(torch.empty(shape, device=rows.device) for shape in shapes)
    if count:
        params = (gaussians.params[name] for name in NAMES)
        with device_of(rows):
            _forward[(triton.cdiv(count, BLOCK),)](
                rows, moment, *params, *outputs, count, resting, **_constants(gaussians, has_next)
            )
    return outputs


class _SliceFunction(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, _: Tensor, gaussians: Gaussians4D, active: Active, moment: Tensor, has_next: bool, gradients: Gradients | None
    ) -> tuple[Tensor, ...]:
        outputs = slice_rows(gaussians, active.rows, active.num_static, moment, has_next)
        # Parameters are no inputs (see below), and yet saved: torch then refuses a gradient of others than were sliced.
        ctx.save_for_backward(active.rows, moment, *(gaussians.params[name] for name in NAMES), outputs[0])
        ctx.gaussians, ctx.active, ctx.gradients = gaussians, active, gradients
        ctx.constants = _constants(gaussians, has_next)
        ctx.shapes = tuple(output.shape for output in outputs)
        ctx.set_materialize_grads(False)
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *incoming: Tensor | None) -> tuple[None, ...]:
        gaussians, active, device = ctx.gaussians, ctx.active, ctx.saved_tensors[0].device
        arriving = [
            torch.zeros(shape, device=device) if gradient is None else gradient.contiguous()
            for gradient, shape in zip(incoming, ctx.shapes, strict=True)
        ]
        counts = {name: len(gaussians.rows_of(name, active)) for name in NAMES}
        results = {name: torch.empty(counts[name], *gaussians.params[name].shape[1:], device=device) for name in NAMES}
        count = len(active.rows)
        if count:
            with device_of(active.rows):
                _backward[(triton.cdiv(count, BLOCK),)](
                    *ctx.saved_tensors, *arriving,
                    *results.values(), count, active.num_static, **ctx.constants,
                )  # fmt: skip
        ctx.gradients.update(results)
        return None, None, None, None, None, None


def slice_gaussians(
    gaussians: Gaussians4D, active: Active, camera_center: Tensor, next_time: float | None, gradients: Gradients | None
) -> Slice:
    """See ``api.slice_gaussians``."""
    moment = pack_moment(gaussians.config.gains, active.t, camera_center.cpu().numpy(), next_time)
    # The parameters are not inputs of the function, because their gradients would have their full size: it has one in name.
    anchor = torch.zeros((), requires_grad=gradients is not None)
    has_next = next_time is not None
    outputs = _SliceFunction.apply(anchor, gaussians, active, upload(moment, active.rows.device), has_next, gradients)
    means, quats, scales, opacities, colors, velocities, next_means, next_quats = outputs
    if not has_next:
        next_means = next_quats = None
    return Slice(means, quats, scales, None, opacities, colors, velocities, next_means, next_quats)
