"""Cameras and depth of networks that look at all frames at once: Depth Anything 3 and VGGT, one ``.npz`` each.

| whose | content |
| --- | --- |
| Depth Anything 3 (``npz``, ``mini_npz``) | ``depth`` [N, h, w]; with cameras ``extrinsics`` [N, 3, 4], ``intrinsics`` [N, 3, 3] |
| VGGT (``predictions.npz`` of its demo) | ``depth`` [N, h, w, 1], ``extrinsic`` [N, 3, 4], ``intrinsic`` [N, 3, 3], ``images`` |

https://github.com/ByteDance-Seed/Depth-Anything-3 (``utils/io/input_processor.py``), https://github.com/facebookresearch/vggt
(``utils/load_fn.py``). Poses lead from the world to the camera, and intrinsics are in pixels of the depth. Depth Anything 3 makes
one side of an image 504 pixels (or what it is told), and resizes, or crops, both to multiples of 14. VGGT makes it 518 wide and
its height a multiple of 14, cropped to 518 around the middle; or it pads to a square, with white after it has rounded, or with
black and without rounding: its ``images`` [N, 3, h, w] tell. Their confidences have no unit and are not used.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.files import read_npz
from flowsplat.geometry import Camera
from flowsplat.geometry.cameras import rigid
from flowsplat.priors.given.fitting import PATCH_SIDE, Placement, compute_max_bytes, require_frames, require_shape, rounds_to
from flowsplat.scenes import Depth, Scene

DEPTH_ANYTHING, VGGT = "Depth Anything 3", "VGGT"
_CAMERAS = {DEPTH_ANYTHING: ("extrinsics", "intrinsics"), VGGT: ("extrinsic", "intrinsic")}
ARRAYS = ("depth", "extrinsics", "intrinsics", "extrinsic", "intrinsic")
MAX_ROUNDING = PATCH_SIDE / 2 + 1
"""Pixels by which a side may differ from the shape of the frames once it is a multiple of ``PATCH_SIDE``: half of that, and one
because the working size is rounded, too."""
BORDER_VALUES = {"pad": 1.0, "square": 0.0}
"""What VGGT pads its images with, by what it does: white, or black."""


def find_maker(arrays: dict[str, np.ndarray], with_cameras: bool) -> str | None:
    """Return whose archive it is; None if it is of neither, or lacks the cameras that are asked for."""
    if "depth" not in arrays:
        return None
    found = next((maker for maker, names in _CAMERAS.items() if set(names) <= arrays.keys()), None)
    return found if found or with_cameras else DEPTH_ANYTHING


def read_cameras(path: Path, arrays: dict[str, np.ndarray], maker: str, scene: Scene) -> list[Camera]:
    """Return one camera a frame, at the size of the frames.

    Raises:
        InputError: not of this clip, or it cannot be told how its images were made.
    """
    poses, K = (_without_batch(arrays[name], 3) for name in _CAMERAS[maker])
    if poses.ndim != 3 or poses.shape[1:] not in ((3, 4), (4, 4)) or K.shape != (len(poses), 3, 3):
        raise InputError(f"{path} is not as {maker} writes it: {_CAMERAS[maker][0]} {poses.shape}, {_CAMERAS[maker][1]} {K.shape}.")
    require_frames(path, len(poses), scene, "cameras")
    placement = _place(path, _read_depth(path, arrays, maker), maker, scene)
    return [placement.camera(rigid(pose[:3, :3], pose[:3, 3]), k, scene) for pose, k in zip(poses, K, strict=True)]


class FeedForwardDepth:
    """The depth of one result."""

    def __init__(self, path: Path, arrays: dict[str, np.ndarray], maker: str, scene: Scene):
        """Take it from the arrays of ``path``.

        Raises:
            InputError: not of this clip, or it cannot be told how its images were made.
        """
        self._depth, self._scene = _read_depth(path, arrays, maker), scene
        require_frames(path, len(self._depth), scene, "depth maps")
        self._placement = _place(path, self._depth, maker, scene)

    def __call__(self, i: int) -> Depth:
        """Return depth of frame ``i`` in the network's units, at the size of the frames; no confidence where it has none."""
        depth = self._depth[i].astype(np.float32)
        return self._placement.place_depth(depth, np.isfinite(depth) & (depth > 0), self._scene)


def _without_batch(array: np.ndarray, ndim: int) -> np.ndarray:
    return array[0] if array.ndim == ndim + 1 and len(array) == 1 else array


def _read_depth(path: Path, arrays: dict[str, np.ndarray], maker: str) -> np.ndarray:
    """Return depth [N, h, w]."""
    depth = arrays["depth"]
    depth = depth[..., 0] if depth.ndim > 3 and depth.shape[-1] == 1 else depth
    depth = _without_batch(depth, 3)
    if depth.ndim != 3 or depth.dtype.kind != "f" or not depth.size:
        raise InputError(f"{path} is not as {maker} writes it: depth has shape {arrays['depth'].shape}.")
    return depth


def _place(path: Path, depth: np.ndarray, maker: str, scene: Scene) -> Placement:
    height, width = depth.shape[1:]
    place = _place_depth_anything if maker == DEPTH_ANYTHING else _place_vggt
    placement = place(path, width, height, scene)
    if placement is None:
        require_shape(path, width, height, scene)
        return Placement(0, 0, width, height)
    return placement


def _place_depth_anything(path: Path, width: int, height: int, scene: Scene) -> Placement | None:
    """Return where the frame lies; None where the tool makes no images of this size."""
    for bound in (max, min):
        scale = bound(width, height) / bound(scene.width, scene.height)
        whole = round(scene.width * scale), round(scene.height * scale)
        left, top = whole[0] - width, whole[1] - height
        # What resizing gives too is resized: that is its default.
        if max(left, top) > MAX_ROUNDING and min(left, top) >= 0 and max(left, top) < PATCH_SIDE:
            return Placement(-(left // 2), -(top // 2), *whole)
    return Placement(0, 0, width, height) if rounds_to(width, height, PATCH_SIDE, scene) else None


def _place_vggt(path: Path, width: int, height: int, scene: Scene) -> Placement | None:
    """Return where the frame lies; None where the tool makes no images of this size.

    Raises:
        InputError: several ways of making them are possible, and the file has no images to tell.
    """
    exact = scene.height * width / scene.width
    if abs(exact - height) <= MAX_ROUNDING:
        return Placement(0, 0, width, height)
    if width != height:
        return None
    landscape = scene.width > scene.height
    short = min(scene.width, scene.height) * width / max(scene.width, scene.height)
    rounded = round(short / PATCH_SIDE) * PATCH_SIDE
    borders = {"pad": ((width - rounded) // 2, rounded), "square": ((width - short) / 2, short)}
    images = read_npz(path, ("images",), compute_max_bytes(scene)).get("images")
    images = None if images is None else _without_batch(images, 4)
    if images is None or images.ndim != 4 or images.shape[1:] != (3, height, width):
        raise InputError(
            f"{path} has images of {width}x{height} pixels, which VGGT makes from frames of {scene.width}x{scene.height} in more "
            "than one way (cropped or padded): keep its array images in the file, which tells."
        )
    for how, (start, length) in borders.items():
        placement = Placement(0, start, width, length) if landscape else Placement(start, 0, length, height)
        if _has_border(images, placement, BORDER_VALUES[how]):
            return placement
    if landscape:
        return None
    tall = round(exact / PATCH_SIDE) * PATCH_SIDE
    return Placement(0, -((tall - height) // 2), width, tall)


def _has_border(images: np.ndarray, placement: Placement, value: float) -> bool:
    """Return whether images [N, 3, H, W] have one value all around what the frame covers."""
    outside = np.ones(images.shape[2:], bool)
    right, bottom = placement.left + placement.width, placement.top + placement.height
    outside[int(placement.top) : int(np.ceil(bottom)), int(placement.left) : int(np.ceil(right))] = False
    return bool(np.isclose(images[:, :, outside], value, atol=1e-3).all())
