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
from flowsplat.gaussians.culling import reference
from flowsplat.gaussians.culling.rooms import Rooms
from flowsplat.geometry import Camera

BLOCK = 1024
REACH, BLUR, MARGIN = tl.constexpr(reference.REACH), tl.constexpr(reference.BLUR), tl.constexpr(reference.MARGIN)
K = tl.constexpr(17)
LENS = 1 + 16 + 9
"""Numbers of a lens: clip time, the view matrix and from ``K`` on the intrinsics, both by rows."""


@triton.jit
def _axis(lens, row: tl.constexpr, x, y, z):
    """A point in camera axes, one of its coordinates."""
    at = lens + 1 + 4 * row
    return tl.load(at) * x + tl.load(at + 1) * y + tl.load(at + 2) * z + tl.load(at + 3)


@triton.jit
def _reaches(position, size, center, focal, inverse, picture):
    """Whether a Gaussian reaches into the picture on one axis; its 2D sigma is at most focal / z |(1, t)| size + blur."""
    limit = tl.maximum(picture - center, center) / focal + picture * MARGIN / focal
    tangent = position * inverse
    held = tl.minimum(tl.maximum(tangent, -limit), limit)
    reach = (focal * inverse * size * tl.sqrt(1.0 + held * held) + BLUR) * REACH
    pixel = focal * tangent + center
    return (pixel + reach >= 0.0) & (pixel - reach <= picture)


@triton.jit
def _mark(
    at_rest, means, log_scales, times, log_lambdas, lens, p_min, near, width, height, count, blocks, keep, counts,
    USE_CAMERA: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Fill keep [N] uint8 (1 = seen at rest, 2 = seen moving) and counts [2, blocks]."""
    block = tl.program_id(0)
    i = block * BLOCK + tl.arange(0, BLOCK)
    inside = i < count
    resting = tl.load(at_rest + i, mask=inside, other=0) != 0
    tau = tl.load(lens) - tl.load(times + i, mask=inside, other=0.0)
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
        depth = _axis(lens, 2, x, y, z)
        front = depth > near
        inverse = 1.0 / tl.where(front, depth, 1.0)
        resting &= front
        resting &= _reaches(_axis(lens, 0, x, y, z), size, tl.load(lens + K + 2), tl.load(lens + K), inverse, width)
        resting &= _reaches(_axis(lens, 1, x, y, z), size, tl.load(lens + K + 5), tl.load(lens + K + 4), inverse, height)
    kind = tl.where(resting, 1, 0) + tl.where(moving, 2, 0)
    tl.store(keep + i, kind.to(tl.uint8), mask=inside)
    tl.store(counts + block, tl.sum(tl.where(resting, 1, 0), 0))
    tl.store(counts + blocks + block, tl.sum(tl.where(moving, 1, 0), 0))


@triton.jit
def _collect(keep, counts, ends, rows, room_at_rest, room, count, blocks, BLOCK: tl.constexpr):
    """Write the kept rows in order: those at rest from 0 to room_at_rest, those that move from there to room.

    ends [2, blocks]: how many of a kind there are up to the end of a block.
    """
    block = tl.program_id(0)
    i = block * BLOCK + tl.arange(0, BLOCK)
    kind = tl.load(keep + i, mask=i < count, other=0).to(tl.int32)
    resting, moving = tl.where(kind == 1, 1, 0), tl.where(kind == 2, 1, 0)
    first = tl.load(ends + block) - tl.load(counts + block)
    last = tl.load(ends + blocks + block) - tl.load(counts + blocks + block)
    place = first + tl.cumsum(resting, 0) - resting
    tl.store(rows + place, i.to(tl.int64), mask=(kind == 1) & (place < room_at_rest))
    place = room_at_rest + last + tl.cumsum(moving, 0) - moving
    tl.store(rows + place, i.to(tl.int64), mask=(kind == 2) & (place < room))


def lens_numbers(t: float, camera: Camera | None) -> np.ndarray:
    """[``LENS``] float32, what the kernels need to know of a time and a camera."""
    lens = np.zeros(LENS, np.float32)
    lens[0] = t
    if camera is not None:
        lens[1 : K.value], lens[K.value :] = camera.viewmat.ravel(), camera.K.ravel()
    return lens


class Marked:
    """Gaussians that were marked as seen: ``ends[:, -1]`` says on the device how many rest and how many move."""

    def __init__(
        self, at_rest: Tensor, means: Tensor, log_scales: Tensor | None, times: Tensor, log_lambdas: Tensor, lens: Tensor,
        p_min: float, size: tuple[int, int] | None, near: float,
    ):  # fmt: skip
        """Mark them.

        Args:
            at_rest: and the other tensors: see ``api.active_rows``.
            lens: ``lens_numbers`` on the device.
            p_min: see ``api.active_rows``.
            size: (width, height) of the camera; None = everybody at rest is seen.
            near: see ``api.active_rows``.
        """
        self._count, self._blocks = len(means), max(triton.cdiv(len(means), BLOCK), 1)
        self._keep = torch.empty(self._count, dtype=torch.uint8, device=means.device)
        self._counts = torch.empty(2, self._blocks, dtype=torch.int32, device=means.device)
        use_camera = size is not None and log_scales is not None
        width, height = size or (1, 1)
        with device_of(means):
            _mark[(self._blocks,)](
                at_rest.view(torch.uint8), means, means if log_scales is None else log_scales, times, log_lambdas, lens,
                float(p_min), float(near), float(width), float(height), self._count, self._blocks, self._keep, self._counts,
                USE_CAMERA=use_camera, BLOCK=BLOCK,
            )  # fmt: skip
        self.ends = torch.cumsum(self._counts, 1, dtype=torch.int32)

    def collect(self, rows: Tensor, room_at_rest: int) -> None:
        """Fill rows: those at rest up to ``room_at_rest``, the moving ones after it; what finds no room is left out."""
        with device_of(rows):
            _collect[(self._blocks,)](
                self._keep, self._counts, self.ends, rows, room_at_rest, len(rows), self._count, self._blocks, BLOCK=BLOCK
            )

    def padded(self, rooms: Rooms) -> Tensor:
        """Rows of as many as there is room for; -1 in every place that stays empty."""
        rows = torch.full((rooms.at_rest + rooms.moving,), -1, dtype=torch.int64, device=self._keep.device)
        self.collect(rows, rooms.at_rest)
        return rows


def _marked(
    at_rest: Tensor, means: Tensor, log_scales: Tensor | None, times: Tensor, log_lambdas: Tensor, t: float, p_min: float,
    camera: Camera | None, near: float,
) -> Marked:  # fmt: skip
    lens, size = upload(lens_numbers(t, camera), means.device), (camera.width, camera.height) if camera is not None else None
    return Marked(at_rest, means, log_scales, times, log_lambdas, lens, p_min, size, near)


def active_rows(
    at_rest: Tensor, means: Tensor, log_scales: Tensor | None, times: Tensor, log_lambdas: Tensor, t: float, p_min: float,
    camera: Camera | None, near: float,
) -> tuple[Tensor, int]:  # fmt: skip
    """See ``api.active_rows``. Waits for the device once, for the two numbers that say how large everything after it is."""
    marked = _marked(at_rest, means, log_scales, times, log_lambdas, t, p_min, camera, near)
    resting, moving = marked.ends[:, -1].tolist()
    rows = torch.empty(resting + moving, dtype=torch.int64, device=means.device)
    marked.collect(rows, resting)
    return rows, resting


def padded_rows(
    at_rest: Tensor, means: Tensor, log_scales: Tensor | None, times: Tensor, log_lambdas: Tensor, t: float, p_min: float,
    camera: Camera | None, near: float, rooms: Rooms,
) -> tuple[Tensor, Later]:  # fmt: skip
    """See ``api.padded_rows``."""
    marked = _marked(at_rest, means, log_scales, times, log_lambdas, t, p_min, camera, near)
    return marked.padded(rooms), Later(marked.ends[:, -1])
