"""COLMAP's sparse models, text or binary: https://colmap.github.io/format.html."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from flowsplat.common.errors import InputError
from flowsplat.common.files import read_bytes, read_text
from flowsplat.geometry import Camera
from flowsplat.geometry.cameras import rigid
from flowsplat.geometry.lens import Distortion
from flowsplat.geometry.rotations import quats_to_rotations
from flowsplat.priors.given.gaps import fill_gaps, find_frames
from flowsplat.scenes import Scene
from flowsplat.scenes.formats.images import natural_key

_MAX_IMAGES_BYTES = 256 * 2**20
"""Bytes: the points of all images stand beside them. Chosen by eye."""
PLACES = ("", "0", "sparse", "sparse/0", "colmap/sparse/0")
"""Where in a given folder the model may lie."""

_MODELS = {
    # name: (number in binary files, parameters, how many of them are focal lengths)
    "SIMPLE_PINHOLE": (0, 3, 1),
    "PINHOLE": (1, 4, 2),
    "SIMPLE_RADIAL": (2, 4, 1),
    "RADIAL": (3, 5, 1),
    "OPENCV": (4, 8, 2),
    "OPENCV_FISHEYE": (5, 8, 2),
    "FULL_OPENCV": (6, 12, 2),
    "SIMPLE_RADIAL_FISHEYE": (8, 4, 1),
    "RADIAL_FISHEYE": (9, 5, 1),
}
"""The models whose distortion OpenCV has too, in its order (https://colmap.github.io/cameras.html)."""

_NAMES = {number: name for name, (number, _, _) in _MODELS.items()}


@dataclass(frozen=True)
class _Image:
    """A registered image: its name, camera number, and pose world to camera."""

    name: str
    camera: int
    quat: tuple[float, ...]
    translation: tuple[float, ...]


def find_model(folder: Path) -> Path | None:
    """Return the folder with ``cameras`` and ``images`` in or under ``folder``; None where there is none."""
    for place in PLACES:
        for suffix in (".bin", ".txt"):
            if all((folder / place / f"{name}{suffix}").is_file() for name in ("cameras", "images")):
                return folder / place
    return None


def read_colmap(model: Path, scene: Scene) -> tuple[list[Camera], str, dict[int, Distortion]]:
    """Return one camera a frame, at the size of COLMAP's images, what is to be said about them, and how the lens bends each frame
    that was registered.

    The natural order of the names is that of the frames.

    Raises:
        InputError: damaged, a lens that is not known here, or too many frames in a row were not registered.
    """
    suffix = ".bin" if (model / "cameras.bin").is_file() else ".txt"
    path = model / f"images{suffix}"
    try:
        if suffix == ".bin":
            lenses = _binary_cameras(read_bytes(model / "cameras.bin"))
            images = _binary_images(read_bytes(path, _MAX_IMAGES_BYTES))
        else:
            lenses = _text_cameras(read_text(model / "cameras.txt"))
            images = _text_images(read_text(path, _MAX_IMAGES_BYTES))
    except (struct.error, ValueError, IndexError, OverflowError) as error:
        raise InputError(f"{model} is no readable COLMAP model (damaged or truncated): {error}.") from error
    images = sorted(images, key=lambda image: natural_key(Path(image.name)))
    frames = find_frames(path, [image.name for image in images], scene, "registered images")
    cameras, distortions = {}, {}
    for frame, image in zip(frames, images, strict=True):
        if image.camera not in lenses:
            raise InputError(f"{path}: {image.name} has camera {image.camera}, which cameras{suffix} does not hold.")
        name, width, height, parameters = lenses[image.camera]
        K, distortions[frame] = _lens(name, parameters)
        rotation = quats_to_rotations(torch.tensor(image.quat, dtype=torch.float64)).numpy()
        cameras[frame] = Camera(rigid(rotation, image.translation), K, width, height)
    return *fill_gaps(path, cameras, scene), distortions


def _lens(name: str, parameters: tuple[float, ...]) -> tuple[np.ndarray, Distortion]:
    """Return K [3, 3] and the distortion."""
    focals = _MODELS[name][2]
    fx, fy = parameters[0], parameters[focals - 1]
    cx, cy, *distortion = parameters[focals:]
    distortion += [0.0] * (4 - len(distortion))
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), Distortion(tuple(distortion), name.endswith("FISHEYE"))


_Lenses = dict[int, tuple[str, int, int, tuple[float, ...]]]


def _check_parameters(name: str, parameters: tuple[float, ...]) -> str:
    if name not in _MODELS:
        raise InputError(
            f"COLMAP's camera model {name} is no pinhole: undistort the images first (colmap image_undistorter), and give the "
            f"model of the undistorted ones. Undone here are only {', '.join(list(_MODELS)[2:])}."
        )
    if len(parameters) != _MODELS[name][1]:
        raise ValueError(f"{name} has {len(parameters)} parameters instead of {_MODELS[name][1]}")
    return name


def _text_lines(text: str) -> list[str]:
    return [line.strip() for line in text.splitlines() if not line.startswith("#")]


def _text_cameras(text: str) -> _Lenses:
    lenses: _Lenses = {}
    for line in filter(None, _text_lines(text)):
        number, name, width, height, *rest = line.split()
        parameters = tuple(map(float, rest))
        lenses[int(number)] = (_check_parameters(name, parameters), int(width), int(height), parameters)
    return lenses


def _text_images(text: str) -> list[_Image]:
    images = []
    # Every second line holds an image's points, and may be empty.
    for line in filter(None, _text_lines(text)[::2]):
        _, *pose, camera, name = line.split(maxsplit=9)
        values = tuple(map(float, pose))
        if len(values) != 7:
            raise ValueError(f"the pose of {name!r:.50} has {len(values)} numbers, not 7")
        images.append(_Image(name, int(camera), values[:4], values[4:]))
    return images


class _Bytes:
    """Little-endian values read one after the other."""

    def __init__(self, data: bytes):
        self._data, self._at = data, 0

    def take(self, form: str) -> tuple:
        values = struct.unpack_from("<" + form, self._data, self._at)
        self._at += struct.calcsize("<" + form)
        return values

    def text(self) -> str:
        end = self._data.index(b"\0", self._at)
        text = self._data[self._at : end].decode()
        self._at = end + 1
        return text

    def skip(self, count: int) -> None:
        self._at += count
        if self._at > len(self._data):
            raise ValueError("it ends within an image's points")


def _binary_cameras(data: bytes) -> _Lenses:
    source = _Bytes(data)
    lenses: _Lenses = {}
    for _ in range(*source.take("Q")):
        number, model, width, height = source.take("iiQQ")
        name = _count_parameters(model)
        lenses[number] = (name, width, height, source.take(f"{_MODELS[name][1]}d"))
    return lenses


def _count_parameters(model: int) -> str:
    return _NAMES[model] if model in _NAMES else _check_parameters(f"number {model}", ())


def _binary_images(data: bytes) -> list[_Image]:
    source = _Bytes(data)
    images = []
    for _ in range(*source.take("Q")):
        _, *pose = source.take("i7d")
        (camera,) = source.take("i")
        name = source.text()
        images.append(_Image(name, camera, tuple(pose[:4]), tuple(pose[4:])))
        (points,) = source.take("Q")
        source.skip(24 * points)  # x, y and the number of the point
    return images
