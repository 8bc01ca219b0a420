"""The camera stage: frames in, one camera for every frame and a plain verdict out."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.geometry import Camera
from flowsplat.priors.cameras.checks import Gaps, verdict
from flowsplat.priors.cameras.estimate import Estimate, estimate
from flowsplat.priors.cameras.following import WORKING_SIDE, follow_points
from flowsplat.priors.cameras.pieces import find_breaks, join, split
from flowsplat.scenes import Scene


@dataclass(frozen=True)
class CameraOptions:
    """How the cameras are estimated.

    Attributes:
        focal: focal length in pixels of the prepared frames, where it is known; otherwise it is estimated.
    """

    focal: float | None = None


def camera_stage(scene: Scene, options: CameraOptions) -> None:
    """Estimate a pose for every frame and one focal length, and write them to ``scene``.

    The principal point is taken to be the centre of the picture and pixels to be square. Held-out frames are seen here
    (METHOD 6), but nothing other than their poses leaves this stage. The first camera is the identity and the median
    distance of the points is 1. Pieces that nothing joins (there is a cut between them) are solved one by one, each in
    these units, and set side by side so far apart that none sees the other: the path jumps there.

    Raises:
        InputError: the given focal length is not a positive number.
    """
    focal = options.focal
    if focal is not None and not (np.isfinite(focal) and focal > 0):
        raise InputError(f"The focal length is {focal}: give a positive number of pixels, or leave it out.")
    # Thresholds are in pixels of the size at which points are followed.
    unit = max(1.0, max(scene.width, scene.height) / WORKING_SIDE)
    followed, blank = follow_points(scene)
    shown = [t for t in range(scene.num_frames) if t not in set(blank)]
    pieces = split(shown, find_breaks(followed / unit, shown))
    positions = _off_movers(scene, followed) / unit
    if not pieces:
        pieces, positions = [list(range(scene.num_frames))], positions[:0]
    del followed
    found = [_estimate_piece(positions[:, frames], scene.width / unit, scene.height / unit, focal, unit) for frames in pieces]
    parts = [_cameras(each, unit, scene.width, scene.height) for each in found]
    cameras = join(pieces, parts, scene.num_frames)
    scene.write_cameras(cameras)
    main = found[int(np.argmax([len(frames) for frames in pieces]))]
    errors = np.concatenate([each.fit.errors for each in found]) * unit
    numbers = np.concatenate([np.array(frames)[each.fit.frames] for frames, each in zip(pieces, found, strict=True)])
    heldout = np.isin(numbers, scene.heldout_frames)
    unplaced = [frames[t] for frames, each in zip(pieces, found, strict=True) for t in each.unplaced]
    breaks = [frames[0] for frames in pieces[1:]]
    scene.finish_prior(
        "cameras",
        method="tracks",
        motion=main.motion,
        static=len(pieces) == 1 and main.motion in ("static", "unknown"),
        focal=round(main.fit.state.focal * unit, 3),
        focal_given=focal is not None,
        focal_sigma=round(main.fit.focal_sigma, 5) if np.isfinite(main.fit.focal_sigma) else None,
        parallax_degrees=round(float(np.degrees(main.parallax)), 3),
        reprojection_px=round(float(np.median(errors)), 4),
        reprojection_p90_px=round(float(np.quantile(errors, 0.9)), 4),
        reprojection_heldout_px=round(float(np.median(errors[heldout])), 4) if heldout.any() else None,
        tracks=sum(int(each.fit.static.sum()) for each in found),
        unplaced=unplaced,
        breaks=breaks,
        blank=blank,
        verdict=verdict(main, unit, scene.width, focal is not None, Gaps(unplaced, breaks, blank, scene.timestamps)),
    )


def _estimate_piece(positions: np.ndarray, width: float, height: float, focal: float | None, unit: float) -> Estimate:
    often = np.isfinite(positions[..., 0]).sum(1) >= min(2, positions.shape[1])
    return estimate(positions[often], width, height, None if focal is None else focal / unit)


def _off_movers(scene: Scene, positions: np.ndarray) -> np.ndarray:
    """Without the tracks that touch the masks of moving objects, where there are masks."""
    if scene.prior("masks") is None:
        return positions
    margin = max(3, round(0.01 * max(scene.width, scene.height)))
    kernel = np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)
    touches = np.zeros(len(positions), bool)
    for t in scene.train_frames:
        mask = cv2.dilate((scene.mask(t) > 0).astype(np.uint8), kernel)
        seen = np.flatnonzero(np.isfinite(positions[:, t, 0]))
        x, y = np.clip(positions[seen, t].astype(int), 0, [scene.width - 1, scene.height - 1]).T
        touches[seen[mask[y, x] > 0]] = True
    enough = (~touches).sum() >= 0.1 * len(positions)
    return positions[~touches] if enough else positions


def _cameras(found: Estimate, unit: float, width: int, height: int) -> list[Camera]:
    """One camera a frame: the first one the identity, the median distance of the static points 1."""
    state, fit = found.fit.state, found.fit
    distance = 1.0
    if found.motion == "free":
        distance = float(np.median(np.linalg.norm(state.points[fit.static] - state.centers[0], axis=1)))
    focal = state.focal * unit
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    cameras = []
    for rotation, center in zip(state.rotations, state.centers, strict=True):
        viewmat = np.eye(4)
        viewmat[:3, :3] = rotation @ state.rotations[0].T
        viewmat[:3, 3] = -rotation @ (center - state.centers[0]) / distance
        cameras.append(Camera(viewmat, K, width, height))
    return cameras
