"""Estimate how the distance of an object changes over time, but for a constant: by the motion of its points or by its size in the
images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from flowsplat.geometry import Camera
from flowsplat.priors.background.ground import Ground
from flowsplat.priors.objects.contact import upright_ratio
from flowsplat.priors.objects.contact_cues import MAX_BOUND_RANGE, Feet
from flowsplat.priors.objects.distance import Cue
from flowsplat.priors.objects.path import Law, WorldPath, constant_height, pivot
from flowsplat.priors.objects.rematching import ObjectImages, rematch_object
from flowsplat.priors.objects.rigid import RigidSolution, TrackObservations, longest, solve_rigid
from flowsplat.priors.objects.shape_offset import ShapePoints, place_points

MIN_TRACKS, MIN_FRAMES = 16, 10
"""Tracks on an object, and frames with any, below which no motion is solved. Chosen by eye."""
MAX_SPLIT_HALF_SIGMA = 0.04
"""Standard deviation over time between ln z of two solutions from halves of the tracks, above which none is believed. Chosen on
random worlds of seeds 0 to 14 (docs/notebook/2026-11.md)."""
MIN_INLIER_SHARE = 0.7
"""Share of the observations that must lie within ``rigid.INLIER_PIXELS`` of the solution. Chosen on random worlds of seeds 0 to
14 (docs/notebook/2026-11.md)."""
MIN_RIGID_SHARE = 0.85
"""Share of all observations on an object that its motion explains from which it does not bend, so that its points have one shape.
Walkers have 68 to 82 %, what is rigid 87 to 98 (docs/method/objects.md)."""
TRACKS_PER_FRAME = (50, 180)
"""Tracks in a frame that the motion is solved from, the longest first; half of them for either half. Both are tried
(docs/method/objects.md)."""
MIN_LAW_SIGMA = {"pivot": 0.04, "height": 0.03}
"""Standard deviation of ln distance that a law of motion leaves at least: pivots of three scenes were off by .003 to .062."""
LAW_ERROR_RATE = {"pivot": 0.05, "height": 0.05}
"""Chance that it has nothing to do with the truth."""
MAX_PIVOT_REST, MIN_PIVOT_TURN = 0.2, 30.0
"""How far a pivot may move, as a share of what its body travels, and degrees that the body must turn: pendulums of four scenes have
.03 to .08, what only looks like one .25 and more (docs/notebook/2026-11.md, "Masks of what moves")."""
MIN_CONTRADICTION_SIGMA = 0.15
"""Standard deviation over time between ln z by motion and by growth from which the ground decides which of them is right
(docs/method/objects.md)."""


@dataclass(frozen=True)
class ObjectTracks:
    """What is seen of one object in the T training frames.

    Attributes:
        positions: [N, T, 2] pixels of its tracks, where ``inside`` [N, T].
        middles: [T, 2] its middle pixels, NaN where it is not seen.
        cameras: [T].
        normal: [3] up.
    """

    positions: np.ndarray
    inside: np.ndarray
    middles: np.ndarray
    cameras: Sequence[Camera]
    normal: np.ndarray

    @property
    def K(self) -> np.ndarray:
        """[3, 3] of all cameras."""
        return self.cameras[0].K


class PlacedMotion(NamedTuple):
    """A motion of an object's own, as a depth trajectory.

    ``log_depth`` [T]: logarithm of the depth of its middle, but for its distance; ``points``: of it; ``share``: of all observations
    on it that the motion explains.
    """

    log_depth: np.ndarray
    points: ShapePoints
    share: float


@dataclass(frozen=True)
class DepthTrajectory:
    """How an object goes.

    Attributes:
        log_depth: [T] logarithm of the depth of its middle, but for a constant; NaN where it is not seen.
        motion: that all of this is by; None: the depth trajectory is by its size, or by a motion that explains only part of it.
        points: depth of points on it, with the same constant; none of what bends.
        path: of the motion, in the world; None where there is none or its poses are not known well enough.
        cues: what laws of motion say about the constant.
        share: of all observations on it that the motion explains.
    """

    log_depth: np.ndarray
    motion: RigidSolution | None
    points: ShapePoints
    path: WorldPath | None
    cues: dict[str, Cue]
    share: float = 0.0

    @property
    def bends(self) -> bool:
        """Whether its motion is not known or does not explain all of it."""
        return self.share < MIN_RIGID_SHARE


def solve_depth_trajectory(
    tracks: ObjectTracks, log_billboards: np.ndarray, feet: Feet, ground: Ground | None, images: ObjectImages | None
) -> DepthTrajectory:
    """Return the depth trajectory of one object.

    Args:
        log_billboards: [T] logarithm of the depth of its billboard, NaN where it is not seen: the depth trajectory where no
            motion is believed.
        images: to match its points anew in; None: tracks are all there is.
    """
    seen = np.isfinite(log_billboards) & np.isfinite(tracks.middles).all(1)
    by_growth = np.where(seen, log_billboards - np.mean(log_billboards[seen]), np.nan)
    motion, motions = rigid_motions(tracks.positions, tracks.inside, tracks.K)
    placed = None if motion is None else place_motion(motion, tracks)
    if motion is not None and placed is not None and images is not None:
        motion, placed = _refine(motion, placed, tracks, seen, images)
    contradicted = placed is not None and float(np.nanstd(placed.log_depth - by_growth)) > MIN_CONTRADICTION_SIGMA
    if placed is not None and contradicted and feet.unevenness(by_growth) <= MAX_BOUND_RANGE < feet.unevenness(placed.log_depth):
        placed = None
    if motion is None or placed is None:
        return DepthTrajectory(_weak_depth_trajectory(motions, tracks, by_growth, seen, feet), None, ShapePoints.none(), None, {})
    try:
        path = WorldPath.of(motion, tracks.cameras)
        cues = check_laws(path, ground.normal if ground else None)[0]
    except np.linalg.LinAlgError:
        cues, path = {}, None  # Poses that the tracks hardly tell have no covariance: then no law does either.
    # Limbs of what bends are placed wrongly.
    points = placed.points if placed.share >= MIN_RIGID_SHARE else ShapePoints.none()
    return DepthTrajectory(np.where(seen, placed.log_depth, np.nan), motion, points, path, cues, placed.share)


def _refine(
    motion: RigidSolution, placed: PlacedMotion, tracks: ObjectTracks, seen: np.ndarray, images: ObjectImages
) -> tuple[RigidSolution, PlacedMotion]:
    """Return the motion by points that are matched anew in the images, where that is of the same body; else the same as before."""
    again = rematch_object(motion, tracks.positions, tracks.inside, images)
    if again is None:
        return motion, placed
    refined, matched, counts = again
    every, used = np.concatenate([matched, tracks.positions]), np.concatenate([counts, tracks.inside])
    surer = place_motion(refined, replace(tracks, positions=every, inside=used))
    # Two solutions that differ by more than two halves of the tracks may are not of one body.
    if surer is None or not float(np.std((surer.log_depth - placed.log_depth)[seen])) <= MAX_SPLIT_HALF_SIGMA:
        return motion, placed
    # Points that were chosen because they match say nothing of how much of it bends.
    return refined, surer._replace(share=placed.share)


def _weak_depth_trajectory(
    motions: Sequence[RigidSolution], tracks: ObjectTracks, by_growth: np.ndarray, seen: np.ndarray, feet: Feet
) -> np.ndarray:
    """Return [T] the depth trajectory of what bends: by its growth, or by a motion that explains part of it, if only by that its
    feet keep to the ground."""
    for weak in motions if feet.unevenness(by_growth) > MAX_BOUND_RANGE else []:
        placed = place_motion(weak, tracks)
        if placed is not None and feet.unevenness(placed.log_depth) <= MAX_BOUND_RANGE:
            return np.where(seen, placed.log_depth, np.nan)
    return by_growth


def rigid_motions(positions: np.ndarray, inside: np.ndarray, K: np.ndarray) -> tuple[RigidSolution | None, list[RigidSolution]]:
    """Return the motion of an object from its tracks, if both halves of them tell the same, else None; and all that was found."""
    if len(inside) < MIN_TRACKS or inside.any(0).sum() < MIN_FRAMES:
        return None, []

    def solved(rows: np.ndarray, most: int) -> RigidSolution | None:
        chosen = rows[longest(inside[rows], most)]
        return solve_rigid(TrackObservations.of_tracks(positions[chosen], inside[chosen], K).in_pieces())

    def halves_agree(order: np.ndarray, most: int) -> bool:
        """Whether two halves of the tracks, every second one of ``order``, tell the same motion."""
        halves = [solved(np.sort(order[start::2]), most // 2) for start in (0, 1)]
        if halves[0] is None or halves[1] is None:
            return False
        differences = halves[0].log_depths() - halves[1].log_depths()
        known = np.isfinite(differences)
        return bool(known.sum() >= MIN_FRAMES and float(np.std(differences[known])) <= MAX_SPLIT_HALF_SIGMA)

    every = np.arange(len(inside))
    orders = [every, *(np.random.default_rng(seed).permutation(every) for seed in range(2))]
    found = [(whole, most) for most in TRACKS_PER_FRAME if (whole := solved(every, most)) is not None]
    motions = [whole for whole, _ in found]
    # More tracks make a rigid body surer. In what bends they are limbs that move on their own, and disagree.
    for whole, most in sorted(found, key=lambda each: each[0].noise):
        if whole.inliers < MIN_INLIER_SHARE:
            continue
        # One way to halve the tracks may be bad luck, so that two of three decide (docs/method/objects.md).
        told = [halves_agree(order, most) for order in orders[:2]]
        if told[0] != told[1]:
            told.append(halves_agree(orders[2], most))
        if sum(told) >= 2:
            return whole, motions
    return None, motions


def check_laws(path: WorldPath, normal: np.ndarray | None) -> tuple[dict[str, Cue], dict[str, Law]]:
    """Return the laws of motion that pass their gates, as cues; and what every law said."""
    laws: dict[str, Law] = {"pivot": pivot(path)}
    if normal is not None:
        laws["height"] = constant_height(path, normal)
    p, passed = laws["pivot"], {}
    passed["pivot"] = p.measures["rest"] <= MAX_PIVOT_REST and p.measures["turned"] >= MIN_PIVOT_TURN
    passed["height"] = "height" in laws and laws["height"].measures["explained"] >= 0.3
    cues = {
        name: Cue(-float(np.log(law.nearness)), float(np.hypot(law.sigma, MIN_LAW_SIGMA[name])), LAW_ERROR_RATE[name])
        for name, law in laws.items()
        if law.usable and law.holds and passed[name]
    }
    return cues, laws


def place_motion(motion: RigidSolution, tracks: ObjectTracks) -> PlacedMotion | None:
    """Return the depth trajectory by a motion of an object's own; None where it tells of no frame."""
    points, share = place_points(motion, TrackObservations.of_tracks(tracks.positions, tracks.inside, tracks.K), tracks.K)
    found = middle_depths(points, tracks.middles, tracks.cameras, tracks.normal)
    known = np.isfinite(found)
    if not known.any():
        return None
    return PlacedMotion(np.interp(np.arange(len(tracks.cameras)), np.flatnonzero(known), found[known]), points, share)


def middle_depths(points: ShapePoints, middles: np.ndarray, cameras: Sequence[Camera], normal: np.ndarray) -> np.ndarray:
    """Return [T] logarithm of the depth of an object's middle: of an upright billboard through its points; NaN of fewer than
    three."""
    result = np.full(len(cameras), np.nan)
    for t in range(len(cameras)):
        here = points.frame_of == t
        if here.sum() >= 3 and np.isfinite(middles[t]).all():
            billboard = np.log(upright_ratio(cameras[t], normal, middles[t], points.pixels[here]))
            result[t] = np.median(points.log_depth[here] - billboard)
    return result
