"""The NVIDIA Dynamic Scenes: twelve fixed cameras in an arc, of which one at a time makes the clip.

Two layouts, both with the cameras in ``poses_bounds.npy`` (LLFF): [N, 17], fifteen numbers of a 3x5 matrix by rows (camera to
world with the axes down, right, back; the fifth column is height, width, focal length), then near and far.

- Raw (NSFF): ``mv_images/{time:05d}/cam{01..12}.jpg``. Camera ``time % 12`` makes the clip; all others are the test at every time,
  with objects in ``mv_masks/{time:05d}/cam{01..12}.png``.
- Twelve (DynamicNeRF, RoDynRF): ``images/000.png`` ..., image i is camera i at time i; the test is camera 0 at every time,
  ``v000_t{time:03d}.png``.

The cameras are calibrated and stay as they are; the masks are read by the evaluation only.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.files import read_npy
from flowsplat.geometry import Camera
from flowsplat.geometry.cameras import MAX_COORDINATE, rigid
from flowsplat.scenes.clip import InputOptions
from flowsplat.scenes.formats.images import list_images
from flowsplat.scenes.formats.posed import PosedClip, PosedImage, PosedView, open_posed

POSES = "poses_bounds.npy"
RAW_IMAGES, RAW_MASKS = "mv_images", "mv_masks"
CAMERAS = 12
"""Cameras of the rig of Yoon et al. 2020."""
TARGET = "v000_t*.png"


def is_nvidia(folder: Path) -> bool:
    """Return whether a folder has one of the two layouts."""
    return (folder / POSES).exists() and ((folder / RAW_IMAGES).is_dir() or (folder / "images").is_dir())


def open_nvidia(folder: Path, options: InputOptions) -> PosedClip:
    """Open a scene of either layout with its cameras and its held-out views.

    Raises:
        InputError: a file is missing, damaged or does not fit.
    """
    folder = Path(folder)
    cameras = read_poses_bounds(folder / POSES)
    return (_open_raw if (folder / RAW_IMAGES).is_dir() else _open_twelve)(folder, options, cameras)


def read_poses_bounds(path: Path) -> list[Camera]:
    """Return the cameras of an LLFF file, at the sizes that it names; their principal point is the middle of the image.

    Raises:
        InputError: missing, damaged, or not of this form.
    """
    rows = read_npy(path)
    if rows.ndim != 2 or rows.shape[1] != 17 or rows.dtype.kind != "f":
        raise InputError(f"{path} must hold [N, 17] numbers, 15 of a pose and 2 of its bounds, one row a camera.")
    return [_llff_camera(row[:15].reshape(3, 5).astype(np.float64), f"{path}, row {n}") for n, row in enumerate(rows)]


def _llff_camera(pose: np.ndarray, where: str) -> Camera:
    down, right, back, center, (height, width, focal) = pose.T
    rotation = np.stack([right, down, -back])  # rows: the camera's axes in the world
    if not (np.abs(pose) <= MAX_COORDINATE).all() or min(height, width, focal) <= 0 or np.linalg.det(rotation) <= 0:
        raise InputError(f"{where} is no camera: it needs a rotation, and a height, a width and a focal length above 0.")
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Camera(rigid(rotation, -rotation @ center), K, round(width), round(height))


# -- raw


def _open_raw(folder: Path, options: InputOptions, cameras: list[Camera]) -> PosedClip:
    times = sorted(int(path.name) for path in (folder / RAW_IMAGES).iterdir() if path.is_dir() and path.name.isdecimal())
    if times != list(range(len(times))) or not times:
        raise InputError(f"{folder / RAW_IMAGES} must hold a folder for every time, 00000, 00001 and so on without a gap.")
    if len(cameras) != CAMERAS and len(cameras) < max(len(times), CAMERAS):
        raise InputError(
            f"{folder / POSES} has {len(cameras)} rows: it needs {CAMERAS}, one a camera, or one for each of {len(times)} times."
        )
    # Row n is the image at time n, by camera n % 12; the first twelve rows are the cameras.
    rows = cameras if len(cameras) >= len(times) else [cameras[t % CAMERAS] for t in times]
    images = [_raw_image(folder, t, t % CAMERAS, rows[t]) for t in times]
    views = [
        PosedView(f"cam{c + 1:02d}_{t:05d}", t, _raw_image(folder, t, c, cameras[c]))
        for t in times
        for c in range(CAMERAS)
        if c != t % CAMERAS
    ]
    return open_posed(folder, options, images, views, notes=["Camera t % 12 makes the clip, all others are the test."])


def _raw_image(folder: Path, time: int, camera: int, pose: Camera) -> PosedImage:
    """Camera ``camera`` (0 to 11; the files count from 1) at a time."""
    name = f"{time:05d}/cam{camera + 1:02d}"
    mask = folder / RAW_MASKS / f"{name}.png"
    return PosedImage(folder / RAW_IMAGES / f"{name}.jpg", pose, mask if mask.exists() else None)


# -- twelve images


def _open_twelve(folder: Path, options: InputOptions, cameras: list[Camera]) -> PosedClip:
    paths = list_images(folder / "images")
    if len(paths) != len(cameras):
        raise InputError(f"{folder} has {len(paths)} images in images/ but {len(cameras)} cameras in {POSES}.")
    targets = target_folder(folder)
    images = [PosedImage(path, camera) for path, camera in zip(paths, cameras, strict=True)]
    views = [PosedView(f"v000_t{t:03d}", t, PosedImage(targets / f"v000_t{t:03d}.png", cameras[0])) for t in range(len(images))]
    return open_posed(folder, options, images, views, notes=["Image i is camera i at time i; camera 0 is the test."])


def target_folder(folder: Path) -> Path:
    """Return where the images by camera 0 lie: in the scene's folder, in its ``gt/``, or in ``gt/<scene>/`` beside it.

    Raises:
        InputError: in none of them.
    """
    folder = Path(folder).resolve()
    places = (folder, folder / "gt", folder.parent / "gt" / folder.name)
    for place in places:
        if any(place.glob(TARGET)):
            return place
    raise InputError(
        f"{folder} has {POSES} but no v000_t000.png and so on (camera 0 at every time), neither in it nor in gt/ nor in "
        f"../gt/{folder.name}/: give them, or give its images/ to use the images alone."
    )
