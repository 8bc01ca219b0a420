"""Scenes in the layout of Nerfies and DyCheck, as Dynamic Gaussian Marbles ships the NVIDIA scenes.

| file | content |
| --- | --- |
| ``splits/train.json``, ``splits/val.json`` | ``frame_names``, ``time_ids``, ``camera_ids``: the clip, and the test |
| ``camera/<frame name>.json`` | ``focal_length``, ``principal_point``, ``image_size`` (width, height), ``orientation`` (world to camera), ``position`` (of the camera), ``pixel_aspect_ratio``, ``skew``, ``radial_distortion``, ``tangential_distortion``; OpenCV |
| ``rgb/1x/<frame name>.png`` | images of that size |
| ``covisible/2x/val/<frame name>.png`` | DyCheck: what of a test image the clip saw, 0 = not; also under ``1x`` or ``4x`` |
| ``keypoint/2x/train/<frame name>.json`` | DyCheck: points that people marked, for its benchmark alone (``flowsplat_benchmarks``) |

On NVIDIA, camera 4 is the clip and 3, 5 and 6 are the test, at half size; the splits say so. Depth, segmentation and tracks that lie
beside them come from networks and are not read (``--given.depth`` and its like take files of one's own).
"""  # noqa: E501 (a row of a table)

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.files import plain_name, read_json
from flowsplat.geometry import Camera
from flowsplat.geometry.cameras import MAX_COORDINATE, rigid
from flowsplat.scenes.clip import InputOptions
from flowsplat.scenes.formats.posed import PosedClip, PosedImage, PosedView, open_posed

IMAGES = "rgb/1x"
COVISIBLE = tuple(f"covisible/{factor}x/val" for factor in (2, 1, 4))
"""Where the masks of what the clip saw may be, by how many times smaller than the camera says they are; the first that is there
counts."""


def is_nerfies(folder: Path) -> bool:
    """Return whether a folder has this layout."""
    return (folder / "camera").is_dir() and (folder / "splits").is_dir()


def open_nerfies(folder: Path, options: InputOptions) -> PosedClip:
    """Open a scene with its cameras and its held-out views.

    Raises:
        InputError: a file is missing, damaged or does not fit.
    """
    folder = Path(folder)
    train, test = _read_split(folder, "train"), _read_split(folder, "val")
    times = [time for _, time, _ in train]
    if len(set(times)) < len(times):
        raise InputError(f"{folder / 'splits/train.json'} has two images at one time: a clip has one.")
    views = [
        PosedView(name, time, replace(_image(folder, name), covisible=_find_covisible(folder, name))) for name, time, _ in test
    ]
    cameras = [", ".join(sorted({camera for _, _, camera in split}, key=lambda c: (len(c), c))) for split in (train, test)]
    note = f"Camera {cameras[0]} makes the clip, {cameras[1] or 'none'} the test."
    return open_posed(folder, options, [_image(folder, name) for name, _, _ in train], views, times, [note])


def list_training_names(folder: Path) -> list[str]:
    """Return the names of the frames of the clip, in order.

    Raises:
        InputError: their list is missing or damaged.
    """
    return [name for name, _, _ in _read_split(folder, "train")]


def _read_split(folder: Path, split: str) -> list[tuple[str, int, str]]:
    """Return (frame name, time, camera) sorted by time."""
    path = folder / "splits" / f"{split}.json"
    values = read_json(path)
    try:
        rows = zip(values["frame_names"], values["time_ids"], values["camera_ids"], strict=True)
        found = [(str(name), int(time), str(camera)) for name, time, camera in rows]
    except (KeyError, TypeError, ValueError, ArithmeticError) as error:
        raise InputError(f"{path} must hold frame_names, time_ids and camera_ids, as many of each: {error}.") from error
    for name, time, _ in found:
        plain_name(name, f"{path}: the image")
        if not 0 <= time < 10_000_000:
            raise InputError(f"{path}: {name!r} is at time {time}.")
    return sorted(found, key=lambda row: row[1])


def _image(folder: Path, name: str) -> PosedImage:
    return PosedImage(folder / IMAGES / f"{name}.png", read_camera(folder / "camera" / f"{name}.json"))


def _find_covisible(folder: Path, name: str) -> Path | None:
    paths = (folder / masks / f"{name}.png" for masks in COVISIBLE)
    return next((path for path in paths if path.exists()), None)


def read_camera(path: Path) -> Camera:
    """Return a camera of this layout, at its ``image_size``.

    Raises:
        InputError: missing, damaged, or with skew or distortion, which a pinhole has not.
    """
    values: dict[str, Any] = read_json(path)
    try:
        (width, height), (cx, cy) = values["image_size"], values["principal_point"]
        focal = float(values["focal_length"])
        bent = [values.get("skew", 0.0), *values.get("radial_distortion", ()), *values.get("tangential_distortion", ())]
        R, center = np.array(values["orientation"], float).reshape(3, 3), np.array(values["position"], float).reshape(3)
        if not (np.abs(np.concatenate([R.ravel(), center])) <= MAX_COORDINATE).all():
            raise ValueError("its pose is not finite")
        K = np.array([[focal, 0, cx], [0, focal * float(values.get("pixel_aspect_ratio", 1.0)), cy], [0, 0, 1]], float)
        camera = Camera(rigid(R, -R @ center), K, int(width), int(height))
        is_bent = bool(np.abs(np.array(bent, float)).max() > 0)
    except (KeyError, TypeError, ValueError, ArithmeticError, AttributeError) as error:
        raise InputError(f"{path} does not hold a camera: {error}.") from error
    if is_bent:
        raise InputError(f"{path} has skew or lens distortion: straighten the images first.")
    if not camera.is_valid:
        raise InputError(f"{path}: the camera is not finite or not a rotation.")
    return camera
