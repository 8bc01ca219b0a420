"""Queries of points from the command line or a file, and their paths as a file for other programs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.files import read_json, read_text, write_json, write_npz
from flowsplat.common.files.json_file import MAX_JSON_BYTES, Number
from flowsplat.gaussians.model import SceneModel
from flowsplat.gaussians.tracking import follow_points
from flowsplat.scenes import Scene

WANTED = "u,v,frame: two pixels of the prepared frames and the number of a frame, as in 420.5,230.5,0"


def read_queries(at: Sequence[str], file: Path | None, scene: Scene) -> np.ndarray:
    """Return [Q, 3] u, v and frame, from texts ``u,v,frame`` and from a file: JSON (a list of [u, v, frame]), or a text with one a
    line.

    Raises:
        InputError: none at all, one that is none, or one outside the image or the clip.
    """
    rows: list[tuple[str, Sequence[object]]] = [(f"--at {text}", text.split(",")) for text in at]
    if file is not None:
        rows += [(f"{file}, number {k + 1}", row) for k, row in enumerate(_rows_of(file))]
    if not rows:
        raise InputError(f"No point to follow: give --at {WANTED}, or --queries FILE.")
    return np.array([_query(where, row, scene) for where, row in rows])


def _rows_of(file: Path) -> list[Sequence[object]]:
    if file.suffix.lower() == ".json":
        return read_json(file, list[list[Number]])
    lines = read_text(file, MAX_JSON_BYTES).splitlines()
    return [line.split(",") for line in lines if line.strip() and not line.startswith("#")]


def _query(where: str, row: Sequence[object], scene: Scene) -> tuple[float, float, float]:
    try:
        u, v, frame = (float(part) for part in row)  # type: ignore[arg-type]
    except (TypeError, ValueError, ArithmeticError) as error:
        raise InputError(f"{where} is no point: give {WANTED}.") from error
    if not (0 <= u < scene.width and 0 <= v < scene.height):
        raise InputError(f"{where} is outside the image of {scene.width}x{scene.height} pixels.")
    if frame not in range(scene.num_frames):
        raise InputError(f"{where}: there is no frame {frame:g}, they count from 0 to {scene.num_frames - 1}.")
    return u, v, frame


def write_tracks(model: SceneModel, scene: Scene, queries: np.ndarray, path: Path) -> tuple[Path, int]:
    """Follow points [Q, 3] through the model and write their paths.

    ``.npz``: ``queries`` [Q, 3], ``timestamps`` [T] seconds, ``points`` [Q, T, 3] in the coordinates of ``scene/cameras.json``
    (NaN where unknown), ``visible`` [Q, T], ``object_ids`` [Q] the number of the object that each is on (0: on none). ``.json``:
    the same as lists, null where unknown.

    Returns:
        the path, and how many points lie on something.

    Raises:
        InputError: the suffix is of neither, or the file cannot be written.
    """
    suffix = path.suffix.lower()
    if suffix not in (".json", ".npz"):
        raise InputError(f"{path} is neither .json nor .npz: name the file so.")
    paths = follow_points(model, scene.cameras, scene.timestamps, queries)
    known = np.isfinite(paths.points).all(-1)
    values = {"queries": queries, "timestamps": scene.timestamps, "visible": paths.visible, "object_ids": paths.object_ids}
    if suffix == ".npz":
        write_npz(path, {**values, "points": paths.points}, compressed=True)
    else:
        points = [[p.tolist() if k else None for p, k in zip(*row, strict=True)] for row in zip(paths.points, known, strict=True)]
        write_json(path, {**values, "points": points})
    return path, int(known.any(1).sum())
