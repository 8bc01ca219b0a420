"""The movers of a scene as files.

| file | content |
| --- | --- |
| ``objects.json`` | ``normal`` [3] up, ``ground``: whether there is one; of each of the ``movers`` its ``number`` in the masks, |
| | ``sigma`` of ln distance, whether it is ``rigid``, the ``expected`` relief, and the ``cues`` that speak for its distance |
| ``objects.npz`` | ``log_depth`` [M, T] and ``middles`` [M, T, 2] of the movers over the training frames; of all points on them |
| | ``mover``, ``frame``, ``pixels``, ``point_log_depth`` and ``point_sigma`` |
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
from flowsplat.common.files.arrays import MOST_BYTES
from flowsplat.common.files.json_file import Number, Row3
from flowsplat.geometry import Camera
from flowsplat.priors.objects.distance import Cue
from flowsplat.priors.objects.movers import Mover
from flowsplat.priors.objects.relief import ReliefPoints
from flowsplat.scenes import Scene


@dataclass(frozen=True)
class SceneMovers:
    """Everything that is known about the movers of a scene.

    Attributes:
        movers: those with a distance.
        normal: [3] unit vector, up.
        has_ground: whether a ground was found.
    """

    movers: Sequence[Mover]
    normal: np.ndarray
    has_ground: bool = False

    def depth(self, k: int, mask: np.ndarray, picture: np.ndarray, camera: Camera) -> np.ndarray:
        """Planar depth [H, W] float32 of the pixels of movers in training frame k; 0 where none is known.

        Args:
            mask: [H, W] uint8, object numbers.
            picture: RGB [H, W, 3] uint8.
        """
        result = np.zeros(mask.shape, np.float32)
        for mover in self.movers:
            inside = mask == mover.number
            if inside.any() and np.isfinite(mover.log_depth[k]):
                result[inside] = mover.depth(k, inside, picture, camera, self.normal)
        return result


def save_movers(scene: Scene, found: SceneMovers) -> None:
    """Write the movers into the folder of the scene."""
    movers = found.movers
    frames = len(scene.train_frames)
    arrays: dict[str, np.ndarray] = {
        "log_depth": np.array([m.log_depth for m in movers], np.float32).reshape(len(movers), frames),
        "middles": np.array([m.middles for m in movers], np.float32).reshape(len(movers), frames, 2),
        "mover": np.repeat([m.number for m in movers], [len(m.points.frame_of) for m in movers]).astype(np.uint8),
    }
    every = [m.points for m in movers] or [ReliefPoints.none()]
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
        for m in movers
    ]  # fmt: skip
    write_json(scene.folder / "objects.json", {"normal": found.normal.tolist(), "ground": found.has_ground, "movers": described})


_ARRAYS = ("log_depth", "middles", "mover", "frame", "pixels", "point_log_depth", "point_sigma")


def _most_bytes(scene: Scene) -> int:
    """Of the arrays: no more points than every fourth pixel of every frame."""
    return MOST_BYTES // 4 + 8 * scene.width * scene.height * scene.num_frames


class MoverFile(TypedDict):
    """A mover in ``objects.json``; more may stand there."""

    number: Annotated[int, Meta(ge=1, le=255)]
    sigma: Number
    rigid: bool
    expected: Number
    cues: dict[str, dict[str, Number]]


class ObjectsFile(TypedDict):
    """What ``objects.json`` holds."""

    normal: Row3
    ground: bool
    movers: list[MoverFile]


def load_movers(scene: Scene) -> SceneMovers:
    """What ``save_movers`` wrote; no movers where nothing was written.

    Raises:
        InputError: damaged.
    """
    path = scene.folder / "objects.json"
    if not path.exists():
        return SceneMovers([], np.array([0.0, -1.0, 0.0]))
    value, arrays = read_json(path, ObjectsFile), read_npz(scene.folder / "objects.npz", _ARRAYS, _most_bytes(scene))
    try:
        movers, (count, frames) = [], (len(value["movers"]), len(scene.train_frames))
        if arrays["log_depth"].shape != (count, frames) or arrays["middles"].shape != (count, frames, 2):
            raise ValueError(f"objects.npz is not of {count} movers in {frames} frames")
        for index, described in enumerate(value["movers"]):
            mine = arrays["mover"] == described["number"]
            points = ReliefPoints(
                arrays["frame"][mine].astype(int), arrays["pixels"][mine].astype(float),
                arrays["point_log_depth"][mine].astype(float), arrays["point_sigma"][mine].astype(float),
            )  # fmt: skip
            cues = {name: Cue(**cue) for name, cue in described["cues"].items()}
            mover = Mover(
                int(described["number"]), arrays["log_depth"][index].astype(float), arrays["middles"][index].astype(float),
                float(described["sigma"]), bool(described["rigid"]), cues, points, float(described["expected"]),
            )  # fmt: skip
            movers.append(mover)
        return SceneMovers(movers, np.array(value["normal"], float), bool(value["ground"]))
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise InputError(f"{path} does not hold movers: {error}.") from error
