"""MegaSaM's results (https://github.com/mega-sam/mega-sam): cameras and depth in one ``.npz``, flow in ``cache_flow``.

| file | content |
| --- | --- |
| ``outputs/*_droid.npz``, ``outputs_cvd/*_sgd_cvd_hr.npz`` | ``depths`` [N, H, W], ``intrinsic`` [3, 3], ``cam_c2w`` [N, 4, 4] |
| ``cache_flow/*/flows.npy``, ``flows_masks.npy`` | [P, 2, h, w] at half the size, [P, 1, h, w] whether the way back agrees |
| ``cache_flow/*/ii-jj.npy`` | [2, P] from which image to which |

Its images are resized and cropped (``fitting.slam_size``); forks resize them to sides that are multiples of 8 or of 14, a little
more in one direction. The principal point, which is in the middle of the whole image, tells them apart. The second ``.npz`` has the
better depth.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.files import read_npy
from flowsplat.geometry import Camera
from flowsplat.priors.given.fitting import (
    PATCH_SIDE,
    SLAM_MULTIPLE,
    Placement,
    compute_max_bytes,
    pad_to,
    require_frames,
    rounds_to,
    slam_size,
)
from flowsplat.scenes import Depth, Flow, Scene
from flowsplat.scenes.clip import resize_labels

MAKER = "MegaSaM"

_MAX_CLIPPED_DEPTH = 1.1e-3
"""Depths up to here are where MegaSaM clips, and mean that it has none."""
MAX_CENTER_ERROR = 0.25
"""Pixels by which twice the principal point may differ from a side that it tells: MegaSaM stores an eighth of it as float32, and
sides are whole numbers. Chosen by eye."""


ARRAYS = ("depths", "intrinsic", "cam_c2w")


def is_megasam(arrays: dict[str, np.ndarray]) -> bool:
    """Return whether an archive has the arrays of MegaSaM's results."""
    return set(ARRAYS) <= arrays.keys()


def read_cameras(path: Path, arrays: dict[str, np.ndarray], scene: Scene) -> list[Camera]:
    """Return one camera a frame, at the size that the whole image had for MegaSaM.

    Raises:
        InputError: not of this clip.
    """
    poses, K = arrays["cam_c2w"], arrays["intrinsic"]
    if poses.ndim != 3 or poses.shape[1:] != (4, 4):
        raise InputError(f"{path} is not as MegaSaM writes it: cam_c2w has shape {poses.shape}.")
    require_frames(path, len(poses), scene, "cameras")
    placement = _place(path, arrays, scene)
    try:
        return [placement.camera(np.linalg.inv(pose.astype(np.float64)), K, scene) for pose in poses]
    except np.linalg.LinAlgError as error:
        raise InputError(f"{path} holds a pose that is no camera's: {error}.") from error


def _place(path: Path, arrays: dict[str, np.ndarray], scene: Scene) -> Placement:
    """Return where the whole frame lies in MegaSaM's images.

    Raises:
        InputError: no images of this clip.
    """
    depths, K = arrays["depths"], arrays["intrinsic"]
    if depths.ndim != 3 or K.shape != (3, 3):
        raise InputError(f"{path} is not as MegaSaM writes it: depths {depths.shape}, intrinsic {K.shape}.")
    height, width = depths.shape[1:]
    whole = 2 * K[:2, 2].astype(np.float64)
    for multiple in (SLAM_MULTIPLE, PATCH_SIDE):
        if rounds_to(width, height, multiple, scene):
            if np.abs(whole - (width, height)).max() <= MAX_CENTER_ERROR:
                return Placement(0, 0, width, height)
            cut = whole - (width, height)
            if (cut > -MAX_CENTER_ERROR).all() and (cut < multiple).all():
                return Placement(0, 0, *whole)
    return Placement(0, 0, *slam_size(path, width, height, scene))


class MegaSamDepth:
    """The depth of one result."""

    def __init__(self, path: Path, arrays: dict[str, np.ndarray], scene: Scene):
        """Take it from the arrays of ``path``.

        Raises:
            InputError: not of MegaSaM, or not of this clip.
        """
        if not is_megasam(arrays):
            raise InputError(f"{path} has no depth of MegaSaM: it needs depths, intrinsic and cam_c2w.")
        self._depths, self._scene = arrays["depths"], scene
        self._placement = _place(path, arrays, scene)
        require_frames(path, len(self._depths), scene, "depth maps")

    def __call__(self, i: int) -> Depth:
        """Return depth of frame ``i`` in MegaSaM's units, at the size of the frames; no confidence where it has none."""
        depth = self._depths[i].astype(np.float32)
        return self._placement.place_depth(depth, np.isfinite(depth) & (depth > _MAX_CLIPPED_DEPTH), self._scene)


def is_flow_cache(folder: Path) -> bool:
    """Return whether a folder is a ``cache_flow`` of MegaSaM."""
    return (folder / "flows.npy").is_file() and (folder / "ii-jj.npy").is_file()


def read_flow(folder: Path, wanted: list[tuple[int, int]], scene: Scene) -> list[Flow]:
    """Return the flow of those wanted pairs of frames that it has, at the size of the frames.

    Raises:
        InputError: damaged or not of this clip.
    """
    most = compute_max_bytes(scene)
    flows, pairs = read_npy(folder / "flows.npy", most), read_npy(folder / "ii-jj.npy", most)
    masks = read_npy(folder / "flows_masks.npy", most)
    is_flow = flows.ndim == 4 and flows.shape[1] == 2 and flows.size > 0 and pairs.dtype.kind in "iu"
    if not is_flow or pairs.shape != (2, len(flows)) or masks.shape != (len(flows), 1, *flows.shape[2:]):
        raise InputError(
            f"{folder} is not as MegaSaM writes it: flows {flows.shape}, ii-jj {pairs.shape}, flows_masks {masks.shape}."
        )
    require_frames(folder, int(pairs.max()) + 1, scene, "images")
    height, width = flows.shape[2:]
    whole = slam_size(folder, 2 * width, 2 * height, scene)
    half = (-(-whole[0] // 2), -(-whole[1] // 2))
    size, scale = (scene.width, scene.height), np.array([scene.width, scene.height], np.float32) / whole
    position = {(int(i), int(j)): p for p, (i, j) in enumerate(pairs.T)}
    found = []
    for i, j in wanted:
        if (i, j) in position:
            p = position[i, j]
            flow = pad_to(flows[p].astype(np.float32).transpose(1, 2, 0), half, mode="edge") * 2 * scale
            known = pad_to(masks[p].reshape(height, width).astype(np.float32), half)
            found.append(Flow(i, j, cv2.resize(flow, size, interpolation=cv2.INTER_LINEAR), resize_labels(known, size)))
    return found
