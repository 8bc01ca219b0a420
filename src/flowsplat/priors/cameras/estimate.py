"""Choose the camera model that the tracks support (moving, turning, standing still), and find the best cameras of that kind."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import cv2
import numpy as np

from flowsplat.common.progress import progress_bar
from flowsplat.priors.cameras.averaging import start_by_averaging
from flowsplat.priors.cameras.bundle import LensPrior, Reconstruction
from flowsplat.priors.cameras.growth import grow, ray_angles
from flowsplat.priors.cameras.keyframes import MAX_SEARCH_GAP, MAX_SEARCHED_FRAMES, between, choose_keyframes, place_between
from flowsplat.priors.cameras.observations import Observations
from flowsplat.priors.cameras.pieces import MIN_TRACKS
from flowsplat.priors.cameras.refinement import Refined, misfit, refine, track_errors, with_points
from flowsplat.priors.cameras.selection import choose_tracks, mostly_on_rim, on_rim
from flowsplat.priors.cameras.twoview import MIN_COMMON_TRACKS, chain_rotations, rank_pairs

USUAL_FOCAL = 0.9
"""Focal length over width that is expected before looking: about 58 degrees across. Chosen by eye."""
START_FOCALS = (0.9, 0.6, 1.5)
"""Focal lengths over width from which the search starts. Chosen by eye."""
MAX_SUCCESSES = 3
"""Complete reconstructions after which the search ends. Chosen by eye."""
SIMPLER_MISFIT_RATIO = 1.5
"""A simpler kind of motion is believed unless a richer one lowers the misfit by more than this factor
(docs/method/cameras.md)."""
NEGLIGIBLE_MISFIT = 0.04
"""A misfit that errors of a tenth of a pixel cause: below it no richer motion is tried."""
FOCAL_TOLERANCE = 0.005
"""Two complete reconstructions whose focal lengths differ by less than this fraction are taken for the same. Chosen by eye."""
MAX_STARTS = 15
"""Attempts at a reconstruction, whatever comes of them. Chosen by eye."""
MIN_STILL_RIM = 0.5
"""Share of what is seen along the image's rim that must stand still; below it the cameras follow something in front.
Chosen by eye."""
MAX_STATIC_ERROR = 0.5
"""Pixels by which a track may miss its point and still stand still, or four times the median error where that is more.
Chosen by eye."""
MIN_HOMOGRAPHY_SHARE = 0.97
"""Share of static tracks that one homography must explain in a scene without depth variation. Chosen by eye."""
MAX_JUDGES = 4000
"""About how many tracks decide between kinds of motion, at most. Chosen by eye."""


@dataclass(frozen=True)
class CameraEstimate:
    """Cameras for all frames.

    Attributes:
        motion: ``free``, ``rotation`` (it only turns), ``static``, or ``unknown`` where nothing could be followed.
        fit: the cameras with what speaks for them.
        unplaced: frames that saw too few tracks; their poses are interpolated.
        flat: whether all that stands still lies on one plane.
        surrounds: whether the cameras follow the rim of the image and most of it moves against them.
        parallax: radians between the first and the last ray to a static point, the median of the longer half of tracks.
    """

    motion: str
    fit: Refined
    unplaced: list[int]
    parallax: float
    flat: bool = False
    surrounds: bool = False


def estimate(seen: Observations, width: float, height: float, focal: float | None, solver: str = "own") -> CameraEstimate:
    """Find the cameras behind the tracks of one piece of a clip.

    What most tracks agree on is taken for the static scene, unless it leaves the rim of the image to something else:
    an object may fill most of the frames, but rarely hides what is round it.

    Args:
        seen: in pixels of the frames.
        focal: pixels, where it is known.
        solver: how cameras that move begin, ``own`` (frame after frame) or ``global`` (all at once).
    """
    found = _of_all_frames(seen, width, height, focal, solver)
    if found.motion == "unknown":
        return found
    follows = _follows(found, seen, width, height)
    rim = seen.point[on_rim(seen, width, height)]
    if _share(follows, rim) >= MIN_STILL_RIM or (~follows).sum() < MIN_TRACKS:
        return found
    other = _of_all_frames(seen.of_points(~follows), width, height, focal, solver)
    if other.motion == "unknown":
        return found
    better = _share(_follows(other, seen, width, height), rim) > max(MIN_STILL_RIM, _share(follows, rim))
    return replace(other, surrounds=True) if better else found


def estimate_static(seen: Observations, width: float, height: float, focal: float | None) -> CameraEstimate:
    """Return cameras that stand still, whatever the tracks say; for the arguments see ``estimate``."""
    standing = _solve_standing(seen.from_middle(width, height), focal or USUAL_FOCAL * width)
    surrounds = 2 * int(seen.counts[standing.static].sum()) < len(seen)
    return CameraEstimate("static", standing, [], 0.0, surrounds=surrounds)


def _share(follows: np.ndarray, rim: np.ndarray) -> float:
    """Return the share of the observations on the rim, of tracks ``rim`` [K], that belong to the tracks [N] bool."""
    return float(follows[rim].sum() / max(len(rim), 1))


def _follows(found: CameraEstimate, seen: Observations, width: float, height: float) -> np.ndarray:
    """Return [N] the tracks that stand still under the cameras that were found."""
    centered = seen.from_middle(width, height)
    state = with_points(found.fit.state, centered, free_translations=found.motion == "free")
    limit = max(MAX_STATIC_ERROR, 4 * float(np.median(found.fit.errors)))
    return (track_errors(state, centered) < limit) & (seen.counts >= 2)


def _of_all_frames(seen: Observations, width: float, height: float, focal: float | None, solver: str) -> CameraEstimate:
    """Return the cameras most tracks agree on; those of a long clip by way of its keyframes."""
    keys = choose_keyframes(seen)
    if len(keys) == seen.cameras:
        return _of_keyframes(seen, width, height, focal, solver, consecutive=True)
    found = _of_keyframes(seen.of_cameras(keys), width, height, focal, solver)
    fit = replace(found.fit, frames=keys[found.fit.frames])
    if found.motion in ("static", "unknown"):
        count = seen.cameras
        state = replace(fit.state, rotations=np.tile(np.eye(3), (count, 1, 1)), translations=np.zeros((count, 3)))
        return replace(found, fit=replace(fit, state=state))
    centered = seen.from_middle(width, height)
    state, lost = place_between(keys, fit.state, centered, free_translations=found.motion == "free")
    state = replace(state, points=fit.state.points)
    return replace(found, fit=replace(fit, state=state), unplaced=sorted(keys[found.unplaced].tolist() + lost))


def _of_keyframes(
    seen: Observations, width: float, height: float, focal: float | None, solver: str, consecutive: bool = False
) -> CameraEstimate:
    centered = seen.from_middle(width, height)
    few = choose_tracks(seen, width, height, per_cell=4, shortest=2)
    expected, free_focal = focal or USUAL_FOCAL * width, focal is None
    tracks = centered.of_points(few)
    standing = _solve_standing(centered, expected)
    if len(few) < MIN_TRACKS:
        return CameraEstimate("unknown", standing, [], 0.0)
    judges = _judges(seen)

    def judged(kind: str, state: Reconstruction, judges: np.ndarray = judges) -> float:
        return misfit(state, centered.of_points(judges), free_translations=kind == "free")

    rests = judged("static", standing.state) <= NEGLIGIBLE_MISFIT
    if not rests:
        rim = judges[mostly_on_rim(seen.of_points(judges), width, height)]
        surrounds = len(rim) >= MIN_TRACKS and judged("static", standing.state, rim) <= NEGLIGIBLE_MISFIT
    if rests or surrounds:
        return CameraEstimate("static", standing, [], 0.0, surrounds=not rests)
    starts = {"static": _Candidate(misfit(standing.state, tracks, free_translations=False), standing.state, [], 0)}
    keys = choose_keyframes(tracks, MAX_SEARCHED_FRAMES, MAX_SEARCH_GAP)
    some = tracks.of_cameras(keys)
    some = some.of_points(some.counts >= 2)
    turning = _solve_turning(some, expected, free_focal)
    starts["rotation"] = _on_all_frames(turning, "rotation", keys, tracks)
    if turning.misfit > NEGLIGIBLE_MISFIT:
        if solver == "global":
            moving = _search_at_once(some, width, expected, free_focal) or turning
        else:
            moving = _search(some, width, expected, free_focal, turning.state)
        starts["free"] = _on_all_frames(moving, "free", keys, tracks)
    costs = {kind: judged(kind, start.state) + NEGLIGIBLE_MISFIT for kind, start in starts.items()}
    motion = next(kind for kind, cost in costs.items() if cost <= SIMPLER_MISFIT_RATIO * min(costs.values()))
    start = starts[motion]
    if motion == "static":
        return CameraEstimate("static", standing, [], 0.0)
    more = choose_tracks(seen, width, height, per_cell=20)
    many = centered.of_points(more if len(more) > len(few) else few)
    fit = refine(
        start.state, many, fixed_camera=start.origin, expected_focal=expected,
        free_focal=free_focal, free_translations=motion == "free", consecutive=consecutive,
    )  # fmt: skip
    parallax = _parallax(fit, many.seen) if motion == "free" else 0.0
    flat = motion == "free" and _is_flat(fit, many)
    return CameraEstimate(motion, fit, start.unplaced, parallax, flat)


def _judges(seen: Observations) -> np.ndarray:
    """Return indices of the tracks by which kinds of motion are compared: every one counts by the area and time it was seen in.

    The tracks that a reconstruction is grown from prefer what sweeps over the image, and with a point near enough for
    every track of an object, a camera that hardly moves can explain anything that travels straight. Here what rests
    outvotes it.
    """
    longer = np.flatnonzero(seen.counts >= min(3, seen.cameras))
    return longer[:: max(1, len(longer) // MAX_JUDGES)]


def _parallax(fit: Refined, seen: np.ndarray) -> float:
    lengths = seen.sum(1) * fit.static
    longer = np.flatnonzero(lengths >= max(2, np.median(lengths[fit.static])))
    return float(np.median(ray_angles(fit.state, fit.state.points[longer], seen[longer])))


def _is_flat(fit: Refined, tracks: Observations) -> bool:
    """Return whether one homography explains what two distant frames share, whichever frame comes first.

    Told by the images and not by the points: without depth variation the focal length may be far off, and the points bent.
    """
    limit = max(MAX_STATIC_ERROR, 4 * float(np.median(fit.errors)))
    count, seen, centered = tracks.cameras, tracks.seen, tracks.dense()
    judged = False
    for i in sorted({0, count // 3, 2 * count // 3}):
        common = (seen[:, i] & fit.static) @ seen[:, i + 1 :].astype(int)
        enough = np.flatnonzero(common >= max(MIN_COMMON_TRACKS, 0.5 * (seen[:, i] & fit.static).sum()))
        if len(enough):
            both = seen[:, i] & seen[:, i + 1 + enough[-1]] & fit.static
            _, fits = cv2.findHomography(centered[both, i], centered[both, i + 1 + enough[-1]], cv2.RANSAC, limit)
            judged = True
            if fits is None or fits.mean() < MIN_HOMOGRAPHY_SHARE:
                return False
    return judged


def _solve_standing(seen: Observations, focal: float) -> Refined:
    """Return all cameras at the origin, every track at its mean position; static are those that hardly leave it."""
    count = seen.cameras
    state = Reconstruction(np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)), focal, np.zeros((seen.points, 3)))
    sums = np.stack([np.bincount(seen.point, seen.uv[:, k], seen.points) for k in range(2)], 1)
    distance = np.linalg.norm(seen.uv - (sums / np.maximum(seen.counts, 1)[:, None])[seen.point], axis=-1)
    farthest = np.zeros(seen.points)
    np.maximum.at(farthest, seen.point, distance)
    static = (farthest < MAX_STATIC_ERROR) & (seen.counts >= 2)
    resting = static[seen.point]
    errors = distance[resting] if resting.any() else np.zeros(1)
    frames = seen.camera[resting] if resting.any() else np.zeros(1, int)
    return Refined(state, static, errors, frames, float("inf"))


@dataclass(frozen=True)
class _Candidate:
    """One of several reconstructions: how badly it fits, the cameras, frames without a place, and the fixed frame."""

    misfit: float
    state: Reconstruction
    unplaced: list[int]
    origin: int


def _solve_turning(seen: Observations, expected: float, free_focal: bool) -> _Candidate:
    """Return cameras in one place that only turn."""
    rotations = chain_rotations(seen.dense(0.0), seen.seen, expected)
    state = Reconstruction(rotations, np.zeros((seen.cameras, 3)), expected, np.zeros((seen.points, 3)))
    fit = refine(
        state, seen, fixed_camera=0, expected_focal=expected, free_focal=free_focal, free_translations=False, rough=True,
    )  # fmt: skip
    return _Candidate(misfit(fit.state, seen, free_translations=False), fit.state, [], 0)


def _search(seen: Observations, width: float, expected: float, free_focal: bool, turning: Reconstruction) -> _Candidate:
    """Return the best of several reconstructions from different pairs of frames and focal lengths.

    A narrow and a wide lens can explain a distant, shallow scene almost equally well from one start; which is right
    shows only after each was adjusted, so several are. One starts from the cameras that only turn, with all points at
    the same distance: where the camera hardly leaves its place, no pair of frames has parallax to start from.
    """
    focals = [factor * width for factor in START_FOCALS] if free_focal else [expected]
    known = partial(refine, expected_focal=expected, free_focal=free_focal, rough=True)
    on_sphere = with_points(turning, seen, free_translations=False)
    fit = known(on_sphere, seen, fixed_camera=0, keep_points=True)
    found = [_Candidate(misfit(fit.state, seen), fit.state, [], 0)]
    centered, views = seen.dense(0.0), seen.seen
    starts = list(product(rank_pairs(centered, views, expected), focals))[:MAX_STARTS]
    prior = LensPrior(expected, 20.0) if free_focal else None
    grown: list[float] = []
    with progress_bar("Camera search", len(starts)) as bar:
        for pair, focal in starts:
            bar.advance()
            model = grow(centered, views, pair, focal, prior=prior, free_focal=free_focal)
            if model is not None and model.solid.sum() >= 0.3 * seen.points:
                if model.placed.all():
                    again = any(abs(np.log(model.state.focal / other)) < FOCAL_TOLERANCE for other in grown)
                    grown.append(model.state.focal)
                if not (model.placed.all() and again):
                    found.append(_candidate(model.state, model.placed, model.origin, seen, known))
                if len(grown) >= MAX_SUCCESSES:
                    break
    return min(found, key=lambda candidate: candidate.misfit)


def _search_at_once(seen: Observations, width: float, expected: float, free_focal: bool) -> _Candidate | None:
    """Return the best of the reconstructions that place all frames at once, each from another focal length; None where none can."""
    known = partial(refine, expected_focal=expected, free_focal=free_focal, rough=True)
    focals = [factor * width for factor in START_FOCALS] if free_focal else [expected]
    found = []
    with progress_bar("Camera search, all frames at once", len(focals)) as bar:
        for focal in focals:
            bar.advance()
            start = start_by_averaging(seen.dense(0.0), seen.seen, focal)
            if start is not None:
                state, reached = start
                found.append(_candidate(state, reached, int(reached.argmax()), seen, known))
    return min(found, key=lambda candidate: candidate.misfit) if found else None


def _candidate(
    state: Reconstruction, placed: np.ndarray, origin: int, seen: Observations, refined: Callable[..., Refined]
) -> _Candidate:
    """Return the reconstruction after a refinement of all frames, those that were not ``placed`` [T] included."""
    fit = refined(_with_all_frames(state, placed), seen, fixed_camera=origin)
    return _Candidate(misfit(fit.state, seen), fit.state, np.flatnonzero(~placed).tolist(), origin)


def _with_all_frames(state: Reconstruction, placed: np.ndarray) -> Reconstruction:
    """Poses of frames that were not placed, interpolated between those that were."""
    if placed.all():
        return state
    viewmats = between(np.flatnonzero(placed), state.rotations[placed], state.translations[placed], len(placed))
    return replace(state, rotations=viewmats[:, :3, :3], translations=viewmats[:, :3, 3])


def _on_all_frames(start: _Candidate, kind: str, keys: np.ndarray, seen: Observations) -> _Candidate:
    """Return a start that was found on keyframes, with poses for all frames."""
    if len(keys) == seen.cameras:
        return start
    state, lost = place_between(keys, start.state, seen, free_translations=kind == "free")
    return _Candidate(start.misfit, state, sorted(keys[start.unplaced].tolist() + lost), int(keys[start.origin]))
