"""Compare given cameras with the images: what rests must lie on its epipolar lines.

A file of poses does not say which way they lead, or which axes they mean, and what is read the wrong way makes a whole run wrong
without a word. So points are matched between some frames, and the median distance of a match from where the cameras allow it
(Sampson's, Hartley and Zisserman, Multiple View Geometry, 11.4.3) tells whether they belong to these images: .05 to .2 pixels
where they do, several where they do not. Each other reading of the same numbers is tried, too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.progress import track
from flowsplat.common.spread import spread
from flowsplat.geometry import Camera
from flowsplat.geometry.cameras import rigid
from flowsplat.geometry.interpolation import sample_map
from flowsplat.priors.flow import dis_flow, gray
from flowsplat.priors.tracks import corner_strength, new_points, refine_points
from flowsplat.scenes import Scene

WORKING_SIDE = 640
"""Pixels of the longer side of the images in which points are matched. Chosen by eye."""
PAIRS, GAPS = 8, (12, 6, 3, 1)
"""Pairs of frames that are compared, and how many frames lie between the two: the first at which enough is seen again. Chosen by
eye."""
POINTS, MIN_MATCHES, PATCH_SIDE = 600, 60, 15
"""Points of a frame at most, matches of a pair at least, and the side in pixels of what is compared. Chosen by eye."""
MIN_MOVED = 1.0
"""Pixels that half of the matches must have moved for a pair to tell anything. Chosen by eye."""
MAX_MISFIT = 2e-3
"""Median distance, as a share of the longer side, of cameras that belong to the images: 1.7 pixels of 854. Right ones of 24
scenes have 7e-5 to 1.6e-3, wrong readings 1.8e-3 to .03 (docs/given.md)."""
SUSPECT_MISFIT, BETTER_SHARE = 3e-4, 1 / 3
"""From this median distance on another reading of the numbers is taken that has at most such a share of it. Chosen by eye."""
MAX_CENTERED = 0.1
"""Share by which a principal point may be off the middle before intrinsics of another size are tried. Chosen by eye."""


@dataclass(frozen=True)
class Matches:
    """What was matched between two frames: pixels [N, 2] of either, at ``size`` (width, height)."""

    first: int
    second: int
    before: np.ndarray
    after: np.ndarray
    size: tuple[int, int]


def fit_to_images(cameras: Sequence[Camera], scene: Scene) -> tuple[list[Camera], str]:
    """Return the cameras as the images say they are meant, and a sentence about it; empty where the images do not tell.

    Raises:
        InputError: no reading of these numbers fits the images.
    """
    matches = list(match_frames(scene))
    if not matches:
        _require_centers_inside(cameras)
        return list(cameras), ""
    to_frame = max(scene.width, scene.height) / max(matches[0].size)
    longest = max(matches[0].size)
    misfit = compute_misfit(cameras, matches)
    if misfit <= SUSPECT_MISFIT * longest:
        return list(cameras), _sentence(misfit * to_frame)
    readings = {how: read(cameras) for how, read in _readings(cameras).items()}
    misfits = {how: compute_misfit(each, matches) for how, each in readings.items()}
    best = min(misfits, key=misfits.__getitem__)
    if misfits[best] <= min(BETTER_SHARE * misfit, MAX_MISFIT * longest):
        was, now = misfit * to_frame, misfits[best] * to_frame
        return readings[best], f"they are {best}: as they came they miss the images by {was:.1f} pixels, so by {now:.2f}"
    if misfit > MAX_MISFIT * longest:
        raise InputError(
            f"The cameras do not belong to these images: what rests misses where they put it by {misfit * to_frame:.1f} pixels "
            f"(right ones by .1), and other readings do not help (world-to-camera, axes of OpenGL, another size of image). "
            "Give the cameras of these very frames, or leave them out: they are estimated then."
        )
    return list(cameras), _sentence(misfit * to_frame)


def _require_centers_inside(cameras: Sequence[Camera]) -> None:
    for index, camera in enumerate(cameras):
        x, y = camera.K[:2, 2]
        if not (0 < x < camera.width and 0 < y < camera.height):
            raise InputError(
                f"The principal point of camera {index}, ({x:.0f}, {y:.0f}), is outside its {camera.width}x{camera.height} "
                "pixels, and the images do not move enough to tell what is meant: give intrinsics of images of this size."
            )


def _sentence(misfit: float) -> str:
    return f"they miss the images by {misfit:.2f} pixels"


def match_frames(scene: Scene) -> list[Matches]:
    """Return what is matched between some frames that are a little apart; none of pairs of which little is seen again or moves."""
    factor = min(1.0, WORKING_SIDE / max(scene.width, scene.height))
    size = max(1, round(scene.width * factor)), max(1, round(scene.height * factor))
    found = []

    def image(i: int) -> np.ndarray:
        return cv2.resize(gray(scene.any_frame(i)), size, interpolation=cv2.INTER_AREA)

    for i in track(spread(max(scene.num_frames - 1, 0), PAIRS), "Cameras against images"):
        if not all(scene.has_frame(k) for k in range(i, min(i + max(GAPS) + 1, scene.num_frames))):
            return []
        a = image(i)
        points = new_points(corner_strength(a), np.zeros((0, 2), np.float32), max(4, round((size[0] * size[1] / POINTS) ** 0.5)))
        for gap in [gap for gap in GAPS if i + gap < scene.num_frames]:
            b = image(i + gap)
            after, ok = refine_points(a, b, points, points + sample_map(dis_flow(a, b), points), PATCH_SIDE)
            if ok.sum() >= MIN_MATCHES:
                if np.median(np.linalg.norm(after[ok] - points[ok], axis=1)) >= MIN_MOVED:
                    found.append(Matches(i, i + gap, points[ok].astype(np.float64), after[ok].astype(np.float64), size))
                break
    return found


def compute_misfit(cameras: Sequence[Camera], matches: Sequence[Matches]) -> float:
    """Return the median over pairs of the median distance in pixels of a match from where the cameras allow it."""
    return float(np.median([np.median(_distances(cameras[each.first], cameras[each.second], each)) for each in matches]))


def _distances(first: Camera, second: Camera, matches: Matches) -> np.ndarray:
    """Return [N] pixels: from the epipolar line, or, of two cameras in one place, from the point."""
    a, b = first.resize(*matches.size), second.resize(*matches.size)
    pose = b.pose_from(a)
    rotation, shift = pose[:3, :3], pose[:3, 3]
    before, after = (np.concatenate([p, np.ones((len(p), 1))], 1) for p in (matches.before, matches.after))
    if np.linalg.norm(shift) < 1e-9:
        there = before @ (b.K @ rotation @ np.linalg.inv(a.K)).T
        return np.linalg.norm(there[:, :2] / np.where(there[:, 2:] > 1e-9, there[:, 2:], np.nan) - matches.after, axis=1)
    x, y, z = shift / np.linalg.norm(shift)
    E = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
    F = np.linalg.inv(b.K).T @ E @ np.linalg.inv(a.K)
    lines, back = before @ F.T, after @ F
    slope = (lines[:, :2] ** 2).sum(1) + (back[:, :2] ** 2).sum(1)
    return np.abs((after * lines).sum(1)) / np.sqrt(np.maximum(slope, 1e-18))


def _readings(cameras: Sequence[Camera]) -> Mapping[str, Callable[[Sequence[Camera]], list[Camera]]]:
    """Return other ways to read the same numbers, by what they are called in a sentence."""

    def turned(of: Callable[[np.ndarray], np.ndarray]) -> Callable[[Sequence[Camera]], list[Camera]]:
        return lambda each: [replace(camera, viewmat=of(camera.viewmat)) for camera in each]

    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    readings: dict[str, Callable[[Sequence[Camera]], list[Camera]]] = {
        "camera-to-world poses": turned(_invert),
        "world-to-camera poses with OpenGL's axes": turned(lambda pose: flip @ pose),
        "camera-to-world poses with OpenGL's axes": turned(lambda pose: flip @ _invert(pose)),
    }
    middle = float(np.median([camera.K[0, 2] / camera.width for camera in cameras])) * 2
    if middle > 0 and abs(middle - 1) > MAX_CENTERED:
        readings["of images of another size"] = lambda each: [_scale(camera, 1 / middle) for camera in each]
    return readings


def _invert(pose: np.ndarray) -> np.ndarray:
    return rigid(pose[:3, :3].T, -pose[:3, :3].T @ pose[:3, 3])


def _scale(camera: Camera, factor: float) -> Camera:
    return replace(camera, K=np.diag([factor, factor, 1.0]) @ camera.K)
