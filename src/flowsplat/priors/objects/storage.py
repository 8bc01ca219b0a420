"""The objects of a scene as files.

| file | content |
| --- | --- |
| ``objects.json`` | ``normal`` [3] up, ``ground``: whether there is one; of each of the ``objects`` its ``number`` in the masks, |
| | ``sigma`` of ln distance, whether it is ``rigid``, the ``expected`` shape offset, and the ``cues`` that speak for its distance |
| ``objects.npz`` | ``log_depth`` [M, T] and ``middles`` [M, T, 2] of the objects over the training frames; of all points on them |
| | ``object_id``, ``frame``, ``pixels``, ``point_log_depth`` and ``point_sigma`` |
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta
from typing_extensions import TypedDict

from flowsplat.common.errors import InputError
from flowsplat.common.files import read_json, read_npz, write_json, write_npz
from flowsplat.common.files.arrays import MAX_ARRAY_BYTES
from flowsplat.common.files.json_file import Number, Row3
from flowsplat.geometry import Camera
from flowsplat.priors.objects.distance import Cue
from flowsplat.priors.objects.shape_offset import ShapePoints
from flowsplat.priors.objects.solving import DynamicObject
from flowsplat.scenes import Scene


@dataclass(frozen=True)
class SceneObjects:
    """Everything that is known about the objects of a scene.

    Attributes:
        objects: those with a distance.
        normal: [3] unit vector, up.
        has_ground: whether a ground was found.
    """

    objects: Sequence[DynamicObject]
    normal: np.ndarray
    has_ground: bool = False

    def depth(self, k: int, mask: np.ndarray, image: np.ndarray, camera: Camera) -> np.ndarray:
        """Return planar depth [H, W] float32 of the pixels of objects in training frame k; 0 where none is known.

        Args:
            mask: [H, W] uint8, object numbers.
            image: RGB [H, W, 3] uint8.
        """
        result = np.zeros(mask.shape, np.float32)
        for obj in self.objects:
            inside = mask == obj.number
            if inside.any() and np.isfinite(obj.log_depth[k]):
                result[inside] = obj.depth(k, inside, image, camera, self.normal)
        return result


def save_objects(scene: Scene, found: SceneObjects) -> None:
    """Write the objects into the folder of the scene."""
    objects = found.objects
    frames = len(scene.train_frames)
    arrays: dict[str, np.ndarray] = {
        "log_depth": np.array([m.log_depth for m in objects], np.float32).reshape(len(objects), frames),
        "middles": np.array([m.middles for m in objects], np.float32).reshape(len(objects), frames, 2),
        "object_id": np.repeat([m.number for m in objects], [len(m.points.frame_of) for m in objects]).astype(np.uint8),
    }
    every = [m.points for m in objects] or [ShapePoints.none()]
    arrays |= {
        "frame": np.concatenate([p.frame_of for p in every]).astype(np.int32),
        "pixels": np.concatenate([p.pixels for p in every]).astype(np.float32),
        "point_log_depth": np.concatenate([p.log_depth for p in every]).astype(np.float32),
        "point_sigma": np.concatenate([p.sigma for p in every]).astype(np.float32),
    }
    write_npz(scene.folder / "objects.npz", arrays)
    described = [
        {
            "number": m.number, "sigma": m.sigma, "rigid": m.rigid, "expected": m.expected,
            "cues": {name: asdict(cue) for name, cue in m.cues.items()},
        }
        for m in objects
    ]  # fmt: skip
    write_json(scene.folder / "objects.json", {"normal": found.normal.tolist(), "ground": found.has_ground, "objects": described})


_ARRAYS = ("log_depth", "middles", "object_id", "frame", "pixels", "point_log_depth", "point_sigma")


def _compute_max_bytes(scene: Scene) -> int:
    """Return the most bytes of the arrays: no more points than every fourth pixel of every frame."""
    return MAX_ARRAY_BYTES // 4 + 8 * scene.width * scene.height * scene.num_frames


class ObjectFile(TypedDict):
    """An object in ``objects.json``; more may stand there."""

    number: Annotated[int, Meta(ge=1, le=255)]
    sigma: Number
    rigid: bool
    expected: Number
    cues: dict[str, dict[str, Number]]


class ObjectsFile(TypedDict):
    """What ``objects.json`` holds."""

    normal: Row3
    ground: bool
    objects: list[ObjectFile]


def load_objects(scene: Scene) -> SceneObjects:
    """Return what ``save_objects`` wrote; no objects where nothing was written.

    Raises:
        InputError: damaged.
    """
    path = scene.folder / "objects.json"
    if not path.exists():
        return SceneObjects([], np.array([0.0, -1.0, 0.0]))
    value, arrays = read_json(path, ObjectsFile), read_npz(scene.folder / "objects.npz", _ARRAYS, _compute_max_bytes(scene))
    try:
        objects, (count, frames) = [], (len(value["objects"]), len(scene.train_frames))
        if arrays["log_depth"].shape != (count, frames) or arrays["middles"].shape != (count, frames, 2):
            raise ValueError(f"objects.npz is not of {count} objects in {frames} frames")
        for index, described in enumerate(value["objects"]):
            mine = arrays["object_id"] == described["number"]
            points = ShapePoints(
                arrays["frame"][mine].astype(int), arrays["pixels"][mine].astype(float),
                arrays["point_log_depth"][mine].astype(float), arrays["point_sigma"][mine].astype(float),
            )  # fmt: skip
            cues = {name: Cue(**cue) for name, cue in described["cues"].items()}
            obj = DynamicObject(
                int(described["number"]), arrays["log_depth"][index].astype(float), arrays["middles"][index].astype(float),
                float(described["sigma"]), bool(described["rigid"]), cues, points, float(described["expected"]),
            )  # fmt: skip
            objects.append(obj)
        return SceneObjects(objects, np.array(value["normal"], float), bool(value["ground"]))
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise InputError(f"{path} does not hold objects: {error}.") from error
