"""Depth from a file or folder of any known layout."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.files import read_npy, read_npz
from flowsplat.priors.given import droid, feedforward, megasam, vipe
from flowsplat.priors.given.fitting import Placement, compute_max_bytes, files_by_frame, require_shape
from flowsplat.scenes import Depth, Scene
from flowsplat.scenes.layers import decode_image

KNOWN = (
    "a folder of 00000.npy ... (planar depth) or 00000.png ... (16 bits, millimeters; 0 = unknown), "
    "Shape of Motion's aligned_depth_anything (disparity, .npy or 16-bit .png), "
    "MoSca's *_depth (.npz with dep), the .npz of Depth Anything 3, VGGT (both depth) or MegaSaM (depths), "
    "the folder of ViPE's results (depth in it)"
)

DISPARITY_FOLDERS = re.compile(r"depth_anything|_disp$", re.IGNORECASE)
"""What the folders of Shape of Motion's disparities are called (``aligned_depth_anything``, ``unidepth_disp``), and nothing
else about their files tells them from depth."""


@dataclass(frozen=True)
class GivenDepth:
    """Depth that the user brought.

    Attributes:
        maker: whose layout it is.
        fits: makers of cameras whose units the depth has; with any others it is fitted to them.
        read: from the number of a frame to its depth at the size of the frames, in units of its own.
    """

    maker: str
    fits: tuple[str, ...]
    read: Callable[[int], Depth]


def open_depth(path: Path, scene: Scene) -> GivenDepth:
    """Find out what ``path`` is; the maps of all training frames are read once, so that they can be relied on.

    Raises:
        InputError: missing, damaged, of no known layout, of another shape, or not for every training frame.
    """
    given = _open(Path(path), scene)
    for i in scene.train_frames:
        given.read(i)
    return given


def _open(path: Path, scene: Scene) -> GivenDepth:
    if path.is_file() and path.suffix == ".npz":
        return _open_archive(path, scene)
    if not path.is_dir():
        wrong = "holds no depth of a known layout" if path.exists() else "does not exist"
        raise InputError(f"{path} {wrong}. Looked for: {KNOWN}.")
    if archive := vipe.find_file(path, "depth", scene):
        return GivenDepth(vipe.MAKER, (vipe.MAKER,), vipe.VipeDepth(archive, scene))
    suffixes = {file.suffix.lower() for file in path.iterdir()}
    is_disparity = any(DISPARITY_FOLDERS.search(part) for part in path.resolve().parts[-3:])
    if is_disparity and suffixes & {".npy", ".png"}:
        files = files_by_frame(path, (".npy",) if ".npy" in suffixes else (".png",), scene, "disparity")
        return GivenDepth("Shape of Motion", (droid.MAKER,), lambda i: _disparity(files[i], scene))
    if ".npz" in suffixes:
        files = files_by_frame(path, (".npz",), scene, "depth")
        return GivenDepth("MoSca", (), lambda i: _mosca(files[i], scene))
    if ".png" in suffixes and ".npy" not in suffixes:
        files = files_by_frame(path, (".png",), scene, "depth")
        return GivenDepth("PNG in millimeters", ("any",), lambda i: _millimeters(files[i], scene))
    files = files_by_frame(path, (".npy",), scene, "depth")
    return GivenDepth("flowsplat", ("any",), lambda i: _read_own(files[i], scene))


def _open_archive(path: Path, scene: Scene) -> GivenDepth:
    arrays = read_npz(path, {*megasam.ARRAYS, *feedforward.ARRAYS}, most=compute_max_bytes(scene))
    if maker := feedforward.find_maker(arrays, with_cameras=False):
        return GivenDepth(maker, (maker,), feedforward.FeedForwardDepth(path, arrays, maker, scene))
    return GivenDepth(megasam.MAKER, (megasam.MAKER,), megasam.MegaSamDepth(path, arrays, scene))


def _map(path: Path, values: np.ndarray, scene: Scene) -> np.ndarray:
    if values.ndim != 2 or values.dtype.kind not in "fiu":
        raise InputError(f"{path} does not hold one depth map [height, width] of numbers.")
    require_shape(path, values.shape[1], values.shape[0], scene)
    if not values.size:
        raise InputError(f"{path} holds an empty depth map.")
    return values.astype(np.float32)


def _read_own(path: Path, scene: Scene) -> Depth:
    depth = _map(path, read_npy(path), scene)
    if (depth < 0).any():
        raise InputError(f"{path} holds depths below 0: save 0 or NaN where depth is not known.")
    known = np.isfinite(depth) & (depth > 0)
    if not known.any():
        raise InputError(f"{path} holds only depths that are not finite and positive.")
    return _fill_unknown(depth, known, scene)


def _millimeters(path: Path, scene: Scene) -> Depth:
    depth = _map(path, _read_png(path, "depth in millimeters"), scene) / np.float32(1000)
    return _fill_unknown(depth, depth > 0, scene)


def _read_png(path: Path, what: str) -> np.ndarray:
    image = decode_image(path, cv2.IMREAD_UNCHANGED)
    if image is None or image.dtype != np.uint16:
        raise InputError(f"{path} is no 16-bit PNG of {what}.")
    return image


def _fill_unknown(depth: np.ndarray, known: np.ndarray, scene: Scene) -> Depth:
    """Return depth at the size of the frames; where it is not known as far as the furthest, without confidence."""
    return Placement(0, 0, depth.shape[1], depth.shape[0]).place_depth(depth, known, scene)


def _disparity(path: Path, scene: Scene) -> Depth:
    if path.suffix.lower() == ".png":
        values = _map(path, _read_png(path, "disparities"), scene) / np.float32(65535)
    else:
        values = _map(path, read_npy(path), scene)
    known = np.isfinite(values) & (values > 1e-6)
    return _fill_unknown(1 / np.where(known, values, 1), known, scene)


def _mosca(path: Path, scene: Scene) -> Depth:
    arrays = read_npz(path, ("dep",))
    if "dep" not in arrays:
        raise InputError(f"{path} has no array 'dep' as MoSca's depth has.")
    values = _map(path, arrays["dep"], scene)
    known = np.isfinite(values) & (values > 1e-3)
    return _fill_unknown(values, known, scene)
