"""Round pieces to the integers of a ``.4dgs``, and measure how far off what a reader gets is from the curves.

How finely positions and velocities are rounded follows from what the clip's cameras see of it. A position is stored for the time of
most presence, which may be long before or after its piece: it is the one from which the rounded velocity leads to the right place
in the piece's middle. In the same way the constant part of a color is the one that with its rounded harmonics looks right from
the clip's camera at that time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from flowsplat.gaussians.gaussians4d import NEAR_PLANE, Gaussians4D
from flowsplat.gaussians.model import SceneModel
from flowsplat.geometry.rotations import multiply_quats, rotations_to_quats
from flowsplat.output.export.fourdgs.container import MAX_BIN, Steps
from flowsplat.output.export.fourdgs.pieces import (
    SAMPLE_COUNTS,
    ClipViews,
    Curves,
    Pieces,
    count_samples,
    cutoff,
)
from flowsplat.output.export.still import FLIP_AXES, rotate_harmonics
from flowsplat.splatting.harmonics import harmonics_basis, harmonics_count
from flowsplat.splatting.rules import C0

MAX_ROUNDING = 0.01
"""Pixels of the clip's cameras by which rounding moves a coordinate, at the beginning or the end of a piece: once by its position,
once by its velocity (docs/formats.md, "4dgs")."""
_NEAR_SHARE = 0.999
"""Share of the pieces for which that holds: those that are nearer still do not decide on all. Chosen by eye."""
_STEP_SCALE, _STEP_ROTATION, _STEP_COLOR, _STEP_OPACITY = 0.02, 0.004, 1 / 255, 1 / 255
"""Finer ones would be nearer to our renderer by less than .1 dB (docs/formats.md, "4dgs")."""
_STEP_TIME, _STEP_DEVIATION = 0.00025, 0.004
"""The last is of a logarithm, seconds before; presence at the edge of a life is wrong by hundredths of itself. Chosen by eye."""
_LIFE, _LIFE_CLASSES, _LIVES = 0.5, (-4, 2), (0.02, 2.0)
"""Of the format: the seconds for which the step of velocities holds, powers of two by which it is finer or coarser, and the seconds
between which lives count."""
_TIME_SHARE, _TIME_CLASSES = 0.05, (-10, 0)
"""Of the format: the share of a deviation that a step of its time is at most, and powers of two by which it is finer."""
HARMONICS_RANGE = 4.0
"""Of the format: harmonics of degree 1 and more are bytes between minus and plus this."""
MAX_CENTER_DISTANCE = 1000.0
"""Clip lengths between a piece and its time of most presence. What is further off is brought there, its deviation in proportion:
in the middle of the piece it is as present as before, elsewhere to a hundredth."""
_BASE_MARGIN = 0.02
"""From 0 and 1, for constant parts of colors: rounded harmonics are made up for there. Chosen by eye."""
_REST = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])


@dataclass(frozen=True)
class Frame:
    """How the file's coordinates and seconds follow from those of the model.

    Attributes:
        scale: units of the file in one of the model.
        rotation: [3, 3] float64.
        translation: [3] float64.
        seconds: from the first frame of the clip to its last.
        duration: of the file: each frame of the clip is shown as long as any other.
    """

    scale: float
    rotation: np.ndarray
    translation: np.ndarray
    seconds: float
    duration: float

    @staticmethod
    def of(model: SceneModel, num_frames: int) -> Frame:
        """Return that of a scene: the coordinates of its cameras, but y up and z backward."""
        undo, flip = model.similarity.inverse(), FLIP_AXES.double().numpy()
        seconds = model.last - model.first
        return Frame(undo.scale, flip @ undo.rotation, flip @ undo.translation, seconds, seconds * num_frames / (num_frames - 1))

    def points(self, points: np.ndarray) -> np.ndarray:
        """Return points [..., 3] in coordinates of the file."""
        return self.scale * points @ self.rotation.T + self.translation

    def undo(self, points: np.ndarray) -> np.ndarray:
        """Return points [..., 3] in those of the model."""
        return (points - self.translation) @ self.rotation / self.scale


@dataclass(frozen=True)
class Rounded:
    """P pieces as integers.

    Attributes:
        steps: what one more is.
        origin: [3] of the positions.
        windows: [W, 2] seconds.
        position: [P, 3]
        scale: [P, 3]
        rotation_index: [P] which component is the largest.
        rotation: [P, 3] the others.
        opacity: [P]
        motion: [P, 3]
        center_time: [P]
        deviation: [P]
        flags: [P] 1 = it does not fade.
        window: [P] its number.
        positions: [P, 3] float64 as a reader gets them.
        motions: [P, 3] float64 likewise, units a second.
        center_times: [P] float64 likewise, seconds.
    """

    steps: Steps
    origin: np.ndarray
    windows: np.ndarray
    position: np.ndarray
    scale: np.ndarray
    rotation_index: np.ndarray
    rotation: np.ndarray
    opacity: np.ndarray
    motion: np.ndarray
    center_time: np.ndarray
    deviation: np.ndarray
    flags: np.ndarray
    window: np.ndarray
    positions: np.ndarray
    motions: np.ndarray
    center_times: np.ndarray


def round_pieces(gaussians: Gaussians4D, pieces: Pieces, views: ClipViews, frame: Frame) -> Rounded:
    """Return all but the colors."""
    middles = pieces.middles
    pixels = views.enlarge(middles, pieces.means.float()).double().numpy() / frame.scale
    middle = middles.numpy() * frame.seconds
    means = frame.points(pieces.means.numpy())
    velocities = frame.scale / frame.seconds * pieces.velocities.numpy() @ frame.rotation.T
    half = (pieces.ends - pieces.begins).numpy() / 2 * frame.seconds

    sigmas = pieces.sigmas.numpy() * frame.seconds
    never = np.isinf(sigmas)
    centers = pieces.centers.numpy() * frame.seconds
    far = min(MAX_CENTER_DISTANCE * frame.seconds, MAX_BIN * _STEP_TIME / 2)
    nearer = np.minimum(far / np.maximum(np.abs(centers - middle), 1e-30), 1.0)
    centers, sigmas = np.where(nearer < 1, middle + nearer * (centers - middle), centers), sigmas * nearer
    deviation = _round(np.log(np.where(never, 1.0, sigmas)), _STEP_DEVIATION)
    sigmas = np.exp(deviation * _STEP_DEVIATION)
    step_time = _STEP_TIME * 2.0 ** np.clip(
        np.floor(np.log2(np.where(never, 1.0, np.minimum(1.0, _TIME_SHARE * sigmas / _STEP_TIME)))), *_TIME_CLASSES
    )
    moves = (velocities != 0).any(1)
    center_time = _round(np.where(never, np.where(moves, middle, 0.0), centers), step_time)
    center_times = (center_time * step_time).astype(np.float32).astype(np.float64)

    windows, window = _list_windows(pieces, views.steps, frame)
    life = np.where(never, windows[window, 1] - windows[window, 0], math.sqrt(-2 * math.log(cutoff(gaussians))) * sigmas)
    finer = 2.0 ** -np.clip(np.ceil(np.log2(np.clip(life, *_LIVES) / _LIFE)), *_LIFE_CLASSES)
    allowed = 2 * MAX_ROUNDING / np.maximum(pixels * half * finer, 1e-30)
    step_motion = float(np.quantile(allowed[moves], 1 - _NEAR_SHARE)) if moves.any() else 1.0
    step_motion = max(step_motion, float(np.abs(velocities / finer[:, None]).max(initial=0)) / MAX_BIN)
    motion = _round(velocities, step_motion * finer[:, None])
    motions = (motion * (step_motion * finer)[:, None]).astype(np.float32).astype(np.float64)

    places = means + motions * (center_times - middle)[:, None]
    origin = places.min(0, initial=0.0)
    step_position = 2 * MAX_ROUNDING / float(np.quantile(pixels, _NEAR_SHARE)) if len(pixels) else 1.0
    step_position = max(step_position, float((places - origin).max(initial=0)) / MAX_BIN)
    position = _round(places - origin, step_position)

    turn = rotations_to_quats(torch.from_numpy(frame.rotation))
    quats = np.roll(multiply_quats(turn.expand(len(pieces), 4), pieces.quats.double()).numpy(), -1, axis=1)
    index = np.abs(quats).argmax(1)
    rows = np.arange(len(quats))
    quats = quats * np.where(quats[rows, index] < 0, -1, 1)[:, None]
    opacities = torch.sigmoid(gaussians.params["logit_opacities"][pieces.rows].double()).numpy()
    return Rounded(
        Steps(
            step_position, _STEP_SCALE, _STEP_ROTATION, _STEP_COLOR, _STEP_OPACITY, step_motion, _STEP_TIME, _STEP_DEVIATION
        ),
        origin, windows, position, _round(pieces.log_scales.double().numpy() + math.log(frame.scale), _STEP_SCALE), index,
        _round(quats[rows[:, None], _REST[index]], _STEP_ROTATION), _round(opacities, _STEP_OPACITY), motion, center_time,
        np.where(never, 0, deviation), never.astype(np.int64), window,
        (position * step_position + origin).astype(np.float32).astype(np.float64), motions, center_times,
    )  # fmt: skip


def round_colors(
    gaussians: Gaussians4D, pieces: Pieces, views: ClipViews, frame: Frame
) -> tuple[np.ndarray, list[np.ndarray]]:  # fmt: skip
    """Return the colors of pieces, as a reader without harmonics gets them, and their harmonics.

    Returns:
        color: [P, 3] integers of red, green and blue.
        bands: [P, 3 (2 b + 1)] bytes of bands b from 1 on, those of red first.
    """
    degree = gaussians.sh_degree
    rotation = torch.from_numpy(frame.rotation)
    rows, numbers = torch.unique(pieces.rows, return_inverse=True)
    sh = rotate_harmonics(gaussians.params["sh"][rows][:, : harmonics_count(degree)], rotation)[numbers].double()
    sh = sh * pieces.gains.double()[:, None, None]
    base = 0.5 * pieces.gains.double()[:, None] + C0 * sh[:, 0]
    bands: list[np.ndarray] = []
    if degree > 0:
        cameras = views.viewmats[views.index(pieces.middles)].double()
        seen_from = -(cameras[:, :, :3].transpose(1, 2) @ cameras[:, :, 3:])[:, :, 0]
        towards = torch.nn.functional.normalize(pieces.means - seen_from, dim=1) @ rotation.T
        basis = harmonics_basis(towards, degree)
        # The constant part has to be between 0 and 1: what is beyond looks the same in harmonics of degree 1, from there.
        inside = base.clamp(_BASE_MARGIN, 1 - _BASE_MARGIN)
        first = basis[:, 1:4] / (basis[:, 1:4] ** 2).sum(1, keepdim=True)
        wanted = sh[:, 1:].clone()
        wanted[:, :3] += first[:, :, None] * (base - inside)[:, None]
        codes = ((wanted + HARMONICS_RANGE) * (255 / (2 * HARMONICS_RANGE))).round().clamp(0, 255)
        stored = codes * (2 * HARMONICS_RANGE / 255) - HARMONICS_RANGE
        base = inside + (basis[:, 1:, None] * (wanted - stored)).sum(1)
        for band in range(1, degree + 1):
            chosen = codes[:, band**2 - 1 : (band + 1) ** 2 - 1]
            bands.append(chosen.transpose(1, 2).flatten(1).to(torch.uint8).numpy())
    return _round(base.clamp(0, 1).numpy(), _STEP_COLOR), bands


@torch.no_grad()
def measure_errors(gaussians: Gaussians4D, pieces: Pieces, rounded: Rounded, views: ClipViews, frame: Frame, size: tuple[int, int],
                   middle: tuple[float, float]) -> np.ndarray:  # fmt: skip
    """Measure how far the centers that a reader gets are from the curves, at times between those at which lines were fitted.

    Args:
        size: width and height of the clip's images.
        middle: the pixel that the camera looks along.

    Returns:
        [E] pixels of all centers that the clip's cameras see, at all those times.
    """
    moving = torch.nonzero(~gaussians.at_rest).squeeze(1)
    curves = Curves(gaussians, moving)
    at_rest = gaussians.at_rest[pieces.rows]
    counts = count_samples(pieces.last - pieces.first, views.steps)
    found = []
    for count in SAMPLE_COUNTS:
        for rests in (True, False):
            for batch in torch.nonzero((counts == count) & (at_rest == rests)).squeeze(1).split(max((1 << 18) // count, 1)):
                if not len(batch):
                    continue
                piece = pieces.select(batch)
                shares = (torch.arange(count - 1, dtype=torch.float64) + 0.5) / (count - 1)
                times = piece.begins[:, None] + (piece.ends - piece.begins)[:, None] * shares
                if rests:
                    true = gaussians.params["means"][piece.rows].double()[:, None].expand(-1, count - 1, -1)
                else:
                    owner = torch.searchsorted(curves.rows, piece.rows)
                    true = torch.stack([state.means.double() for state in curves.states(owner, times)], 1)
                index = batch.numpy()
                since = times.numpy() * frame.seconds - rounded.center_times[index, None]
                got = frame.undo(rounded.positions[index, None] + rounded.motions[index, None] * since[..., None])
                found.append(_list_differences(true, torch.from_numpy(got), views, times, size, middle))
    return np.concatenate(found) if found else np.zeros(0)


def _list_differences(
    true: Tensor, got: Tensor, views: ClipViews, times: Tensor, size: tuple[int, int], middle: tuple[float, float]
) -> np.ndarray:  # fmt: skip
    index = views.index(times)
    viewmats, focals = views.viewmats[index].double(), views.focals[index].double()
    places = []
    for points in (true, got):
        inner = (viewmats[..., :3] * points[..., None, :]).sum(-1) + viewmats[..., 3]
        places.append((focals * inner[..., :2] / inner[..., 2:].clamp(min=1e-9) + torch.tensor(middle), inner[..., 2]))
    (pixels, depth), (others, _) = places
    is_seen = (depth > NEAR_PLANE) & (pixels >= 0).all(-1) & (pixels < torch.tensor(size)).all(-1)
    return (pixels - others)[is_seen].norm(dim=-1).numpy()


def _list_windows(pieces: Pieces, steps: int, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Return all windows [W, 2] in seconds, and the number [P] of that of each piece."""
    ticks, number = np.unique(np.stack([pieces.first.numpy(), pieces.last.numpy()], 1), axis=0, return_inverse=True)
    seconds = ticks / steps * frame.seconds
    seconds[ticks == steps] = frame.duration
    return seconds, number.reshape(-1)


def _round(values: np.ndarray, step: float | np.ndarray) -> np.ndarray:
    bins: np.ndarray = np.rint(values / step).astype(np.int64)
    return bins
