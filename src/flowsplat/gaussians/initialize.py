"""The first Gaussians: from the pixels and tracks of the training frames, or at random (docs/method/training.md,
"Initialization")."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import cv2
import numpy as np
import torch
from msgspec import Meta

from flowsplat.common.bounds import Amount, AtLeastOne, Fraction, Positive, bounds_in_help
from flowsplat.common.errors import InputError
from flowsplat.common.spread import spread
from flowsplat.gaussians.first_motion import fit_motion
from flowsplat.gaussians.gaussians4d import NEAR_PLANE, Gaussians4D, parameter_shapes
from flowsplat.gaussians.model_config import ModelConfig
from flowsplat.gaussians.motion import SharedMotion, motion_model
from flowsplat.gaussians.observations import Observation, Observations
from flowsplat.gaussians.sampling import detail, grid, spacings
from flowsplat.gaussians.surfaces import SurfaceSamples, sample_surface
from flowsplat.scenes import Tracks
from flowsplat.splatting.harmonics import harmonics_from_colors

SPACED_SIDE = 480
"""Pixels of the long side of frames from which on Gaussians are farther apart (``InitConfig.spacing_growth``): that of the rendered
scenes on which spacings were chosen."""
BACKGROUND_LOG_LAMBDA = float(np.log(1e-6))
MIN_TRUSTED_SHARE = 0.05
"""Share of the objects' pixels of a frame: where fewer have trusted depth, all of them are used. Chosen by eye."""
RANDOM_OPACITY = 0.1
"""Opacity of a random start."""
FITTING_TRIES = 3
"""How often the grids are made coarser until the cap holds. Chosen by eye."""
FITTING_MARGIN = 1.01
"""By how much coarser than the count says. Chosen by eye."""


@bounds_in_help
@dataclass(frozen=True)
class InitConfig:
    """How the Gaussians start."""

    from_priors: bool = True
    """Start from depth, masks and motion. Off: at random (the paper's ablation, and the baseline 4DGS)."""
    foreground: Literal["pixels", "tracks"] = "pixels"
    """What becomes an object's Gaussian: every pixel of its mask in the sampled frames, or every track (the paper)."""
    samples: Annotated[int, Meta(ge=1, le=10_000)] = 24
    """Over how many training frames the objects' Gaussians are sampled (the paper's T-hat)."""
    sample_gap: Annotated[int, Meta(ge=0, le=10_000)] = 4
    """More of them where two would be further apart than so many training frames; 0 = however far (the paper)."""
    precision_factor: Positive = 0.15
    """Temporal precision in units of (pi / spacing of the samples)^2: so little lets neighboring samples overlap."""
    background_spacing: Annotated[float, Meta(ge=1, le=1_000)] = 1.5
    """Pixels between two background Gaussians on average, 1 or more; a cap makes it larger."""
    foreground_spacing: Annotated[float, Meta(ge=1, le=1_000)] = 1.5
    """The same for objects, in every sampled frame."""
    spacing_growth: Annotated[float, Meta(ge=0, le=1)] = 0.4
    """Both are of frames of up to 480 pixels; in larger ones they grow by this power of the long side. 0 = the same in pixels, 1 =
    as many Gaussians as in small frames."""
    detail: Annotated[float, Meta(ge=0, le=4)] = 1.0
    """How much more of them there are where the image has detail: their density follows its power of this; 0 = evenly."""
    merge_tolerance: Amount = 0.1
    """Relative depth difference within which a background pixel counts as stored already."""
    edge: Annotated[int, Meta(ge=0, le=256)] = 2
    """Pixels around the objects' masks from which no background Gaussian is made."""
    opacity: Fraction = 0.9
    """Opacity at the start."""
    size: Positive = 0.45
    """Standard deviation at the start, in spacings."""
    surface_aligned: bool = True
    """Start as discs aligned to the surface; off: as spheres as large as the mean distance of three neighbors (as 4DGS)."""
    flatness: Positive = 0.2
    """Thickness of a disc relative to its radius."""
    motion_order: Annotated[int, Meta(ge=1, le=16)] = 4
    """Order of the polynomial that is fitted to the objects' points (``first_motion``)."""
    motion_reach: Annotated[int, Meta(ge=0, le=10_000)] = 3
    """Over how many training frames to either side an object's pixel is followed for that fit."""
    random_count: AtLeastOne = 300_000
    """How many Gaussians a random start has (never more than the run's cap)."""


def initialize(
    observations: Observations, tracks: Tracks | None, model: ModelConfig, config: InitConfig, seed: int, cap: int,
    moves: bool = True,
) -> Gaussians4D:  # fmt: skip
    """Gaussians to start training from.

    Args:
        observations: the training frames.
        tracks: needed for ``foreground="tracks"`` only.
        model: what a Gaussian is made of.
        config: how to start.
        seed: of the random choices.
        cap: no more Gaussians than this. Both grids, of the background and of the objects, are made coarser alike until they
            fit, so that fewer Gaussians are larger and leave no holes; what little is still too much is dropped at random.
        moves: whether what a motion model shares among Gaussians is fitted to their paths; a scene without motion has no use
            for it.
    """
    rng = np.random.default_rng(seed)
    config = _widen(config, (max(observations.size) / SPACED_SIDE) ** config.spacing_growth)
    if not config.from_priors:
        first = _random(observations, rng, min(config.random_count, cap))
    else:
        first = _from_priors(observations, tracks, model, config, rng)
        for _ in range(FITTING_TRIES):
            if len(first) <= cap:
                break
            # Twice as wide a grid has a quarter of the points.
            config = _widen(config, FITTING_MARGIN * (len(first) / cap) ** 0.5)
            first = _from_priors(observations, tracks, model, config, rng)
    if len(first) > cap:
        first = first.select(np.sort(rng.permutation(len(first))[:cap]))
    if len(first) == 0:
        raise InputError("No Gaussian could be made: the scene has no trusted depth in any training frame.")
    return _build(first, model, config.opacity if config.from_priors else RANDOM_OPACITY, moves)


def _widen(config: InitConfig, factor: float) -> InitConfig:
    """Return settings with Gaussians farther apart; never closer together."""
    factor = max(factor, 1.0)
    return replace(
        config, background_spacing=factor * config.background_spacing, foreground_spacing=factor * config.foreground_spacing
    )


def _from_priors(
    observations: Observations, tracks: Tracks | None, model: ModelConfig, config: InitConfig, rng: np.random.Generator
) -> _First:
    background = _initialize_background(observations, model, config, rng)
    if not any(frame.mask.any() for frame in observations.frames):
        return background
    return _First.concatenate([background, _initialize_objects(observations, tracks, config, rng)])


# -- building


@dataclass(frozen=True)
class _First:
    """What the first Gaussians are made of, N of them.

    Attributes:
        samples: of surfaces.
        times: [N] center times.
        log_lambdas: [N] log of their temporal precision.
        motion: [N, order, 3] first polynomial coefficients of the mean.
        dynamic: [N] bool.
        object_ids: [N] uint8, the number of the object that each belongs to; 0 = none.
    """

    samples: SurfaceSamples
    times: np.ndarray
    log_lambdas: np.ndarray
    motion: np.ndarray
    dynamic: np.ndarray
    object_ids: np.ndarray

    def __len__(self) -> int:
        return len(self.times)

    def select(self, rows: np.ndarray) -> _First:
        """Return some of them."""
        return _First(self.samples.select(rows), *(values[rows] for values in self._arrays()))

    def _arrays(self) -> tuple[np.ndarray, ...]:
        return self.times, self.log_lambdas, self.motion, self.dynamic, self.object_ids

    @staticmethod
    def concatenate(parts: Sequence[_First]) -> _First:
        """Return all of several; a shorter polynomial has no further terms."""
        order = max(part.motion.shape[1] for part in parts)
        padded = [replace(part, motion=np.pad(part.motion, ((0, 0), (0, order - part.motion.shape[1]), (0, 0)))) for part in parts]
        joined = (np.concatenate(values) for values in zip(*(part._arrays() for part in padded), strict=True))
        return _First(SurfaceSamples.concatenate([part.samples for part in parts]), *joined)


def _build(first: _First, model: ModelConfig, opacity: float, moves: bool) -> Gaussians4D:
    """Make Gaussians of them. What these share is fitted to all of their paths together, once: that of what rests is 0."""
    count = len(first)
    params = {name: torch.zeros(count, *shape) for name, shape in parameter_shapes(model).items()}
    params["means"] = torch.from_numpy(first.samples.means.astype(np.float32))
    params["times"] = torch.from_numpy(first.times.astype(np.float32))
    params["logit_opacities"] = torch.full((count,), float(np.log(opacity / (1 - opacity))))
    params["sh"][:, 0] = harmonics_from_colors(torch.from_numpy(first.samples.colors.astype(np.float32)))
    motion = motion_model(model)
    quats, scales, precision, followed = (
        torch.from_numpy(values.astype(np.float32))
        for values in (first.samples.quats, first.samples.scales, first.log_lambdas, first.motion)
    )
    params.update(motion.start(params["means"], params["times"], quats, scales, precision, followed))
    dynamic, shared = torch.from_numpy(first.dynamic), {}
    if isinstance(motion, SharedMotion):
        shared = motion.start_shared(params, followed, dynamic) if moves else motion.initial_shared()
    return Gaussians4D(params, dynamic, model, object_ids=torch.from_numpy(first.object_ids.astype(np.uint8)), shared=shared)


def _spheres(samples: SurfaceSamples) -> SurfaceSamples:
    """Return the same points as spheres, as large as the mean distance of their three nearest neighbors (fudan)."""
    if len(samples.means) < 2:
        return samples
    distances = _nearest(samples.means, samples.means, min(4, len(samples.means)))[0]
    radius = np.clip(distances[:, 1:].mean(1), 1e-5, None)
    quats = np.tile([1.0, 0, 0, 0], (len(radius), 1))
    return SurfaceSamples(samples.means, quats, np.repeat(radius[:, None], 3, 1), samples.colors)


def _choose_pixels(
    frame: Observation, region: np.ndarray, spacing: float, config: InitConfig, rng: np.random.Generator
) -> tuple[np.ndarray, float | np.ndarray]:
    """Return which pixels [H, W] of a region become Gaussians, ``spacing`` apart on average, and how far apart they are."""
    apart: float | np.ndarray = spacing
    if config.detail:
        apart = spacings(detail(frame.image) ** config.detail, region, spacing)
    height, width = region.shape
    return region & grid(width, height, apart, rng), apart


# -- background


def _middle_out(count: int) -> list[int]:
    """First, last, middle, quarters, ...: what a frame adds to the ones before it gets less and less."""
    order, intervals = [0, count - 1] if count > 1 else [0], [(0, count - 1)]
    while intervals:
        first, last = intervals.pop(0)
        middle = (first + last) // 2
        if middle not in (first, last):
            order.append(middle)
            intervals += [(first, middle), (middle, last)]
    return order


def _initialize_background(observations: Observations, model: ModelConfig, config: InitConfig, rng: np.random.Generator) -> _First:
    """Unproject what lies outside the masks, every surface once: first what has trusted depth, then what is still missing.

    Borders that few frames saw have no trusted depth, and a guess renders far better there than a hole.
    """
    parts: list[SurfaceSamples] = []
    times: list[np.ndarray] = []
    order = _middle_out(len(observations))
    for k, trusted in [(k, True) for k in order] + [(k, False) for k in order]:
        frame = observations[k]
        mask = cv2.dilate(frame.mask.astype(np.uint8), np.ones((2 * config.edge + 1,) * 2, np.uint8)) > 0
        pixels, spacing = _choose_pixels(frame, ~mask, config.background_spacing, config, rng)
        wanted = pixels & (frame.depth_trusted == trusted)
        if parts:
            stored = np.concatenate([part.means for part in parts])
            wanted &= ~_find_covered(stored, frame, config.merge_tolerance, spacing)
        if wanted.any():
            parts.append(sample_surface(frame, wanted, spacing * config.size, config.flatness))
            # A frozen background has no use for its center time, so it remembers the frame that it was seen in: that is where
            # it starts to move if it turns out not to be background.
            times.append(np.full(len(parts[-1].means), frame.time if model.freeze_background else 0.5))
    if not parts:
        parts, times = [SurfaceSamples.empty()], [np.zeros(0)]
    samples = SurfaceSamples.concatenate(parts)
    if not config.surface_aligned:
        samples = _spheres(samples)
    count = len(samples.means)
    precision, still = np.full(count, BACKGROUND_LOG_LAMBDA), np.zeros((count, 0, 3))
    return _First(samples, np.concatenate(times), precision, still, np.zeros(count, bool), np.zeros(count, np.uint8))


def _find_covered(points: np.ndarray, frame: Observation, tolerance: float, spacing: float | np.ndarray) -> np.ndarray:
    """Return [H, W] bool: pixels within whose spacing one of the points [N, 3] lies on the visible surface."""
    height, width = frame.depth.shape
    (u, v), depth = (values.T for values in frame.camera.project(points))
    inside = (depth > NEAR_PLANE) & (u >= 0) & (v >= 0) & (u < width) & (v < height)
    x, y, surface = u[inside].astype(np.int64), v[inside].astype(np.int64), frame.depth
    on_surface = np.abs(depth[inside] - surface[y, x]) < tolerance * surface[y, x]
    hit = np.zeros((height, width), np.uint8)
    hit[y[on_surface], x[on_surface]] = 1
    reach = np.broadcast_to(np.maximum(1, np.round(spacing)), hit.shape)
    covered = np.zeros(hit.shape, bool)
    for pixels in map(int, np.unique(reach)):
        covered |= (reach == pixels) & (cv2.dilate(hit, np.ones((2 * pixels + 1,) * 2, np.uint8)) > 0)
    return covered


# -- foreground


def choose_frames(count: int, config: InitConfig) -> tuple[np.ndarray, float]:
    """Return which of ``count`` training frames objects are sampled in, and the log precision that follows from their spacing."""
    enough = -(-(count - 1) // config.sample_gap) + 1 if config.sample_gap else 1
    sampled = np.array(spread(count, min(max(config.samples, enough), count)))
    spacing = 1.0 / max(len(sampled) - 1, 1)
    return sampled, float(np.log(config.precision_factor * (np.pi / spacing) ** 2))


def _initialize_objects(
    observations: Observations,
    tracks: Tracks | None,
    config: InitConfig,
    rng: np.random.Generator,
) -> _First:
    """Objects: every pixel (or track) of the sampled frames, with the motion of the points it follows."""
    sampled, log_lambda = choose_frames(len(observations), config)
    sigma = float(np.exp(-0.5 * log_lambda))
    samples, times, motions, object_ids = [], [], [], []
    for k in sampled:
        frame = observations[k]
        usable = frame.mask & frame.depth_trusted
        if usable.sum() < MIN_TRUSTED_SHARE * frame.mask.sum():
            usable = frame.mask  # At a guessed depth is better than not at all: nothing else makes objects.
        if config.foreground == "pixels":
            wanted, spacing = _choose_pixels(frame, usable, config.foreground_spacing, config, rng)
        else:
            wanted, spacing = usable & _track_pixels(tracks, frame, usable), config.foreground_spacing
        if not wanted.any():
            continue
        samples.append(sample_surface(frame, wanted, spacing * config.size, config.flatness))
        times.append(np.full(len(samples[-1].means), frame.time))
        motions.append(fit_motion(observations, k, wanted, sigma, config.motion_order, config.motion_reach))
        object_ids.append(frame.object_ids[wanted])
    if not samples:
        samples, times, motions = [SurfaceSamples.empty()], [np.zeros(0)], [np.zeros((0, config.motion_order, 3))]
        object_ids = [np.zeros(0, np.uint8)]
    merged, center_times = SurfaceSamples.concatenate(samples), np.concatenate(times)
    if not config.surface_aligned:
        merged = _spheres(merged)
    precision, dynamic = np.full(len(center_times), log_lambda), np.ones(len(center_times), bool)
    return _First(merged, center_times, precision, np.concatenate(motions), dynamic, np.concatenate(object_ids))


def _track_pixels(tracks: Tracks | None, frame: Observation, usable: np.ndarray) -> np.ndarray:
    """Return [H, W] bool: the pixels of the moving tracks; where those are too sparse, one pixel in every 4 x 4."""
    height, width = usable.shape
    wanted = np.zeros((height, width), np.uint8)
    if tracks is not None:
        points = tracks.points[tracks.visible[:, frame.frame], frame.frame].astype(np.int64)
        inside = ((points >= 0) & (points < [width, height])).all(1)
        wanted[points[inside, 1], points[inside, 0]] = 1
    y, x = np.mgrid[:height, :width]
    sparse = cv2.dilate(wanted & usable, np.ones((9, 9), np.uint8)) == 0
    return (wanted > 0) | (sparse & (x % 4 == 2) & (y % 4 == 2))


# -- random


def _random(observations: Observations, rng: np.random.Generator, count: int) -> _First:
    """Uniform in the box of the training frusta between 0.3 and 3 median depths, at uniform times (docs/method/training.md)."""
    corners = []
    for frame in observations.frames:
        w, h = frame.camera.width, frame.camera.height
        uv = np.array([[0, 0], [w, 0], [0, h], [w, h]], float)
        corners += [frame.camera.unproject(uv, np.full(4, depth)) for depth in (0.3, 3.0)]
    low, high = np.concatenate(corners).min(0), np.concatenate(corners).max(0)
    means = rng.uniform(low, high, (count, 3))
    points = SurfaceSamples(means, np.tile([1.0, 0, 0, 0], (count, 1)), np.ones((count, 3)), rng.random((count, 3)))
    times, precision = rng.uniform(-0.1, 1.1, count), np.full(count, np.log(5.0))
    still, dynamic = np.zeros((count, 0, 3)), np.ones(count, bool)
    return _First(_spheres(points), times, precision, still, dynamic, np.zeros(count, np.uint8))


def _nearest(points: np.ndarray, queries: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return distances and indices of the ``count`` points nearest to each query: [Q, count], or [Q] for one."""
    from scipy.spatial import cKDTree  # A quarter of a second, which those who only look at a scene need not wait.

    distances, indices = cKDTree(points).query(queries, k=count, workers=-1)
    return distances, indices
