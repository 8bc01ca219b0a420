"""Cameras for some frames only: those between two others are interpolated where few in a row are missing."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from flowsplat.common.errors import InputError
from flowsplat.geometry import Camera
from flowsplat.geometry.cameras import rigid
from flowsplat.priors.given.fitting import require_frames
from flowsplat.scenes import Scene

MAX_GAP = 2
"""Frames in a row whose cameras are interpolated. Left out of known paths, two in a row come back to within these pixels (median
over the gaps, and what 95 % of them do not exceed; of points at distance 1): bear .15 and .37 of 854, train .55 and 1.2, the four
rig scenes .01 and .02 of 480, worlds 0 to 15 at most 1.1 and 2.2 of 320. Four in a row: train .95 and 2.1, worlds at most 3.5 and
7.8."""


def fill_gaps(path: Path, found: Mapping[int, Camera], scene: Scene) -> tuple[list[Camera], str]:
    """Return one camera a frame, and a sentence about those that are interpolated; empty where none is.

    Centers lie on a cubic spline, rotations on one of angular velocity (scipy's ``RotationSpline``).

    Args:
        found: by the frame.

    Raises:
        InputError: more than ``MAX_GAP`` in a row are missing, or the first or last one.
    """
    known = sorted(found)
    if known and known[-1] >= scene.num_frames:
        require_frames(path, known[-1] + 1, scene, "cameras")
    for before, after in pairwise([-1, *known, scene.num_frames]):
        if after - before > (1 if before < 0 or after == scene.num_frames else MAX_GAP + 1):
            raise InputError(
                f"{path} has no cameras of frames {before + 1} to {after - 1}: they are interpolated only where at most {MAX_GAP} "
                "in a row are missing, between others. Give one a frame (--start, --end, --every and --max-frames choose them)."
            )
    missing = [i for i in range(scene.num_frames) if i not in found]
    cameras = dict(found)
    if missing:
        given = [found[i] for i in known]
        for i, camera in zip(known, given, strict=True):
            if not camera.is_valid:
                raise InputError(f"{path}: the camera of frame {i} is not finite or its pose is not a rotation.")
        if len({(camera.width, camera.height) for camera in given}) > 1:
            raise InputError(
                f"{path} has cameras of images of several sizes, and none of frame {missing[0]}: give one for every frame."
            )
        rotations = RotationSpline(known, Rotation.from_matrix([camera.viewmat[:3, :3] for camera in given]))(missing)
        centers = CubicSpline(known, [camera.center for camera in given])(missing)
        intrinsics = [np.interp(missing, known, values) for values in np.reshape([camera.K for camera in given], (-1, 9)).T]
        for i, rotation, center, K in zip(missing, rotations.as_matrix(), centers, np.transpose(intrinsics), strict=True):
            cameras[i] = Camera(rigid(rotation, -rotation @ center), K, given[0].width, given[0].height)
    told = f"those of {len(missing)} frames that it lacks are interpolated" if missing else ""
    return [cameras[i] for i in range(scene.num_frames)], told


def find_frames(path: Path, names: Sequence[str], scene: Scene, what: str) -> list[int]:
    """Return the frame of each file: in their natural order where there is one a frame, else by the last number in its name.

    The first and the last file must be of the first and the last frame, which tells how others are numbered.

    Args:
        names: in their natural order.

    Raises:
        InputError: they are not one a frame, and cannot be counted.
    """
    if len(names) == scene.num_frames or not names:
        require_frames(path, len(names), scene, what)
        return list(range(len(names)))
    digits = [re.findall(r"[0-9]{1,18}", Path(name).stem) for name in names]
    numbers = [int(each[-1]) for each in digits if each]
    steps = np.diff(numbers)
    if len(numbers) == len(names) and len(names) > 1 and (steps > 0).all():
        step = math.gcd(*map(int, steps))
        # Whole multiples of the frames of the clip: of every second image, say.
        for unit in sorted({step, *(step // k for k in range(2, MAX_GAP + 2) if step % k == 0)}):
            if numbers[-1] - numbers[0] == unit * (scene.num_frames - 1):
                return [(number - numbers[0]) // unit for number in numbers]
    require_frames(path, len(names), scene, what)
    raise AssertionError("unreachable")
