"""The cull as two Triton kernels: mark and count by blocks, then write the rows where the blocks before them end.

Oracle: ``reference``. The rows come in the same order on every run.
"""

from __future__ import annotations

import numpy as np
import torch
import triton
import triton.language as tl
from torch import Tensor

from flowsplat.common.devices import Later, upload
from flowsplat.common.triton import device_of
from flowsplat.gaussians.camera_buffer import CAMERA, CX, CY, FX, FY, TIME, camera_numbers, to_camera
from flowsplat.gaussians.culling import reference
from flowsplat.gaussians.culling.capacity import RowCapacity
from flowsplat.geometry import Camera
from flowsplat.splatting.rules import TANGENT_MARGIN

BLOCK = 1024
"""Gaussians of one program. A power of two, as Triton asks."""
CULL_SIGMAS, BLUR_RADIUS, CULL_MARGIN = (
    tl.constexpr(reference.CULL_SIGMAS),
    tl.constexpr(reference.BLUR_SIGMA),
    tl.constexpr(TANGENT_MARGIN),
)


@triton.jit
def _reaches(position, size, center, focal, inverse, image):
    """Whether a Gaussian reaches into the image on one axis; its 2D sigma is at most focal / z |(1, t)| size + blur."""
    limit = tl.maximum(image - center, center) / focal + image * CULL_MARGIN / focal
    tangent = position * inverse
    held = tl.minimum(tl.maximum(tangent, -limit), limit)
    reach = (focal * inverse * size * tl.sqrt(1.0 + held * held) + BLUR_RADIUS) * CULL_SIGMAS
    pixel = focal * tangent + center
    return (pixel + reach >= 0.0) & (pixel - reach <= image)


@triton.jit(do_not_specialize=["count", "blocks"])
def _mark(
    at_rest, means, log_scales, times, log_lambdas, camera, moment, p_min, near, width, height, count, blocks, keep, counts,
    USE_CAMERA: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Fill keep [N] uint8 (1 = seen at rest, 2 = seen moving) and counts [2, blocks]."""
    block = tl.program_id(0)
    i = block * BLOCK + tl.arange(0, BLOCK)
    inside = i < count
    resting = tl.load(at_rest + i, mask=inside, other=0) != 0
    tau = tl.load(moment + TIME) - tl.load(times + i, mask=inside, other=0.0)
    precision = tl.exp(tl.load(log_lambdas + i, mask=inside, other=0.0))
    moving = inside & (resting == 0) & (tl.exp(-0.5 * precision * tau * tau) >= p_min)
    resting = inside & resting
    if USE_CAMERA:
        x = tl.load(means + i * 3, mask=resting, other=0.0)
        y = tl.load(means + i * 3 + 1, mask=resting, other=0.0)
        z = tl.load(means + i * 3 + 2, mask=resting, other=0.0)
        first = tl.load(log_scales + i * 3, mask=resting, other=0.0)
        second = tl.load(log_scales + i * 3 + 1, mask=resting, other=0.0)
        third = tl.load(log_scales + i * 3 + 2, mask=resting, other=0.0)
        size = tl.exp(tl.maximum(first, tl.maximum(second, third)))
        right, down, depth = to_camera(camera, x, y, z)
        front = depth > near
        inverse = 1.0 / tl.where(front, depth, 1.0)
        resting &= front
        resting &= _reaches(right, size, tl.load(camera + CX), tl.load(camera + FX), inverse, width)
        resting &= _reaches(down, size, tl.load(camera + CY), tl.load(camera + FY), inverse, height)
    kind = tl.where(resting, 1, 0) + tl.where(moving, 2, 0)
    tl.store(keep + i, kind.to(tl.uint8), mask=inside)
    tl.store(counts + block, tl.sum(tl.where(resting, 1, 0), 0))
    tl.store(counts + blocks + block, tl.sum(tl.where(moving, 1, 0), 0))


@triton.jit(do_not_specialize=["rows_at_rest", "capacity", "count", "blocks"])
def _collect(keep, counts, ends, rows, rows_at_rest, capacity, count, blocks, BLOCK: tl.constexpr):
    """Write the kept rows in order: those at rest from 0 to rows_at_rest, those that move from there to capacity.

    ends [2, blocks]: how many of a kind there are up to the end of a block.
    """
    block = tl.program_id(0)
    i = block * BLOCK + tl.arange(0, BLOCK)
    kind = tl.load(keep + i, mask=i < count, other=0).to(tl.int32)
    resting, moving = tl.where(kind == 1, 1, 0), tl.where(kind == 2, 1, 0)
    first = tl.load(ends + block) - tl.load(counts + block)
    last = tl.load(ends + blocks + block) - tl.load(counts + blocks + block)
    place = first + tl.cumsum(resting, 0) - resting
    tl.store(rows + place, i.to(tl.int64), mask=(kind == 1) & (place < rows_at_rest))
    place = rows_at_rest + last + tl.cumsum(moving, 0) - moving
    tl.store(rows + place, i.to(tl.int64), mask=(kind == 2) & (place < capacity))


class Marked:
    """Gaussians that were marked as seen: ``ends[:, -1]`` says on the device how many rest and how many move."""

    def __init__(
        self, at_rest: Tensor, means: Tensor, log_scales: Tensor | None, times: Tensor, log_lambdas: Tensor, camera: Tensor,
        moment: Tensor, p_min: float, size: tuple[int, int] | None, near: float,
    ):  # fmt: skip
        """Mark them.

        Args:
            at_rest: and the other tensors: see ``api.active_rows``.
            camera: its numbers on the device (``camera_buffer``); not read without a size.
            moment: that of the time, of which only the time is read.
            p_min: see ``api.active_rows``.
            size: (width, height) of the camera; None = all at rest are seen.
            near: see ``api.active_rows``.
        """
        self._count, self._blocks = len(means), max(triton.cdiv(len(means), BLOCK), 1)
        self._keep = torch.empty(self._count, dtype=torch.uint8, device=means.device)
        self._counts = torch.empty(2, self._blocks, dtype=torch.int32, device=means.device)
        use_camera = size is not None and log_scales is not None
        width, height = size or (1, 1)
        with device_of(means):
            _mark[(self._blocks,)](
                at_rest.view(torch.uint8), means, means if log_scales is None else log_scales, times, log_lambdas, camera, moment,
                float(p_min), float(near), float(width), float(height), self._count, self._blocks, self._keep, self._counts,
                USE_CAMERA=use_camera, BLOCK=BLOCK,
            )  # fmt: skip
        self.ends = torch.cumsum(self._counts, 1, dtype=torch.int32)

    def collect(self, rows: Tensor, rows_at_rest: int) -> None:
        """Fill rows: those at rest up to ``rows_at_rest``, the moving ones after it; what exceeds the rows is left out."""
        with device_of(rows):
            _collect[(self._blocks,)](
                self._keep, self._counts, self.ends, rows, rows_at_rest, len(rows), self._count, self._blocks, BLOCK=BLOCK
            )

    def pad(self, capacity: RowCapacity) -> Tensor:
        """As many rows as ``capacity`` says; -1 in those that are padding."""
        rows = torch.full((capacity.at_rest + capacity.moving,), -1, dtype=torch.int64, device=self._keep.device)
        self.collect(rows, capacity.at_rest)
        return rows


def _mark_rows(
    at_rest: Tensor, means: Tensor, log_scales: Tensor | None, times: Tensor, log_lambdas: Tensor, t: float, p_min: float,
    camera: Camera | None, near: float,
) -> Marked:  # fmt: skip
    known = [*camera_numbers(camera)[0], t] if camera is not None else [0.0] * CAMERA.value + [t]
    numbers, moment = upload(np.array(known, np.float32), means.device).split([CAMERA.value, 1])
    size = (camera.width, camera.height) if camera is not None else None
    return Marked(at_rest, means, log_scales, times, log_lambdas, numbers, moment, p_min, size, near)


def active_rows(
    at_rest: Tensor, means: Tensor, log_scales: Tensor | None, times: Tensor, log_lambdas: Tensor, t: float, p_min: float,
    camera: Camera | None, near: float,
) -> tuple[Tensor, int]:  # fmt: skip
    """See ``api.active_rows``. Waits for the device once, for the two numbers that say how large everything after it is."""
    marked = _mark_rows(at_rest, means, log_scales, times, log_lambdas, t, p_min, camera, near)
    resting, moving = marked.ends[:, -1].tolist()
    rows = torch.empty(resting + moving, dtype=torch.int64, device=means.device)
    marked.collect(rows, resting)
    return rows, resting


def pad_active_rows(
    at_rest: Tensor, means: Tensor, log_scales: Tensor | None, times: Tensor, log_lambdas: Tensor, t: float, p_min: float,
    camera: Camera | None, near: float, capacity: RowCapacity,
) -> tuple[Tensor, Later]:  # fmt: skip
    """See ``api.pad_active_rows``."""
    marked = _mark_rows(at_rest, means, log_scales, times, log_lambdas, t, p_min, camera, near)
    return marked.pad(capacity), Later(marked.ends[:, -1])
