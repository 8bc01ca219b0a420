"""Cut 4D Gaussians into pieces that move on straight lines, as formats hold them in which a Gaussian has one velocity.

A Gaussian lives while its presence is at least that of the model (``p_min``). Over this time its curve is asked for densely, and a
line is fitted: its direction by least squares, its place so that the largest deviations on both sides are equal. Where the line is
further from the curve than ``MAX_CENTER_ERROR``, as the clip's cameras at those times see it, the time is cut into as many parts as
should do: the error of a line grows with the square of its length, that of a constant rotation with its length. Borders lie on a
grid of ticks, so that many pieces share their time. What rests is cut where its brightness changes, and is one piece where that
does not change.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from flowsplat.gaussians.gaussians4d import NEAR_PLANE, Gaussians4D
from flowsplat.gaussians.motion import MotionState
from flowsplat.geometry import Camera
from flowsplat.geometry.paths import CameraPath
from flowsplat.geometry.rotations import covariances, normalize_quats, principal_axes
from flowsplat.splatting.rules import C0

MAX_CENTER_ERROR = 0.06
"""Pixels of the clip's cameras by which a line may deviate from the curve; rounding comes on top (docs/formats.md, "4dgs")."""
MAX_SHAPE_ERROR = 0.25
"""Pixels by which the outline of a Gaussian, one standard deviation from its center, may be elsewhere because it does not turn
(docs/formats.md, "4dgs")."""
MAX_BRIGHTNESS_ERROR = 0.006
"""Of 1, by which brightness may be off because it does not change within a piece (docs/formats.md, "4dgs")."""
TICKS = 8
"""Borders that there may be from one frame to the next. Chosen by eye."""
MAX_TICKS = 1 << 15
"""In a clip: of a long one there are fewer a frame. Chosen by eye."""
DEPTH_WEIGHT = 0.25
"""Of an error along the line of sight, beside one of 1 across it: about what a view from 15 degrees aside sees of it. Chosen by
eye."""
MIN_FADE = 0.998
"""Presence at which a Gaussian never fades as far as formats go: two steps of opacity are 1 / 255 apart."""
MAX_PARTS = 8
"""Into how many parts a piece is cut at once. Chosen by eye."""
SAMPLE_COUNTS = (5, 9, 17, 33, 65, 129, 257, 513)
"""Times at which a piece is looked at: one of these, so that there are four a frame if possible."""
_SHAPES = 5
"""Times of these at which its shape is looked at."""
_BATCH = 1 << 18
"""Times of all pieces that are looked at together: bounds the memory. Chosen by eye."""


@dataclass(frozen=True)
class ClipViews:
    """The clip's cameras, evenly over its time, by the normalized coordinates of the model.

    Attributes:
        steps: ticks in the clip.
        viewmats: [H, 3, 4] float32, two a tick and one at the end.
        focals: [H, 2] in pixels.
        max_slope: x / z and y / z of the directions that the images have, and half as far again.
    """

    steps: int
    viewmats: Tensor
    focals: Tensor
    max_slope: float

    @staticmethod
    def of(times: Sequence[float], cameras: Sequence[Camera]) -> ClipViews:
        """Return those between the clip's frames.

        Args:
            times: [T] clip times of the frames, from 0 to 1.
            cameras: [T] in normalized coordinates.
        """
        steps = min((len(times) - 1) * TICKS, MAX_TICKS)
        path = CameraPath(times, cameras)
        between = [path.at(t) for t in np.linspace(0, 1, 2 * steps + 1)]
        first = cameras[0]
        slope = max(first.width / first.K[0, 0], first.height / first.K[1, 1])
        return ClipViews(
            steps,
            torch.from_numpy(np.array([camera.viewmat[:3] for camera in between])).float(),
            torch.from_numpy(np.array([camera.K[[0, 1], [0, 1]] for camera in between])).float(),
            1.5 * float(slope),
        )

    def index(self, times: Tensor) -> Tensor:
        """Return which camera [...] is the one at clip times [...]."""
        count = len(self.viewmats)
        return (times * (count - 1)).round().long().clamp(0, count - 1)

    def measure(self, times: Tensor, points: Tensor, offsets: Tensor) -> Tensor:
        """Return how many pixels [...] it is for the clip's cameras at ``times`` [...] that ``points`` [..., 3] are off by
        ``offsets`` [..., 3]; also of points that they do not see."""
        index = self.index(times)
        views = self.viewmats[index]
        inner = (views[..., :3] * points[..., None, :]).sum(-1) + views[..., 3]
        moved = (views[..., :3] * offsets[..., None, :]).sum(-1)
        distance = inner.norm(dim=-1)
        depth = torch.maximum(inner[..., 2], 0.25 * distance).clamp(min=NEAR_PLANE)
        slope = (inner[..., :2] / depth[..., None]).clamp(-self.max_slope, self.max_slope)
        across = moved[..., :2] - slope * moved[..., 2:]
        along = DEPTH_WEIGHT * (moved * inner).sum(-1) / distance.clamp(min=1e-9)
        scale = self.focals[index] / depth[..., None]
        return torch.sqrt(((scale * across) ** 2).sum(-1) + (scale[..., 0] * along) ** 2)

    def enlarge(self, times: Tensor, points: Tensor) -> Tensor:
        """Return how many pixels [...] a unit of length is at ``points`` [..., 3]."""
        index = self.index(times)
        views = self.viewmats[index]
        inner = (views[..., :3] * points[..., None, :]).sum(-1) + views[..., 3]
        depth = torch.maximum(inner[..., 2], 0.25 * inner.norm(dim=-1)).clamp(min=NEAR_PLANE)
        return self.focals[index].amax(-1) / depth


@dataclass(frozen=True)
class Pieces:
    """P pieces of Gaussians, in normalized coordinates and clip time.

    Attributes:
        rows: [P] int64 which Gaussian each is a piece of.
        first: [P] int64 tick from which on it is there.
        last: [P] int64 tick from which on it is not; that of the clip's end: at the end, too.
        begins: [P] float64 when it is there from, as far as its presence goes.
        ends: [P] float64 until when.
        means: [P, 3] float64 at the middle between these times.
        velocities: [P, 3] float64 per clip length.
        quats: [P, 4] unit, wxyz.
        log_scales: [P, 3]
        gains: [P] factor of its color.
        centers: [P] float64 times of most presence.
        sigmas: [P] float64 standard deviations of presence in time; infinite = it does not fade.
    """

    rows: Tensor
    first: Tensor
    last: Tensor
    begins: Tensor
    ends: Tensor
    means: Tensor
    velocities: Tensor
    quats: Tensor
    log_scales: Tensor
    gains: Tensor
    centers: Tensor
    sigmas: Tensor

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def middles(self) -> Tensor:
        """[P] float64 the times between ``begins`` and ``ends``."""
        return (self.begins + self.ends) / 2

    def select(self, index: Tensor) -> Pieces:
        """Return some of the pieces."""
        return Pieces(**{name: value[index] for name, value in vars(self).items()})


@torch.no_grad()
def cut_into_pieces(gaussians: Gaussians4D, views: ClipViews) -> Pieces:
    """Return all Gaussians as pieces, those of one behind each other, but for what the clip never shows."""
    at_rest = gaussians.at_rest
    parts = []
    if at_rest.any():
        parts.append(_cut_resting(gaussians, torch.nonzero(at_rest).squeeze(1), views))
    if not at_rest.all():
        parts.append(_cut_moving(gaussians, torch.nonzero(~at_rest).squeeze(1), views))
    joined = Pieces(**{name: torch.cat([getattr(part, name) for part in parts]) for name in vars(parts[0])})
    return joined.select(torch.argsort(joined.rows * (views.steps + 1) + joined.first))


def _cut_resting(gaussians: Gaussians4D, rows: Tensor, views: ClipViews) -> Pieces:
    """Cut those at rest where their brightness changes, each piece as long as it may be."""
    params, steps = gaussians.params, views.steps
    log_gains = params["log_gains"][rows]
    level = (params["sh"][rows, 0] * C0 + 0.5).clamp(0, 1).amax(1) * torch.sigmoid(params["logit_opacities"][rows])
    may_differ = 2 * MAX_BRIGHTNESS_ERROR / level.clamp(min=1e-6)
    numbers = torch.arange(len(rows))
    waves = torch.arange(1, log_gains.shape[1] + 1)

    def gains_at(tick: int) -> Tensor:
        return torch.exp(log_gains @ torch.cos(math.pi * tick / steps * waves))

    begin = torch.zeros(len(rows), dtype=torch.int64)
    low = high = before = gains_at(0)
    found: list[tuple[Tensor, Tensor, Tensor, Tensor]] = []
    for tick in range(steps):
        gains = gains_at(tick + 1)
        lower, higher = torch.minimum(low, gains), torch.maximum(high, gains)
        ends = (higher - lower > may_differ) & (begin < tick)
        found.append((numbers[ends], begin[ends], torch.full_like(begin[ends], tick), (low + high)[ends] / 2))
        begin = torch.where(ends, tick, begin)
        low = torch.where(ends, torch.minimum(before, gains), lower)
        high = torch.where(ends, torch.maximum(before, gains), higher)
        before = gains
    found.append((numbers, begin, torch.full_like(begin, steps), (low + high) / 2))
    number, first, last, gains = (torch.cat([part[k] for part in found]) for k in range(4))
    index = rows[number]
    shape = gaussians.motion.at_rest({name: value[index] for name, value in params.items()})
    quats, log_scales = _decompose(shape.quats, shape.scales, shape.covars)
    zeros = torch.zeros(len(index), dtype=torch.float64)
    return Pieces(
        index, first, last, first.double() / steps, last.double() / steps, params["means"][index].double(),
        torch.zeros(len(index), 3, dtype=torch.float64), quats, log_scales, gains, zeros, zeros + math.inf,
    )  # fmt: skip


def _cut_moving(gaussians: Gaussians4D, rows: Tensor, views: ClipViews) -> Pieces:
    """Cut those that move or fade."""
    curves, steps = Curves(gaussians, rows), views.steps
    begins, ends = curves.begins, curves.ends
    first = (begins * steps).floor().long().clamp(0, steps - 1)
    last = torch.maximum((ends * steps).ceil().long().clamp(max=steps), first + 1)
    pending = (torch.arange(len(curves)), first, last)
    none = torch.zeros(0, dtype=torch.float64)
    vectors, integers = none.expand(3, 0).T, none.long()
    found: list[tuple[Tensor, ...]] = [
        (integers, integers, integers, none, none, vectors, vectors, none.float().expand(4, 0).T, vectors.float())
    ]
    while len(pending[0]):
        again = []
        for batch, count in _batches(pending[2] - pending[1], steps):
            owner, i, j = (part[batch] for part in pending)
            times = sample_times(curves, owner, i, j, steps, count)
            line, quats, log_scales, parts = _fit(curves, owner, times, views)
            parts = torch.minimum(parts, j - i)
            done = parts <= 1
            piece = (owner, i, j, times[:, 0], times[:, -1], line[0], line[1], quats, log_scales)
            found.append(tuple(values[done] for values in piece))
            if not done.all():
                again.append(_split(owner[~done], i[~done], j[~done], parts[~done]))
        empty = pending[0][:0]
        pending = tuple(torch.cat([part[k] for part in again]) if again else empty for k in range(3))  # type: ignore[assignment]
    owner, i, j, start, end, means, velocities, quats, log_scales = (torch.cat([part[k] for part in found]) for k in range(9))
    # The ends of a life need no borders of their own: presence ends it. On a coarse grid more pieces share their time.
    coarse = _grid((j - i).double())
    is_first, is_last = i == first[owner], j == last[owner]
    i = torch.where(is_first, i // coarse * coarse, i)
    j = torch.where(is_last, torch.minimum(-(-j // coarse) * coarse, torch.full_like(j, steps)), j)
    return Pieces(
        curves.rows[owner], i, j, start, end, means, velocities, quats, log_scales, torch.ones(len(i)),
        curves.centers[owner], curves.sigmas[owner],
    )  # fmt: skip


class Curves:
    """Gaussians that move or fade, as far as the clip shows them.

    Attributes:
        rows: [M] which they are.
        centers: [M] float64 clip times of most presence.
        sigmas: [M] float64; infinite = one does not fade.
        begins: [M] float64 clip time from which on it is there.
        ends: [M] float64 until which.
    """

    def __init__(self, gaussians: Gaussians4D, rows: Tensor):
        self._motion = gaussians.motion
        names = ("means", "times", *gaussians.motion.parameters)
        params = {name: gaussians.params[name][rows] for name in names}
        centers = params["times"].double()
        sigmas = torch.exp(-0.5 * self._motion.log_precision(params).double())
        support = math.sqrt(-2 * math.log(cutoff(gaussians)))
        begins, ends = centers - support * sigmas, centers + support * sigmas
        shown = (ends > 0) & (begins < 1)
        self.rows, self.centers = rows[shown], centers[shown]
        self.begins, self.ends = begins[shown].clamp(0, 1), ends[shown].clamp(0, 1)
        away = torch.maximum((self.begins - self.centers).abs(), (self.ends - self.centers).abs())
        fades = torch.exp(-0.5 * (away / sigmas[shown]) ** 2) < MIN_FADE
        self.sigmas = torch.where(fades, sigmas[shown], torch.full_like(self.centers, math.inf))
        self._params = {name: value[shown] for name, value in params.items()}

    def __len__(self) -> int:
        return len(self.rows)

    def states(self, owner: Tensor, times: Tensor) -> Iterator[MotionState]:
        """Those ``owner`` [B] at the times of each column of ``times`` [B, K]."""
        params = {name: value[owner] for name, value in self._params.items()}
        for k in range(times.shape[1]):
            yield self._motion.state(params, times[:, k].float())


def cutoff(gaussians: Gaussians4D) -> float:
    """Return the presence from which on a Gaussian is there."""
    return min(max(gaussians.config.p_min, 1e-6), 1 - 1e-6)


def sample_times(curves: Curves, owner: Tensor, first: Tensor, last: Tensor, steps: int, count: int) -> Tensor:
    """Return [B, count] float64 times from where pieces begin to where they end, or their Gaussians do."""
    start = torch.maximum(first.double() / steps, curves.begins[owner])
    end = torch.maximum(torch.minimum(last.double() / steps, curves.ends[owner]), start)
    return start[:, None] + (end - start)[:, None] * torch.linspace(0, 1, count, dtype=torch.float64)


def count_samples(lengths: Tensor, steps: int) -> Tensor:
    """Return how many times [P] of ``SAMPLE_COUNTS`` pieces of so many ticks [P] are looked at."""
    wanted = 4 * lengths.double() / TICKS + 1
    counts = torch.tensor(SAMPLE_COUNTS)
    return counts[torch.searchsorted(counts.double(), wanted).clamp(max=len(counts) - 1)]


def _batches(lengths: Tensor, steps: int) -> Iterator[tuple[Tensor, int]]:
    """(which pieces, at how many times) of pieces that are looked at as closely."""
    counts = count_samples(lengths, steps)
    for count in SAMPLE_COUNTS:
        chosen = torch.nonzero(counts == count).squeeze(1)
        for batch in chosen.split(max(_BATCH // count, 1)):
            if len(batch):
                yield batch, count


def _fit(curves: Curves, owner: Tensor, times: Tensor, views: ClipViews) -> tuple[tuple[Tensor, Tensor], Tensor, Tensor, Tensor]:
    """Fit lines to pieces.

    Returns:
        means [B, 3] at the middle of the times and velocities [B, 3]; quaternions and logarithms of scales at the middle; into how
        many parts [B] each has to be cut, 1 = it need not.
    """
    count = times.shape[1]
    shape_at = {round(k * (count - 1) / (_SHAPES - 1)) for k in range(_SHAPES)}
    points, shapes = [], []
    for k, state in enumerate(curves.states(owner, times)):
        points.append(state.means.double())
        if k in shape_at:
            shapes.append(state)
    curve = torch.stack(points, 1)
    place = torch.linspace(-1, 1, count, dtype=torch.float64)
    slope = (place[:, None] * curve).sum(1) / (place**2).sum()
    rest = curve - slope[:, None] * place[:, None]
    middle = (rest.amin(1) + rest.amax(1)) / 2
    error = views.measure(times, curve.float(), (middle[:, None] - rest).float()).amax(1)
    parts = torch.sqrt(error / MAX_CENTER_ERROR)
    half = (times[:, -1] - times[:, 0]) / 2
    velocities = slope / half.clamp(min=1e-12)[:, None] * (half > 0)[:, None]

    held = shapes[len(shapes) // 2]
    quats, log_scales = _decompose(held.quats, held.scales, held.covars)
    own = covariances(quats, torch.exp(log_scales))
    size = own.flatten(1).norm(dim=1).sqrt().clamp(min=1e-12)
    change = torch.stack([(_covariances(state) - own).flatten(1).norm(dim=1) for state in shapes], 1).amax(1)
    outline = change / (2 * size) * views.enlarge(times[:, count // 2], curve[:, count // 2].float())
    parts = torch.maximum(parts, outline / MAX_SHAPE_ERROR)
    return (middle, velocities), quats, log_scales, parts.ceil().clamp(1, MAX_PARTS).long()


def _split(owner: Tensor, first: Tensor, last: Tensor, parts: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the parts of pieces, with borders on as coarse a grid as leaves them of about one length."""
    length = (last - first).double()
    grid = _grid(length / parts)
    borders = [first]
    for k in range(1, MAX_PARTS):
        border = ((first + length * k / parts) / grid).round().long() * grid
        borders.append(torch.where(k < parts, border, last))
    borders.append(last)
    starts, ends = torch.stack(borders[:-1], 1), torch.stack(borders[1:], 1)
    kept = ends > starts
    return owner[:, None].expand_as(starts)[kept], starts[kept], ends[kept]


def _grid(lengths: Tensor) -> Tensor:
    """Return the power of two, at least 1, that is at most a fourth of a length [P] in ticks."""
    return torch.pow(2, torch.log2((lengths / 4).clamp(min=1)).floor()).long()


def _covariances(state: MotionState) -> Tensor:
    if state.covars is not None:
        return state.covars
    assert state.quats is not None
    assert state.scales is not None
    return covariances(state.quats, state.scales)


def _decompose(quats: Tensor | None, scales: Tensor | None, covars: Tensor | None) -> tuple[Tensor, Tensor]:
    if covars is not None:
        return principal_axes(covars)
    assert quats is not None
    assert scales is not None
    return normalize_quats(quats), torch.log(scales)
