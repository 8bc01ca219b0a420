"""Compare given cameras with the images: what rests must lie on its epipolar lines.

A file of poses does not say which way they lead, or which axes they mean, and what is read the wrong way makes a whole run wrong
without a word. So points are matched between some frames, and the distance of a match from where the cameras allow it (Sampson's,
Hartley and Zisserman, Multiple View Geometry, 11.4.3) tells whether they belong to these images. Most of what is matched may move,
so the nearest three tenths speak. Each other reading of the same numbers is tried, too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.progress import track
from flowsplat.common.spread import spread
from flowsplat.geometry import Camera
from flowsplat.geometry.cameras import OPENGL
from flowsplat.geometry.interpolation import sample_map
from flowsplat.geometry.lens import Lens
from flowsplat.priors.cameras.still import stands_still
from flowsplat.priors.flow import dis_flow, read_gray
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
RESTING_SHARE = 0.3
"""Share of the matches that is taken to rest: the distance within which so many of them lie is how far cameras miss the images.
Chosen by eye."""
MAX_MISFIT = 2e-3
"""That distance, as a share of the longer side, of cameras that belong to the images: 1.7 pixels of 854 (docs/given.md). Chosen by
eye."""
SUSPECT_MISFIT, BETTER_SHARE = 3e-4, 1 / 3
"""From this distance on another reading of the numbers is taken that has at most such a share of it. Chosen by eye."""
STRAIGHT_SHARE = 2 / 3
"""Share of the misfit behind a lens that cameras without it have at most where it was taken out of the images already. Where it
was not, they have at least 1.0 (four rig scenes, two of DAVIS, twelve random worlds; 2 to 25 pixels at the border). Where it was,
they have .14 to .59 at 25 pixels but for one world, and .23 to .69 at 12 but for two, so this finds most of them."""
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


def fit_to_images(cameras: Sequence[Camera], scene: Scene, lens: Lens | None = None) -> tuple[list[Camera], str]:
    """Return the cameras as the images say they are meant, and a sentence about it; empty where the images do not tell.

    Args:
        cameras: one a frame; those of straightened images, where there is a lens.
        lens: that will be taken out of the images.

    Raises:
        InputError: no reading of these numbers fits the images, or these are straight already.
    """
    raw = match_frames(scene)
    matches = raw if lens is None else [each for match in raw if len((each := _straighten(match, lens)).before) >= MIN_MATCHES]
    if not matches:
        _require_centers_inside(cameras)
        return list(cameras), ""
    found, told = _choose_reading(cameras, matches, max(scene.width, scene.height), with_sizes=lens is None)
    if lens is not None:
        _require_bent(found, matches, raw, lens)
    return found, told


def _choose_reading(
    cameras: Sequence[Camera], matches: Sequence[Matches], longer_side: int, with_sizes: bool
) -> tuple[list[Camera], str]:
    longest = max(matches[0].size)
    to_frame = longer_side / longest
    misfit = compute_misfit(cameras, matches)
    if misfit <= SUSPECT_MISFIT * longest:
        return list(cameras), _sentence(misfit * to_frame)
    readings = _read_otherwise(cameras, with_sizes)
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


def _require_bent(cameras: Sequence[Camera], matches: Sequence[Matches], raw: Sequence[Matches], lens: Lens) -> None:
    """Refuse to take a lens out of images that were straightened by others.

    Args:
        cameras: of the straightened images; ``matches`` lie in these, and ``raw`` in the images as they came.
    """
    as_it_came = replace(lens, zoom=1 / lens.zoom)
    misfit = compute_misfit(cameras, matches) / lens.zoom
    without = compute_misfit([as_it_came.straighten_camera(camera) for camera in cameras], raw)
    if without <= STRAIGHT_SHARE * misfit:
        unit = lens.width / raw[0].size[0]
        raise InputError(
            "The images are straight already: once the lens of the cameras is taken out, what rests misses where they put it by "
            f"{misfit * unit:.2f} pixels, and by {without * unit:.2f} as they are. Give the cameras of these images, without a "
            "lens."
        )


def _straighten(matches: Matches, lens: Lens) -> Matches:
    """Return what lies in both straightened images."""
    unit = np.array([lens.width, lens.height]) / matches.size
    before, after = (lens.straighten_positions(points * unit) / unit for points in (matches.before, matches.after))
    inside = ((before >= 0) & (before <= matches.size) & (after >= 0) & (after <= matches.size)).all(1)
    return replace(matches, before=before[inside], after=after[inside])


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


def match_frames(scene: Scene, frames: Sequence[int] | None = None, what: str = "Cameras against images") -> list[Matches]:
    """Return what is matched between some frames that are a little apart; none of pairs of which little is seen again or moves, or
    where the camera stands still.

    Args:
        frames: those that may be read; all of the clip, held-out ones too, where none are named.
        what: is done with them, for the progress bar.
    """
    numbers = range(scene.num_frames) if frames is None else frames
    # Before a camera that stands still all that moves is nothing that rests, and every reading of its poses is the same.
    if not all(map(scene.has_frame, numbers)) or stands_still(scene, numbers):
        return []
    found = []
    for k in track(spread(max(len(numbers) - 1, 0), PAIRS), what):
        i = numbers[k]
        a = read_gray(scene, i, WORKING_SIDE)
        points = new_points(corner_strength(a), np.zeros((0, 2), np.float32), max(4, round((a.size / POINTS) ** 0.5)))
        for j in [numbers[k + gap] for gap in GAPS if k + gap < len(numbers)]:
            b = read_gray(scene, j, WORKING_SIDE)
            after, ok = refine_points(a, b, points, points + sample_map(dis_flow(a, b), points), PATCH_SIDE)
            if ok.sum() >= MIN_MATCHES:
                if np.median(np.linalg.norm(after[ok] - points[ok], axis=1)) >= MIN_MOVED:
                    size = a.shape[1], a.shape[0]
                    found.append(Matches(i, j, points[ok].astype(np.float64), after[ok].astype(np.float64), size))
                break
    return found


def compute_misfit(cameras: Sequence[Camera], matches: Sequence[Matches]) -> float:
    """Return how far cameras miss the images, in pixels of the matches: the median over pairs of the distance from where they allow
    a match within which ``RESTING_SHARE`` of the matches lie."""
    distances = [_distances(cameras[each.first], cameras[each.second], each) for each in matches]
    return float(np.median([np.quantile(off, RESTING_SHARE, method="lower") for off in distances]))


def _distances(first: Camera, second: Camera, matches: Matches) -> np.ndarray:
    """Return [N] pixels: from the epipolar line, or, of two cameras in one place, from the point."""
    a, b = first.resize(*matches.size), second.resize(*matches.size)
    pose = b.pose_from(a)
    rotation, shift = pose[:3, :3], pose[:3, 3]
    before, after = (np.concatenate([p, np.ones((len(p), 1))], 1) for p in (matches.before, matches.after))
    if np.linalg.norm(shift) < 1e-9:
        there = before @ (b.K @ rotation @ np.linalg.inv(a.K)).T
        ahead = there[:, 2] > 1e-9
        off = np.linalg.norm(there[:, :2] / np.where(ahead, there[:, 2], 1)[:, None] - matches.after, axis=1)
        return np.where(ahead, off, np.inf)
    x, y, z = shift / np.linalg.norm(shift)
    E = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
    F = np.linalg.inv(b.K).T @ E @ np.linalg.inv(a.K)
    lines, back = before @ F.T, after @ F
    slope = (lines[:, :2] ** 2).sum(1) + (back[:, :2] ** 2).sum(1)
    return np.abs((after * lines).sum(1)) / np.sqrt(np.maximum(slope, 1e-18))


def _read_otherwise(cameras: Sequence[Camera], with_sizes: bool) -> dict[str, list[Camera]]:
    """Return the cameras that the same numbers mean when they are read in other ways, by what they are called in a sentence.

    Args:
        with_sizes: also as those of images of another size. A lens would be another one there.
    """

    def posed(change: Callable[[np.ndarray], np.ndarray]) -> list[Camera]:
        return [replace(camera, viewmat=change(camera.viewmat)) for camera in cameras]

    found = {
        "camera-to-world poses": posed(np.linalg.inv),
        "world-to-camera poses with OpenGL's axes": posed(lambda pose: OPENGL @ pose),
        "camera-to-world poses with OpenGL's axes": posed(lambda pose: OPENGL @ np.linalg.inv(pose)),
    }
    # Principal points tell how large the images were.
    scale = 2 * float(np.median([camera.K[0, 2] / camera.width for camera in cameras]))
    if with_sizes and scale > 0 and abs(scale - 1) > MAX_CENTERED:
        smaller = np.diag([1 / scale, 1 / scale, 1])
        found["of images of another size"] = [replace(camera, K=smaller @ camera.K) for camera in cameras]
    return found
