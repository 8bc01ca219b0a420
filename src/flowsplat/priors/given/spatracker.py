"""Tracks of SpatialTrackerV2 (https://github.com/henry123-boy/SpaTrackerV2, ``inference.py``), in the world: one ``.npz``.

| array | content |
| --- | --- |
| ``coords``, ``visibs`` | [T, N, 3] in the world, [T, N] or [T, N, 1] whether they are seen |
| ``extrinsics``, ``intrinsics`` | [T, 4, 4] world to camera, [T, 3, 3] in pixels of the images below |
| ``depths`` | [T, h, w]: of these images |

They are seen where the cameras of the file see them. It makes images 518 wide and their height a multiple of 14, cropped to 518
around the middle, and then, all sides alike, at most 336 long.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.priors.given.fitting import PATCH_SIDE, Placement, require_shape
from flowsplat.scenes import Scene

MAKER = "SpatialTrackerV2"
ARRAYS = ("coords", "visibs", "extrinsics", "intrinsics", "depths")
NETWORK_SIDE, STORED_SIDE = 518, 336
"""Pixels of the width that the network sees, and of the longer side of what is stored."""


def read_points(path: Path, arrays: dict[str, np.ndarray], scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return [T, N, 2] pixels of the frames with whole numbers at pixel centers, and [T, N] whether they are seen.

    Raises:
        InputError: of other shapes, or of images of another shape than the frames.
    """
    coords, seen, poses, K, depths = (arrays[name] for name in ARRAYS)
    seen = seen[..., 0] if seen.ndim == 3 and seen.shape[2] == 1 else seen
    frames = len(coords)
    shapes = coords.shape[2:], seen.shape, poses.shape, K.shape, depths.shape[:1]
    if coords.ndim != 3 or shapes != ((3,), coords.shape[:2], (frames, 4, 4), (frames, 3, 3), (frames,)) or depths.ndim != 3:
        raise InputError(
            f"{path} is not as {MAKER} writes it: coords {coords.shape}, visibs {seen.shape}, extrinsics {poses.shape}, "
            f"intrinsics {K.shape}, depths {depths.shape}."
        )
    place = _place(path, depths.shape[2], depths.shape[1], scene)
    with np.errstate(all="ignore"):  # what is not finite is not seen
        there = np.einsum("tij,tnj->tni", poses[:, :3, :3].astype(np.float64), coords) + poses[:, None, :3, 3]
        uvw = np.einsum("tij,tnj->tni", K.astype(np.float64), there)
        pixels = uvw[..., :2] / uvw[..., 2:] + 0.5 - (place.left, place.top)
        pixels = pixels * (scene.width / place.width, scene.height / place.height) - 0.5
    return pixels, np.where(there[..., 2] > 0, seen, 0)


def _place(path: Path, width: int, height: int, scene: Scene) -> Placement:
    exact = scene.height * NETWORK_SIDE / scene.width
    tall = round(exact / PATCH_SIDE) * PATCH_SIDE
    for whole in (tall, tall - PATCH_SIDE, tall + PATCH_SIDE):  # the working size is rounded, too
        shown = min(whole, NETWORK_SIDE)
        scale = STORED_SIDE / NETWORK_SIDE
        if abs(whole - exact) <= PATCH_SIDE / 2 + 1 and (int(NETWORK_SIDE * scale), int(shown * scale)) == (width, height):
            return Placement(0, -((whole - shown) // 2) * scale, NETWORK_SIDE * scale, whole * scale)
    require_shape(path, width, height, scene)
    return Placement(0, 0, width, height)
