"""The background as it looks without the objects' shadows (docs/method/representation.md).

A shadow moves with what throws it and belongs to no mask. In a trained scene it is brightness in time of the background
(``log_gains``). Where a still surface is seen in some frames with an object near it and in others without, the others tell how
bright it is by itself. A shadow that never leaves cannot be told from a dark surface, and stays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from scipy.spatial import cKDTree

from flowsplat.common.threads import in_threads
from flowsplat.gaussians.model import SceneModel, at_once
from flowsplat.geometry import Camera

NEAR_OBJECT_SIZES = 3.0
"""Sizes of an object (square root of its area in the image) from its mask within which its shadow may fall
(docs/method/representation.md)."""

MIN_CLEAR_FRAMES = 3
"""Frames without an object near that must show a surface (docs/method/representation.md)."""

OWN_BRIGHTNESS_QUANTILE = 0.5
"""Of these frames' brightness the share below that which a surface has by itself (docs/method/representation.md)."""

FEW_FRAMES, FEW_FRAMES_QUANTILE = 8, 0.8
"""Where there are fewer: frames that must show it, and the share of their brightness below that which it has by itself
(docs/method/representation.md)."""

FEW_FRAMES_DARKENING = 0.15
"""As ``MIN_LOG_DARKENING``, there (docs/method/representation.md)."""

MIN_LOG_DARKENING = 0.03
"""Logarithm of the brightness by which a surface must be darker beside objects, or it is left as it is
(docs/method/representation.md)."""

SHADOW_NEIGHBORS, NEIGHBOR_LIMITS = 16, 1.0
"""Nearest Gaussians at rest, most of which must be darker by so many limits, too (docs/method/representation.md)."""

MAX_DEPTH_JUMP, EDGE_FRAME_SHARE = 0.05, 0.5
"""Share of its depth by which a pixel is off the plane around at an edge, and of the frames that see a surface there, from which
nothing is told of it (docs/method/representation.md)."""

GAIN_STIFFNESS = 1e-4
"""Weight of the squared gains, times that of their wave, against the squared errors of brightness. Chosen by eye."""

EXPOSURE_POINTS = 20_000
"""About how many points that are never beside an object tell how bright whole frames are. Chosen by eye."""

UNSEEN_WEIGHT = 0.3
"""Weight of times at which a surface is not seen. Chosen by eye."""

IS_SEEN, IS_FAR, IS_AT_EDGE = 1, 2, 4
"""Flags of a point in a frame: that it is seen, that no object is near, that it is at a jump of depth."""
SEEN_ALONE, SEEN_AT_EDGE = IS_SEEN | IS_FAR, IS_SEEN | IS_AT_EDGE
_SURFACE_TOLERANCE = 0.05
"""Share of its distance by which a point may lie behind the surface that a frame sees. Chosen by eye."""
_MIN_ALPHA = 0.5
"""Alpha from which something is there. Chosen by eye."""
_ROWS_AT_A_TIME, _NUMBERS_AT_A_TIME = 8192, 2**22
"""Gaussians whose gains are fitted at a time at most, for the memory; and that of their gains at all times. Chosen by eye."""


def add_shadow_free(
    model: SceneModel, cameras: Sequence[Camera], times: Sequence[float], masks: Sequence[np.ndarray]
) -> SceneModel:
    """Return the scene with how bright its background is without what moves (``Gaussians4D.shadow_free``).

    Args:
        model: the trained scene.
        cameras: [T] of the training frames.
        times: [T] seconds of them.
        masks: [T] numbers of objects [H, W] in them.
    """
    g = model.gaussians
    waves = g.config.gains
    rests = torch.nonzero(g.at_rest).squeeze(1)
    if not waves or not len(rests) or not any(mask.any() for mask in masks):
        return model
    points = model.similarity.inverse().points(g.params["means"][rests].double().cpu().numpy())
    flags = _look_beside_objects(model, points, cameras, times, masks)
    # Only what is ever beside an object can be in its shadow; of all else some tell how bright whole frames are.
    beside = np.concatenate([(part & SEEN_ALONE == IS_SEEN).any(1) for part in _parts(flags)])
    others = np.flatnonzero(~beside)
    chosen = np.sort(np.concatenate([np.flatnonzero(beside), others[:: max(1, len(others) // EXPOSURE_POINTS)]]))
    flags = flags[chosen]
    t = torch.tensor([model.clip_time(each) for each in times], dtype=torch.float64)
    cosines = torch.cos(math.pi * t[:, None] * torch.arange(1, waves + 1))
    gains = g.params["log_gains"][rests].float().cpu()[torch.from_numpy(chosen)]
    curves = _Curves(gains, cosines.float(), flags)
    clear, seen = curves.count(SEEN_ALONE), curves.count(IS_SEEN)
    # Brightness in time of what is thin or ends makes up for all that is wrong with it.
    flat = curves.count(SEEN_AT_EDGE) <= EDGE_FRAME_SHARE * seen
    told = flat & (clear >= MIN_CLEAR_FRAMES)
    # Beside an object that never leaves, a shadow still comes and goes.
    beside_only = flat & ~told & (seen >= FEW_FRAMES)
    level = np.full(len(chosen), np.nan, np.float32)
    level[told] = curves.quantile(told, SEEN_ALONE, OWN_BRIGHTNESS_QUANTILE)
    # How bright a whole frame is belongs to no shadow.
    exposure = _exposure(curves.of(told) - level[told, None], curves.has(told, SEEN_ALONE))
    level[told] = curves.quantile(told, SEEN_ALONE, OWN_BRIGHTNESS_QUANTILE, exposure)
    level[beside_only] = curves.quantile(beside_only, IS_SEEN, FEW_FRAMES_QUANTILE, exposure)
    darkest = np.where(told | beside_only, curves.darkest(level, exposure), 0)
    limit = np.where(told, MIN_LOG_DARKENING, FEW_FRAMES_DARKENING)
    times_limit = np.zeros(len(points), np.float32)
    times_limit[chosen] = darkest / limit
    # A shadow is no matter of single Gaussians: most around must be as dark.
    nearest = min(SHADOW_NEIGHBORS, len(points))
    dark = np.flatnonzero(darkest < -limit)
    around = cKDTree(points).query(points[chosen[dark]], nearest)[1].reshape(len(dark), nearest)
    changed = dark[np.median(times_limit[around], 1) < -NEIGHBOR_LIMITS]
    shadow_free = torch.cat([torch.zeros(len(g), 1), g.params["log_gains"].detach().float().cpu()], 1)
    rows = min(curves.at_a_time, _ROWS_AT_A_TIME)
    for some in (changed[start : start + rows] for start in range(0, len(changed), rows)):
        curve, was_seen = curves.of(some), curves.has(some, IS_SEEN)
        bright = was_seen & (curves.shade(some, level, exposure) > -MIN_LOG_DARKENING)
        target = np.where(np.where(told[some, None], curves.has(some, SEEN_ALONE), bright), curve, level[some, None] + exposure)
        fitted = _fit(target, np.where(was_seen, 1.0, UNSEEN_WEIGHT), cosines)
        shadow_free[rests.cpu()[torch.from_numpy(chosen[some])]] = fitted.float()
    return replace(model, gaussians=replace(g, shadow_free=shadow_free.to(g.device)))


def _parts(flags: np.ndarray) -> list[np.ndarray]:
    """Return rows of flags [N, T] a few at a time, for the memory."""
    rows = max(_NUMBERS_AT_A_TIME // max(flags.shape[1], 1), 1)
    return [flags[start : start + rows] for start in range(0, max(len(flags), 1), rows)]


@dataclass(frozen=True)
class _Curves:
    """Brightness of points over the frames, made a few points at a time: that of all in all frames takes gigabytes.

    Attributes:
        gains: [N, G] of the points.
        cosines: [T, G] of the frames, float32.
        flags: [N, T] uint8, as of ``_look_beside_objects``.
    """

    gains: torch.Tensor
    cosines: torch.Tensor
    flags: np.ndarray

    @property
    def at_a_time(self) -> int:
        """Points whose brightness is held at the same time."""
        return max(_NUMBERS_AT_A_TIME // max(len(self.cosines), 1), 1)

    def of(self, points: np.ndarray) -> np.ndarray:
        """Return [n, T] float32 of some points, [n] indices or [N] bool: logarithms of brightness."""
        return (self.gains[torch.from_numpy(points)] @ self.cosines.T).numpy()

    def has(self, points: np.ndarray, flags: int) -> np.ndarray:
        """Return [n, T] bool, where all of these flags are set."""
        return np.asarray(self.flags[points] & flags == flags)

    def count(self, flags: int) -> np.ndarray:
        """Return [N] in how many frames all of these are set."""
        return np.concatenate([(part & flags == flags).sum(1) for part in _parts(self.flags)])

    def quantile(self, points: np.ndarray, flags: int, share: float, exposure: np.ndarray | None = None) -> np.ndarray:
        """Return [n] the quantile of points [N] bool over the frames in which these flags are set; of each at least one is."""
        found = []
        for some in self._split(np.flatnonzero(points)):
            curve = self.of(some) if exposure is None else self.of(some) - exposure
            found.append(_quantile(curve, self.has(some, flags), share))
        return np.concatenate(found)

    def shade(self, points: np.ndarray, level: np.ndarray, exposure: np.ndarray) -> np.ndarray:
        """Return [n, T] how much brighter than its level [N] a point [n] is beside an object; 0 where none is near."""
        beside = self.flags[points] & SEEN_ALONE == IS_SEEN
        return np.where(beside, self.of(points) - exposure - level[points, None], 0)

    def darkest(self, level: np.ndarray, exposure: np.ndarray) -> np.ndarray:
        """Return [N] the least shade of each point."""
        return np.concatenate([self.shade(some, level, exposure).min(1) for some in self._split(np.arange(len(self.flags)))])

    def _split(self, points: np.ndarray) -> list[np.ndarray]:
        return np.split(points, range(self.at_a_time, len(points), self.at_a_time))


def _look_beside_objects(
    model: SceneModel, points: np.ndarray, cameras: Sequence[Camera], times: Sequence[float], masks: Sequence[np.ndarray]
) -> np.ndarray:
    """Find where points [N, 3] of the still scene are seen in frames, are near no object, are at a jump of depth.

    Returns:
        [N, T] uint8, of ``IS_SEEN``, ``IS_FAR`` and ``IS_AT_EDGE``.
    """
    background, objects = model.part("background"), model.part("objects")

    def look(k: int) -> np.ndarray:
        camera = cameras[k].resize(max(cameras[k].width // 2, 1), max(cameras[k].height // 2, 1))
        still = background.render(camera, times[k])
        mask = cv2.resize(masks[k], (camera.width, camera.height), interpolation=cv2.INTER_NEAREST)
        hidden = (objects.render(camera, times[k]).alpha >= _MIN_ALPHA) | (cv2.dilate(mask, np.ones((3, 3), np.uint8)) > 0)
        surface = cv2.dilate(np.where(still.alpha >= _MIN_ALPHA, still.depth, 0).astype(np.float32), np.ones((3, 3), np.uint8))
        surface = np.where(hidden, 0, surface)
        # Inverse depth is linear in the image on a plane, however slanted.
        inverse = 1 / np.maximum(still.depth, 1e-9)
        jumps = np.abs(inverse - cv2.blur(inverse, (5, 5))) > MAX_DEPTH_JUMP * inverse
        jumps = cv2.dilate(jumps.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        beside = np.zeros(mask.shape, bool)
        for number in np.unique(mask[mask > 0]):
            own = (mask == number).astype(np.uint8)
            beside |= cv2.distanceTransform(1 - own, cv2.DIST_L2, 3) <= NEAR_OBJECT_SIZES * math.sqrt(own.sum())
        pixels, depth = camera.project(points)
        column, row = np.floor(np.nan_to_num(pixels, nan=-1)).astype(int).T
        inside = (depth > 0) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
        saw = depth[inside] <= (1 + _SURFACE_TOLERANCE) * surface[row[inside], column[inside]]
        near, edge = (values[row[inside], column[inside]] for values in (beside, jumps))
        flags = np.full(len(points), IS_FAR, np.uint8)
        flags[inside] = saw * np.uint8(IS_SEEN) | ~near * np.uint8(IS_FAR) | edge * np.uint8(IS_AT_EDGE)
        return flags

    found = np.zeros((len(points), len(cameras)), np.uint8)
    for k, flags in enumerate(in_threads(look, list(range(len(cameras))), at_once(model))):
        found[:, k] = flags
    return found


def _quantile(values: np.ndarray, chosen: np.ndarray, share: float) -> np.ndarray:
    """Return the quantile [N] of the chosen ones of values [N, T]; of each at least one is."""
    ordered = np.sort(np.where(chosen, values, np.inf), 1)
    index = np.floor(share * (chosen.sum(1) - 1) + 0.5).astype(int)
    return np.take_along_axis(ordered, index[:, None], 1)[:, 0]


def _exposure(values: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Return the median [T] of the chosen ones of values [N, T] in every frame; 0 where there are hardly any."""
    found = np.zeros(values.shape[1], np.float32)
    for k in range(len(found)):
        if chosen[:, k].sum() >= 50:
            found[k] = np.median(values[chosen[:, k], k])
    return found


def _fit(target: np.ndarray, weight: np.ndarray, cosines: torch.Tensor) -> torch.Tensor:
    """Return a constant and gains [N, 1 + G] whose curves are nearest to ``target`` [N, T], by its ``weight``.

    Args:
        cosines: [T, G] cos(pi k t) of k = 1 ... G.
    """
    T, G = cosines.shape
    A = torch.cat([torch.ones(T, 1, dtype=torch.float64), cosines], 1)
    # 2 cos(k x) cos(l x) = cos((k + l) x) + cos((k - l) x): normal equations follow from the sums of 2 G cosines. Summed over
    # products they would cost frames x gains^2 of each Gaussian, and gains grow with the frames.
    angles = torch.arccos(cosines[:, :1].clamp(-1, 1)) if G else torch.zeros(T, 1, dtype=torch.float64)
    twice = torch.cos(angles * torch.arange(2 * G + 1))
    k = torch.arange(G + 1)
    above, below = k[:, None] + k, (k[:, None] - k).abs()
    held = GAIN_STIFFNESS * T * torch.diag(torch.cat([torch.zeros(1), torch.arange(1.0, G + 1)]).double())
    held += 1e-9 * torch.eye(G + 1, dtype=torch.float64)
    parts, rows = [], max(min(_ROWS_AT_A_TIME, _NUMBERS_AT_A_TIME // A.numel()), 1)
    for start in range(0, len(target), rows):
        w, b = torch.from_numpy(weight[start : start + rows]), torch.from_numpy(target[start : start + rows])
        sums = w @ twice
        normal = (sums[:, above] + sums[:, below]) / 2 + held
        parts.append(torch.cholesky_solve(((w * b) @ A)[..., None], torch.linalg.cholesky(normal))[..., 0])
    return torch.cat(parts)
