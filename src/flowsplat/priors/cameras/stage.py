"""The camera stage: frames in, one camera for every frame and a plain verdict out."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import cv2
import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.geometry import Camera
from flowsplat.geometry.cameras import rigid
from flowsplat.geometry.lens import Lens
from flowsplat.priors.cameras.checks import Gaps, verdict
from flowsplat.priors.cameras.estimate import CameraEstimate
from flowsplat.priors.cameras.following import WORKING_SIDE, follow_points
from flowsplat.priors.cameras.lens import find_lens
from flowsplat.priors.cameras.observations import Observations
from flowsplat.priors.cameras.pieces import find_breaks, join, split
from flowsplat.priors.cameras.solvers import Solved, solve
from flowsplat.priors.cameras.still import stands_still
from flowsplat.priors.cameras.straightening import describe_lens, require_lens_in_images, resume_straightening
from flowsplat.scenes import Scene
from flowsplat.scenes.overlay import look_up_mask

LENS_ROUNDS = 2
"""How often the lens is estimated, each time with the cameras that the one before allowed. Chosen by eye."""
MAX_LENS_CHANGE = 0.1
"""Pixels of the border by which a lens may change and count as found. Chosen by eye."""
WITHOUT_LENS = "leave out --cameras.distortion radial"
"""What an error advises where a lens cannot be taken out."""
NO_LENS = "No distortion of the lens shows: the images stay as they are."
OWN = "tracks"
"""Method of cameras that this stage computed."""
MAX_FOCAL = 100
"""Focal length at most, in longer sides of the image: an angle of view of half a degree. Chosen by eye."""


@dataclass(frozen=True)
class CameraOptions:
    """How the cameras are estimated.

    Attributes:
        focal: focal length in pixels of the prepared frames, where it is known; otherwise it is estimated.
        solver: how a reconstruction begins: own (from two frames to all of them), global (all frames at once), or auto (the
            first, and where its cameras look bad the second too, of which the better is taken).
        distortion: none (a pinhole), or radial: one coefficient is estimated for the clip, and the frames and given masks of
            the scene are replaced by straightened ones.
    """

    focal: float | None = None
    solver: Literal["auto", "own", "global"] = "auto"
    distortion: Literal["none", "radial"] = "none"


def camera_stage(scene: Scene, options: CameraOptions) -> None:
    """Estimate a pose for every frame and one focal length, and write them to ``scene``.

    The principal point is taken to be the center of the image and pixels to be square. Held-out frames are seen here
    (docs/method/evaluation.md), but nothing other than their poses and their lens leaves this stage. The first camera
    is the identity and the
    median distance of the points is 1. Pieces that nothing joins (there is a cut between them) are solved one by one, each in
    these units, and set side by side so far apart that none sees the other: the path jumps there.

    Where the lens is to be straightened, the images are replaced last; stopped in between, the next call goes on there.

    Raises:
        InputError: the given focal length is not a positive number, or something was made for images that are to be
            straightened.
    """
    longest = MAX_FOCAL * max(scene.width, scene.height)
    if options.focal is not None and not 1 <= options.focal <= longest:
        raise InputError(f"The focal length is {options.focal}: give pixels from 1 to {longest:,}, or leave it out.")
    if scene.info.straightening is not None:
        resume_straightening(scene)
        return
    radial = straightens(scene, options)
    if radial:
        require_lens_in_images(scene, WITHOUT_LENS)
    tracks = _follow(scene)
    known = None if options.focal is None else options.focal / tracks.unit
    lens, solved = None, tracks.solve(options.solver, known)
    if radial:
        lens, solved = _find_lens(tracks, solved, options.solver, known)
    parts = [_cameras(each.found, tracks.unit, scene.width, scene.height) for each in solved]
    scene.write_cameras(join(tracks.pieces, parts, scene.num_frames))
    about = (describe_lens(lens.scale(tracks.unit)) if lens else NO_LENS) if radial else ""
    prior = _description(scene, options, tracks, solved, lens, about)
    if lens is None:
        scene.finish_prior("cameras", **prior)
        return
    scene.begin_straightening(lens.scale(tracks.unit).to_json(), prior)
    resume_straightening(scene)


def straightens(scene: Scene, options: CameraOptions) -> bool:
    """Return whether these options have a lens taken out of the images: it was not taken out before."""
    return options.distortion == "radial" and scene.info.lens is None


@dataclass(frozen=True)
class _Tracks:
    """What was followed.

    Attributes:
        seen: in pixels of the working size.
        pieces: the frames of every piece.
        still: of every piece, whether its images say that the camera stands still.
        blank: frames in which nothing can be followed.
        width: of the images, in pixels of the working size; ``height`` alike.
        unit: pixels of the prepared frames in one of the working size. Thresholds are in pixels of the latter.
    """

    seen: Observations
    pieces: list[list[int]]
    still: list[bool]
    blank: list[int]
    width: float
    height: float
    unit: float

    @property
    def longest(self) -> int:
        """Which piece has the most frames."""
        return int(np.argmax([len(frames) for frames in self.pieces]))

    def of_piece(self, number: int) -> Observations:
        """Return the tracks that were seen more than once in a piece."""
        seen = self.seen.of_cameras(np.array(self.pieces[number]))
        return seen.of_points(seen.counts >= min(2, seen.cameras))

    def solve(self, solver: str, focal: float | None, lens: Lens | None = None) -> list[Solved]:
        """Return the cameras of every piece, once the lens is taken out."""
        if lens is not None:
            straight = replace(self, seen=self.seen.at(lens.straighten_positions(self.seen.uv)))
            return straight.solve(solver, None if focal is None else focal * lens.zoom)
        return [
            solve(self.of_piece(k), self.width, self.height, focal, solver, frames, still)
            for k, (frames, still) in enumerate(zip(self.pieces, self.still, strict=True))
        ]


def _follow(scene: Scene) -> _Tracks:
    """Follow points through the clip, and cut it where nothing joins its frames."""
    unit = max(1.0, max(scene.width, scene.height) / WORKING_SIDE)
    followed, blank = follow_points(scene)
    overlay = scene.overlay
    if overlay is not None:
        followed = followed.where(~look_up_mask(overlay, followed.uv))
    shown = [t for t in range(scene.num_frames) if t not in set(blank)]
    pieces = split(shown, find_breaks(followed.at(followed.uv / unit), shown))
    resting = _off_objects(scene, followed)
    seen = resting.at(resting.uv / unit)
    if not pieces:
        pieces, seen = [list(range(scene.num_frames))], seen.of_points(np.zeros(0, int))
    still = [stands_still(scene, frames) for frames in pieces]
    return _Tracks(seen, pieces, still, blank, scene.width / unit, scene.height / unit, unit)


def _description(
    scene: Scene, options: CameraOptions, tracks: _Tracks, solved: list[Solved], lens: Lens | None, about_lens: str
) -> dict[str, Any]:
    """Return what is noted of the cameras in the scene: how they were found, how well they fit (errors in pixels), and a
    verdict."""
    unit, pieces, main = tracks.unit, tracks.pieces, solved[tracks.longest]
    found, fit = [each.found for each in solved], main.found.fit
    errors = np.concatenate([each.fit.errors for each in found]) * unit
    numbers = np.concatenate([np.array(frames)[each.fit.frames] for frames, each in zip(pieces, found, strict=True)])
    heldout = np.isin(numbers, scene.heldout_frames)
    unplaced = [frames[t] for frames, each in zip(pieces, found, strict=True) for t in each.unplaced]
    jumps = [t for each in solved for t in each.judgments[0].jumps]
    breaks = [frames[0] for frames in pieces[1:]]
    gaps = Gaps(unplaced, breaks, tracks.blank, jumps, scene.timestamps)
    given = options.focal is not None
    return {
        "method": OWN,
        "options": asdict(options),
        "solver": main.judgments[0].solver,
        "solvers": [judgment.to_json(unit) for judgment in main.judgments],
        "motion": main.found.motion,
        "static": len(pieces) == 1 and main.found.motion in ("static", "unknown"),
        "flat": main.found.flat,
        "surrounds": main.found.surrounds,
        "focal": round(fit.state.focal * unit, 3),
        "focal_given": given,
        "focal_sigma": round(fit.focal_sigma, 5) if np.isfinite(fit.focal_sigma) else None,
        "distortion": round(lens.distortion.coefficients[0], 6) if lens else 0.0,
        "parallax_degrees": round(float(np.degrees(main.found.parallax)), 3),
        "reprojection_px": round(float(np.median(errors)), 4),
        "reprojection_p90_px": round(float(np.quantile(errors, 0.9)), 4),
        "reprojection_heldout_px": round(float(np.median(errors[heldout])), 4) if heldout.any() else None,
        "tracks": sum(int(each.fit.static.sum()) for each in found),
        "unplaced": unplaced,
        "breaks": breaks,
        "blank": tracks.blank,
        "jumps": jumps,
        "verdict": verdict(main.found, unit, scene.width, given, gaps, [main.reason(unit), about_lens]),
    }


def _find_lens(tracks: _Tracks, solved: list[Solved], solver: str, focal: float | None) -> tuple[Lens | None, list[Solved]]:
    """Return the lens that the longest piece shows, and the cameras of all pieces behind it."""
    lens, seen = None, tracks.of_piece(tracks.longest)
    for _ in range(LENS_ROUNDS):
        new = find_lens(seen, tracks.width, tracks.height, focal, solved[tracks.longest].found, lens)
        if new is None or (lens is not None and abs(new.shift - lens.shift) < MAX_LENS_CHANGE):
            break
        lens, solved = new, tracks.solve(solver, focal, new)
    return lens, solved


def _off_objects(scene: Scene, tracks: Observations) -> Observations:
    """Without the tracks that touch the masks of moving objects, where there are masks."""
    if scene.prior("masks") is None:
        return tracks
    margin = max(3, round(0.01 * max(scene.width, scene.height)))
    kernel = np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)
    touches, rows = np.zeros(tracks.points, bool), tracks.by_camera()
    for t in scene.train_frames:
        mask = cv2.dilate((scene.mask(t) > 0).astype(np.uint8), kernel)
        here = rows[t]
        x, y = np.clip(tracks.uv[here].astype(int), 0, [scene.width - 1, scene.height - 1]).T
        touches[tracks.point[here[mask[y, x] > 0]]] = True
    enough = (~touches).sum() >= 0.1 * tracks.points
    return tracks.of_points(~touches) if enough else tracks


def _cameras(found: CameraEstimate, unit: float, width: int, height: int) -> list[Camera]:
    """Return one camera a frame: the first one the identity, the median distance of the static points 1."""
    state, fit = found.fit.state, found.fit
    distance = 1.0
    if found.motion == "free":
        distance = float(np.median(np.linalg.norm(state.points[fit.static] - state.centers[0], axis=1)))
    focal = state.focal * unit
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    cameras = []
    for rotation, center in zip(state.rotations, state.centers, strict=True):
        moved = -rotation @ (center - state.centers[0]) / distance
        cameras.append(Camera(rigid(rotation @ state.rotations[0].T, moved), K, width, height))
    return cameras
