"""A camera path in a file: our own, nerfstudio's ``camera_path.json``, or a ``transforms.json``.

Ours is a JSON object:

| key | content |
| --- | --- |
| ``fps`` | frames a second of the video, 0.1 to 1000; optional |
| ``width``, ``height`` | pixels of the images; optional, else those of the scene |
| ``frames`` | a list, in the order of the video, of objects with the keys below |
| ``t`` | seconds of the clip; optional, but for all frames or for none: then the clip plays once |
| ``viewmat`` | 4 x 4 rows, world to camera: x right, y down, z forward, in the coordinates of the scene's ``cameras.json`` |
| ``K`` or ``fov_y`` | 3 x 3 rows in pixels (skew is not used), or the vertical field of view in degrees with a centered axis |

The other two hold camera to world with y up and z backward (OpenGL), which is turned into ours, in the same world as
above; their times (``render_time``, ``time``) run from 0 to 1 over the clip. Lenses must be pinholes.
https://docs.nerf.studio/quickstart/data_conventions.html
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.files import read_json, write_json
from flowsplat.geometry import Camera
from flowsplat.images.video import MAX_FPS, MIN_FPS
from flowsplat.scenes.formats.lens import require_pinhole
from flowsplat.scenes.formats.nerfstudio import from_opengl, image_size, positive, transforms_camera

MAX_SIDE = 8192
"""Pixels of width or height; beyond that it is a slip and not a wish. Chosen by eye."""


@dataclass(frozen=True)
class CameraShots:
    """What to show: one (camera, seconds of the clip) a frame, and the frame rate, if the file had one."""

    shots: list[tuple[Camera, float]]
    fps: float | None = None


def write_camera_file(path: str | Path, shots: Sequence[tuple[Camera, float]], fps: float | None = None) -> None:
    """Write our own format; all cameras must have the same size."""
    first = shots[0][0]
    frames = [{"t": float(t), "viewmat": camera.viewmat, "K": camera.K} for camera, t in shots]
    head = {} if fps is None else {"fps": fps}
    write_json(Path(path), {**head, "width": first.width, "height": first.height, "frames": frames})


def read_camera_file(path: str | Path, size: tuple[int, int], clip: tuple[float, float]) -> CameraShots:
    """Read a camera path in any of the three formats.

    Args:
        size: (width, height) in pixels where the file has none.
        clip: seconds of the first and the last frame of the clip.

    Raises:
        InputError: the file is missing, not a camera path, or has values that make no camera or are outside the clip.
    """
    content = read_json(Path(path))
    try:
        if not isinstance(content, dict):
            raise InputError("it is not a JSON object")
        entries, read, is_relative = _format(content)
        found = [_read_entry(read, content, entry, index, size) for index, entry in enumerate(entries)]
        if len({(camera.width, camera.height) for camera, _ in found}) > 1:
            raise InputError("its cameras differ in width or height, a video needs one size")
        fps = None if content.get("fps") is None else positive(content["fps"], "fps")
        if fps is not None and not MIN_FPS <= fps <= MAX_FPS:
            raise InputError(f"its fps is {fps:g}: only {MIN_FPS:g} to {MAX_FPS:g} can be written")
        seconds = _seconds([time for _, time in found], clip, is_relative)
    except (InputError, ValueError, ArithmeticError) as error:
        raise InputError(f"{path} cannot be used as a camera path: {error}.") from error
    return CameraShots([(camera, time) for (camera, _), time in zip(found, seconds, strict=True)], fps)


Entry = dict[str, Any]
Reader = Callable[[Entry, Entry, tuple[int, int]], tuple[Camera, float | None]]
"""(whole file, one frame of it, size where the file has none) to a camera and its time."""


def _format(content: Entry) -> tuple[list[Any], Reader, bool]:
    """Return the frames of the file, how to read one, and whether their times run from 0 to 1."""
    entries = content.get("camera_path", content.get("frames"))
    if not isinstance(entries, list) or not entries:
        raise InputError("it has no list 'frames' or 'camera_path' with at least one camera")
    if "camera_path" in content:
        kind = content.get("camera_type", "perspective")
        if kind != "perspective":
            raise InputError(f"its camera_type is {kind!r}, only 'perspective' can be rendered")
        return entries, _from_camera_path, True
    if isinstance(entries[0], dict) and "transform_matrix" in entries[0]:
        return entries, _from_transforms, True
    return entries, _from_ours, False


def _read_entry(read: Reader, content: Entry, entry: Any, index: int, size: tuple[int, int]) -> tuple[Camera, float | None]:
    try:
        if not isinstance(entry, dict):
            raise InputError("it is not a JSON object")
        camera, time = read(content, entry, size)
        if not (1 <= camera.width <= MAX_SIDE and 1 <= camera.height <= MAX_SIDE):
            raise InputError(f"an image of {camera.width} x {camera.height} pixels is not possible (1 to {MAX_SIDE})")
        if not camera.is_valid:
            raise InputError("its matrices are not finite, not a rotation, or have no positive focal length")
        return camera, time
    except KeyError as error:
        raise InputError(f"frame {index} has no {error}") from error
    except (InputError, TypeError, ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        raise InputError(f"frame {index}: {str(error).rstrip('.')}") from error


def _from_ours(content: Entry, entry: Entry, size: tuple[int, int]) -> tuple[Camera, float | None]:
    width, height = image_size(content, ("width", "height"), size)
    if "K" in entry:
        K = _matrix(entry["K"], (3, 3), "K")
        if abs(K[0, 1]) > 1e-6 * abs(K[0, 0]) or not np.allclose(K[[1, 2, 2, 2], [0, 0, 1, 2]], (0, 0, 0, 1)):
            raise InputError("its K is not of the form fx 0 cx, 0 fy cy, 0 0 1")
    else:
        K = _make_centered_K(positive(entry["fov_y"], "fov_y"), width, height)
    time = entry.get("t")
    return Camera(_matrix(entry["viewmat"], (4, 4), "viewmat"), K, width, height), None if time is None else float(time)


def _from_camera_path(content: Entry, entry: Entry, size: tuple[int, int]) -> tuple[Camera, float | None]:
    width, height = image_size(content, ("render_width", "render_height"), size)
    viewmat = from_opengl(entry["camera_to_world"], "camera_to_world")
    time = entry.get("render_time")
    K = _make_centered_K(positive(entry["fov"], "fov"), width, height)
    return Camera(viewmat, K, width, height), None if time is None else float(time)


def _from_transforms(content: Entry, entry: Entry, size: tuple[int, int]) -> tuple[Camera, float | None]:
    camera, distortion = transforms_camera("it", {**content, **entry}, size)
    require_pinhole("it", camera, distortion)
    time = entry.get("time")
    return camera, None if time is None else float(time)


def _make_centered_K(fov_y: float, width: int, height: int) -> np.ndarray:
    if not 1e-3 <= fov_y < 180:
        raise InputError(f"a field of view of {fov_y:g} degrees is none")
    focal = 0.5 * height / np.tan(np.radians(fov_y) / 2)
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])


def _matrix(value: Any, shape: tuple[int, int], name: str) -> np.ndarray:
    """Rows, or all numbers in one list."""
    matrix = np.array(value, np.float64)
    if matrix.size != shape[0] * shape[1]:
        raise InputError(f"{name} has {matrix.size} numbers instead of {shape[0]} x {shape[1]}")
    return matrix.reshape(shape)


def _seconds(times: list[float | None], clip: tuple[float, float], is_relative: bool) -> list[float]:
    """Return the times of the frames in seconds of the clip; frames without a time play the clip once from start to end."""
    first, last = clip
    known = [time for time in times if time is not None]
    if not known:
        return np.linspace(first, last, len(times)).tolist()
    if len(known) < len(times):
        raise InputError(f"{len(known)} of {len(times)} frames have a time: give one to all or to none")
    seconds = np.array(known) * (last - first) + first if is_relative else np.array(known)
    slack = 1e-3 * (last - first)
    outside = ~((seconds >= first - slack) & (seconds <= last + slack))
    if outside.any():
        raise InputError(f"frame {np.argmax(outside)} is at {seconds[outside][0]:g} s, the clip runs from {first:g} to {last:g} s")
    return np.clip(seconds, first, last).tolist()
