"""Bin projected Gaussians into the list of Gaussians of every tile, in depth order, without asking the GPU how many there are.

One sort of the Gaussians by depth; then every Gaussian counts the tiles that its alpha >= 1/255 ellipse touches, a prefix sum
gives it its *slots*, and it writes the number of one tile into each. A second, stable sort brings the slots of a tile together
and keeps their depth order. Slots stay grouped by Gaussian: backward writes one row a slot, and the rows of a Gaussian are
then summed in order, so there are no atomics and the bits do not depend on the schedule.

The number of slots is fixed, which is what lets a CUDA graph replay all this. How many were needed is known on
the GPU at once and on the host a little later: ``PairCapacity``.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
import triton
import triton.language as tl
from torch import Tensor

from flowsplat.common.triton import rows_per_program
from flowsplat.splatting.rules import ALPHA_MIN

TILE = 16
"""Pixels, wide and high."""
RECORD = 8
"""Floats of a Gaussian's geometry, so that it lies in one sector of memory; six are used."""
MAX_INSTANCES = 2**31 - 1
"""Pairs of a Gaussian and a tile, at most: what a signed 32-bit index reaches."""
_GRANULE = 4096
"""Capacities are multiples of this. Chosen by eye."""

_TILE = tl.constexpr(TILE)
_RECORD = tl.constexpr(RECORD)
_LOG_ALPHA_MIN = tl.constexpr(math.log(ALPHA_MIN))
_LOG2_E = tl.constexpr(1 / math.log(2))
_MIN_CONIC = tl.constexpr(1e-20)


class PairCapacity:
    """How many pairs of a Gaussian and a tile can be stored, and how many were needed.

    By default every size of image on a device has a capacity of its own, which grows by itself: while the GPU blends, the host
    reads how many pairs were counted, and does the image again where they did not fit. A CUDA graph cannot do that. Inside
    ``with capacity.fix():`` nothing waits for the GPU; look at ``has_overflowed()`` afterwards, and if it is true, ``grow()`` and
    draw (or capture) again: the image lacks what did not fit.

    Attributes:
        pairs: how many can be stored.
    """

    def __init__(self, device: torch.device | str, pairs: int = 1 << 16) -> None:
        self.pairs = _round_up(pairs)
        self._needed = torch.zeros(1, dtype=torch.int64, device=device)

    @contextmanager
    def fix(self) -> Iterator[PairCapacity]:
        """Blend with this capacity, without waiting for the GPU."""
        before, _chosen.capacity = getattr(_chosen, "capacity", None), self
        try:
            yield self
        finally:
            _chosen.capacity = before

    def note(self, needed: Tensor) -> None:
        """Keep the largest number [1] that was needed, on the device."""
        torch.maximum(self._needed, needed, out=self._needed)

    def has_overflowed(self) -> bool:
        """Return whether an image drawn with this capacity, since it was made, needed more than it is now. Waits for the GPU."""
        return int(self._needed) > self.pairs

    def grow(self, needed: int | None = None) -> None:
        """Raise it to what was needed and a quarter more.

        Raises:
            ValueError: there are more pairs than can be numbered.
        """
        needed = int(self._needed) if needed is None else needed
        if needed > MAX_INSTANCES:
            raise ValueError(f"{needed} pairs of a Gaussian and a tile are too many: at most {MAX_INSTANCES} fit")
        self.pairs = min(max(self.pairs, _round_up(needed + needed // 4)), MAX_INSTANCES)


def _round_up(count: int) -> int:
    return max(-(-count // _GRANULE), 1) * _GRANULE


_chosen = threading.local()
_shared: dict[tuple[torch.device, int, int], PairCapacity] = {}


def get_fixed_capacity() -> PairCapacity | None:
    """Return the one of ``with capacity.fix():``, if we are inside of that."""
    capacity: PairCapacity | None = getattr(_chosen, "capacity", None)
    return capacity


def get_shared_capacity(device: torch.device, width: int, height: int) -> PairCapacity:
    """Return the capacity that images of this size share, and that grows by itself."""
    key = (device, width, height)
    if key not in _shared:
        _shared[key] = PairCapacity(device)
    return _shared[key]


@dataclass(frozen=True)
class Counted:
    """What every Gaussian needs.

    Attributes:
        order: [N] int64, Gaussians by depth, then index; the culled ones last.
        counts: [N] int32, tiles of each, in this order.
        ends: [N] int64, where the slots of each end.
        records: [N, 8] geometry, by index: center, three of the exponent in base 2, log2 opacity. Not of culled ones.
        needed: [1] int64, slots in all.
    """

    order: Tensor
    counts: Tensor
    ends: Tensor
    records: Tensor
    needed: Tensor


@dataclass(frozen=True)
class Binned:
    """The Gaussians of every tile.

    Attributes:
        slots: [capacity] int64, tile after tile; those past the last tile's end mean nothing.
        gaussians: [capacity] int32, whose slots they are.
        offsets: [tiles + 1] int32, where each tile begins.
    """

    slots: Tensor
    gaussians: Tensor
    offsets: Tensor


def tile_grid(width: int, height: int) -> tuple[int, int]:
    """Columns and rows of tiles."""
    return -(-width // TILE), -(-height // TILE)


def count_tiles(
    means2d: Tensor, conics: Tensor, opacities: Tensor, depths: Tensor, extents: Tensor, width: int, height: int
) -> Counted:
    """Sort by depth, pack, and count tiles; all tensors float32 and contiguous, N > 0."""
    count, device = len(means2d), means2d.device
    keys = torch.where(extents > 0, depths, math.inf)
    order = torch.sort(keys, stable=True).indices
    counts = torch.empty(count, dtype=torch.int32, device=device)
    records = torch.empty(count, RECORD, device=device)
    block = rows_per_program(count)
    cut_tiles[(triton.cdiv(count, block),)](
        order, means2d, conics, opacities, extents, records, counts, None, None, None, count, width, height,
        tile_grid(width, height)[0], 0, FILL=False, BLOCK=block,
    )  # fmt: skip
    ends = torch.cumsum(counts, 0, dtype=torch.int64)
    return Counted(order, counts, ends, records, ends[-1:])


def fill_tiles(
    counted: Counted, means2d: Tensor, conics: Tensor, opacities: Tensor, extents: Tensor, width: int, height: int, capacity: int
) -> Binned:
    """Bring the Gaussians of every tile together, as many as the capacity allows."""
    count, device = len(means2d), means2d.device
    columns, rows = tile_grid(width, height)
    # A tile number no tile has marks an unused slot, and sorts last. Narrow keys sort faster.
    dtype = torch.int16 if columns * rows < 2**15 - 1 else torch.int32
    keys = torch.full((capacity,), columns * rows, dtype=dtype, device=device)
    owners = torch.zeros(capacity, dtype=torch.int32, device=device)
    block = rows_per_program(count)
    cut_tiles[(triton.cdiv(count, block),)](
        counted.order, means2d, conics, opacities, extents, None, counted.counts, counted.ends, keys, owners, count, width, height,
        columns, capacity, FILL=True, BLOCK=block,
    )  # fmt: skip
    tiles_in_order, slots = torch.sort(keys, stable=True)
    bounds = torch.arange(columns * rows + 1, dtype=dtype, device=device)
    offsets = torch.searchsorted(tiles_in_order, bounds, out_int32=True)
    return Binned(slots, owners[slots], offsets)


@triton.jit(do_not_specialize=["count", "width", "height", "tile_columns", "capacity"])
def cut_tiles(
    order, means2d, conics, opacities, extents, records, counts, ends, keys, owners,
    count, width, height, tile_columns, capacity, FILL: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Every tile that the ellipse of a Gaussian touches: pack the Gaussian and count them, or write them down (FILL)."""
    s = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = s < count
    i = tl.load(order + s, mask=live, other=0).to(tl.int32)
    drawn = tl.load(extents + i, mask=live, other=0.0) > 0
    x = tl.load(means2d + 2 * i, mask=drawn, other=0.0)
    y = tl.load(means2d + 2 * i + 1, mask=drawn, other=0.0)
    a = tl.load(conics + 3 * i, mask=drawn, other=1.0)
    b = tl.load(conics + 3 * i + 1, mask=drawn, other=0.0)
    c = tl.load(conics + 3 * i + 2, mask=drawn, other=1.0)
    level = tl.log(tl.load(opacities + i, mask=drawn, other=1.0))
    # Drawn is where a dx^2 + 2 b dx dy + c dy^2 <= limit. At an offset dx that reaches over y - slope dx +- sqrt(top - bend
    # dx^2), and its lowest point in the image is at dx = lowest. A determinant that rounding made 0 is that of a long line.
    limit = tl.maximum(2 * (level - _LOG_ALPHA_MIN), 0.0)
    inverse, determinant = 1.0 / tl.maximum(c, _MIN_CONIC), tl.maximum(a * c - b * b, _MIN_CONIC)
    half = tl.sqrt(limit * c / determinant)
    slope, top, bend = b * inverse, limit * inverse, inverse * inverse * determinant
    lowest = -b * tl.sqrt(limit / (determinant * tl.maximum(a, _MIN_CONIC)))
    last_x, last_y = (width - 1).to(tl.float32), (height - 1).to(tl.float32)
    left = tl.minimum(tl.maximum(tl.ceil(x - half - 0.5), 0.0), last_x + 1)
    right = tl.maximum(tl.minimum(tl.floor(x + half - 0.5), last_x), -1.0)
    first_column = left.to(tl.int32) // _TILE
    columns = tl.where(drawn & (left <= right), right.to(tl.int32) // _TILE - first_column + 1, 0)
    if FILL:
        size = tl.load(counts + s, mask=live, other=0)
        begin = tl.load(ends + s, mask=live, other=0) - size
    total = tl.zeros([BLOCK], tl.int32)
    k, most_columns = 0, tl.max(columns, axis=0)
    while k < most_columns:
        column = first_column + k
        edge = (column * _TILE).to(tl.float32)
        low = tl.maximum(edge, left) + 0.5 - x
        high = tl.minimum(edge + (_TILE - 1), right) + 0.5 - x
        d, u = tl.minimum(tl.maximum(lowest, low), high), tl.minimum(tl.maximum(-lowest, low), high)
        first = tl.ceil(y - slope * u - tl.sqrt(tl.maximum(top - bend * u * u, 0.0)) - 0.5)
        last = tl.floor(y - slope * d + tl.sqrt(tl.maximum(top - bend * d * d, 0.0)) - 0.5)
        first, last = tl.minimum(tl.maximum(first, 0.0), last_y + 1), tl.maximum(tl.minimum(last, last_y), -1.0)
        first_row = first.to(tl.int32) // _TILE
        rows = tl.where((k < columns) & (first <= last), last.to(tl.int32) // _TILE - first_row + 1, 0)
        if FILL:
            r, most_rows = 0, tl.max(rows, axis=0)
            while r < most_rows:
                slot = begin + (total + r)
                # This is another compilation than the one that counted, and may round otherwise: never more than counted.
                fits = (r < rows) & (total + r < size) & (slot < capacity)
                tile = (first_row + r) * tile_columns + column
                tl.store(keys + slot, tile.to(keys.dtype.element_ty), mask=fits)
                tl.store(owners + slot, i, mask=fits)
                r += 1
        total += rows
        k += 1
    if not FILL:
        tl.store(counts + s, total, mask=live)
        o = records + i * _RECORD
        tl.store(o, x, mask=drawn)
        tl.store(o + 1, y, mask=drawn)
        tl.store(o + 2, a * -0.5 * _LOG2_E, mask=drawn)
        tl.store(o + 3, -b * _LOG2_E, mask=drawn)
        tl.store(o + 4, c * -0.5 * _LOG2_E, mask=drawn)
        tl.store(o + 5, level * _LOG2_E, mask=drawn)
