"""MegaSaM's results (https://github.com/mega-sam/mega-sam): cameras and depth in one ``.npz``, flow in ``cache_flow``.

| file | content |
| --- | --- |
| ``outputs/*_droid.npz``, ``outputs_cvd/*_sgd_cvd_hr.npz`` | ``depths`` [N, H, W], ``intrinsic`` [3, 3], ``cam_c2w`` [N, 4, 4] |
| ``cache_flow/*/flows.npy``, ``flows_masks.npy`` | [P, 2, h, w] at half the size, [P, 1, h, w] whether the way back agrees |
| ``cache_flow/*/ii-jj.npy`` | [2, P] from which image to which |

Its images are resized and cropped (``fitting.slam_size``). The second ``.npz`` has the better depth.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.files import read_npy, read_npz
from flowsplat.geometry import Camera
from flowsplat.priors.given.fitting import pad_to, require_frames, slam_size
from flowsplat.scenes import Depth, Flow, Scene
from flowsplat.scenes.clip import resize_labels

MAKER = "MegaSaM"

_MAX_CLIPPED_DEPTH = 1.1e-3
"""Depths up to here are where MegaSaM clips, and mean that it has none."""


ARRAYS = ("depths", "intrinsic", "cam_c2w")
_MAX_BYTES_PER_FRAME = 32 * 2**20
"""Bytes: six pairs of flow of an image of 640 x 480. Chosen by eye."""


def compute_max_bytes(scene: Scene) -> int:
    """Return the most bytes of the arrays in one file."""
    return _MAX_BYTES_PER_FRAME * scene.num_frames


def is_megasam(arrays: dict[str, np.ndarray]) -> bool:
    """Return whether an archive has the arrays of MegaSaM's results."""
    return set(ARRAYS) <= arrays.keys()


def read_cameras(path: Path, arrays: dict[str, np.ndarray], scene: Scene) -> list[Camera]:
    """Return one camera a frame, at the size that the whole image had for MegaSaM.

    Raises:
        InputError: not of this clip.
    """
    poses, K = arrays["cam_c2w"], arrays["intrinsic"]
    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or K.shape != (3, 3) or arrays["depths"].ndim != 3:
        raise InputError(f"{path} is not as MegaSaM writes it: cam_c2w {poses.shape}, intrinsic {K.shape}.")
    require_frames(path, len(poses), scene, "cameras")
    width, height = slam_size(path, arrays["depths"].shape[2], arrays["depths"].shape[1], scene)
    try:
        return [Camera(np.linalg.inv(pose.astype(np.float64)), K, width, height) for pose in poses]
    except np.linalg.LinAlgError as error:
        raise InputError(f"{path} holds a pose that is no camera's: {error}.") from error


class MegaSamDepth:
    """The depth of one result."""

    def __init__(self, path: Path, scene: Scene):
        """Open it.

        Raises:
            InputError: missing, damaged or not of this clip.
        """
        arrays = read_npz(path, ARRAYS, most=compute_max_bytes(scene))
        if not is_megasam(arrays):
            raise InputError(f"{path} has no depth of MegaSaM: it needs depths, intrinsic and cam_c2w.")
        self._depths, self._scene = arrays["depths"], scene
        if self._depths.ndim != 3:
            raise InputError(f"{path} is not as MegaSaM writes it: depths has shape {self._depths.shape}.")
        require_frames(path, len(self._depths), scene, "depth maps")
        self._size = slam_size(path, self._depths.shape[2], self._depths.shape[1], scene)

    def __call__(self, i: int) -> Depth:
        """Return depth of frame ``i`` in MegaSaM's units, at the size of the frames; no confidence where it has none."""
        depth = self._depths[i].astype(np.float32)
        known = np.isfinite(depth) & (depth > _MAX_CLIPPED_DEPTH)
        depth = np.where(known, depth, depth[known].max() if known.any() else 1.0)
        whole, certain = pad_to(depth, self._size, mode="edge"), pad_to(known.astype(np.float32), self._size)
        size = (self._scene.width, self._scene.height)
        return Depth(resize_labels(whole, size), resize_labels(certain, size))


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
