"""ViPE's results (https://github.com/nv-tlabs/vipe, ``vipe/utils/io.py``): a folder of folders, with one file a clip in each.

| file | content |
| --- | --- |
| ``pose/<clip>.npz`` | ``data`` [N, 4, 4] camera to world with OpenCV's axes, ``inds`` [N]: frames |
| ``intrinsics/<clip>.npz``, ``<clip>_camera.txt`` | ``data`` [N, 4]: fx, fy, cx, cy, ``inds``; the kind of lens of each frame |
| ``depth/<clip>.zip`` | ``00000.exr`` ..., one channel Z of planar depth as half |
| ``mask/<clip>.zip``, ``<clip>.txt`` | ``00000.png`` ..., numbers of objects; lines ``number: what it is`` (``sky`` is none) |

The principal point is the middle of its images, which tells their size.
"""

from __future__ import annotations

import re
import struct
import zlib
from pathlib import Path

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.files import list_zip, read_npz, read_text, read_zip
from flowsplat.geometry import Camera
from flowsplat.priors.given.exr import decode_exr
from flowsplat.priors.given.fitting import Placement, compute_max_bytes, require_frames, require_shape
from flowsplat.priors.given.gaps import fill_gaps
from flowsplat.scenes import Depth, Scene

MAKER = "ViPE"
RESTING_LABELS = {"background", "sky"}
"""What its labels call that does not move."""
_MAX_FILE_BYTES = 64 * 2**20
"""Of one image in a zip. Chosen by eye."""


def find_file(folder: Path, kind: str, scene: Scene) -> Path | None:
    """Return the file of this clip in the folder ``kind`` of ViPE's results; None where there is no such folder.

    Raises:
        InputError: it has files of several clips, of which none is called like this one.
    """
    suffix = ".npz" if kind in ("pose", "intrinsics") else ".zip"
    found = {file.stem: file for file in sorted((folder / kind).glob(f"[!.]*{suffix}"))}
    if len(found) > 1 and scene.name not in found:
        raise InputError(
            f"{folder / kind} holds {len(found)} clips, none called {scene.name} as this one: give a folder with those of one."
        )
    return found.get(scene.name) or next(iter(found.values()), None)


def read_cameras(folder: Path, scene: Scene) -> tuple[list[Camera], str]:
    """Return one camera a frame, at the size of the frames, and what is to be said about them.

    Raises:
        InputError: damaged, no pinholes, or not of this clip.
    """
    path = find_file(folder, "pose", scene)
    assert path is not None
    lens = folder / "intrinsics" / path.name
    poses, values = _by_frame(path, (4, 4), scene), _by_frame(lens, (4,), scene)
    kinds = lens.with_name(f"{lens.stem}_camera.txt")
    if kinds.is_file() and (other := {line.split(":")[-1].strip() for line in read_text(kinds).splitlines()} - {"PINHOLE"}):
        raise InputError(f"{kinds} names lenses that are no pinholes ({min(other)}): give cameras of straightened images.")
    found = {}
    for i, pose in poses.items():
        if i not in values:
            raise InputError(f"{lens} has no intrinsics of frame {i}.")
        fx, fy, cx, cy = values[i].astype(np.float64)
        if not (0.5 <= cx < 1e5 and 0.5 <= cy < 1e5):  # each by itself: min and max may pass over a NaN
            raise InputError(f"{lens}: the principal point of frame {i} is ({cx:g}, {cy:g}), which is the middle of no image.")
        width, height = round(2 * cx), round(2 * cy)
        require_shape(lens, width, height, scene)
        try:
            viewmat = np.linalg.inv(pose.astype(np.float64))
        except np.linalg.LinAlgError as error:
            raise InputError(f"{path} holds a pose that is no camera's: {error}.") from error
        found[i] = Placement(0, 0, width, height).camera(viewmat, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), scene)
    return fill_gaps(path, found, scene)


def _by_frame(path: Path, shape: tuple[int, ...], scene: Scene) -> dict[int, np.ndarray]:
    arrays = read_npz(path, ("data", "inds"), compute_max_bytes(scene))
    data, frames = arrays.get("data"), arrays.get("inds")
    if data is None or frames is None or data.shape != (*frames.shape, *shape) or frames.ndim != 1 or frames.dtype.kind not in "iu":
        raise InputError(f"{path} is not as ViPE writes it: it needs data [N, {', '.join(map(str, shape))}] and inds [N].")
    if len(frames) and frames.min() < 0:
        raise InputError(f"{path} is not as ViPE writes it: inds has {frames.min()}.")
    return dict(zip(frames.tolist(), data, strict=True))


def list_members(path: Path, suffix: str, scene: Scene, what: str) -> dict[int, str]:
    """Return the names of the files in a zip by their frames, each called by its number.

    Raises:
        InputError: not of this clip, or one of a training frame is missing.
    """
    called = re.compile("[0-9]{1,9}" + re.escape(suffix))
    names = {int(name[: -len(suffix)]): name for name in list_zip(path) if called.fullmatch(name)}
    if names and max(names) >= scene.num_frames:
        require_frames(path, max(names) + 1, scene, what)
    missing = [i for i in scene.train_frames if i not in names]
    if missing:
        raise InputError(f"{path} holds no {missing[0]:05d}{suffix}: give {what} for every training frame.")
    return names


class VipeDepth:
    """The depth of one result."""

    def __init__(self, path: Path, scene: Scene):
        """Open a zip of depth.

        Raises:
            InputError: damaged, or not of this clip.
        """
        self._path, self._scene, self._names = path, scene, list_members(path, ".exr", scene, "depth")

    def __call__(self, i: int) -> Depth:
        """Return depth of frame ``i`` in ViPE's units, at the size of the frames; no confidence where it has none.

        Raises:
            InputError: damaged, or of another shape.
        """
        name = self._names[i]
        try:
            depth = decode_exr(read_zip(self._path, name, _MAX_FILE_BYTES)).astype(np.float32)
        except (ValueError, KeyError, IndexError, struct.error, zlib.error, OverflowError) as error:
            raise InputError(f"{self._path}: {name} is no depth that can be read here: {error}.") from error
        height, width = depth.shape
        require_shape(self._path, width, height, self._scene)
        return Placement(0, 0, width, height).place_depth(depth, np.isfinite(depth) & (depth > 0), self._scene)


def find_resting(path: Path) -> list[int]:
    """Return the labels of a zip of masks that do not move, as the file beside it says.

    Raises:
        InputError: it is damaged.
    """
    beside = path.with_suffix(".txt")
    if not beside.is_file():
        return []
    named = [re.fullmatch(r"\s*([0-9]{1,9})\s*:(.*)", line) for line in read_text(beside).splitlines() if line.strip()]
    if not all(named):
        raise InputError(f"{beside} is not as ViPE writes it: its lines are not number: what it is.")
    return [int(line[1]) for line in named if line and line[2].strip().lower() in RESTING_LABELS]
