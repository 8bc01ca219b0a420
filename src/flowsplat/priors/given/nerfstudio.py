"""nerfstudio's ``transforms.json``: https://docs.nerf.studio/quickstart/data_conventions.html."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.geometry import Camera
from flowsplat.geometry.lens import Distortion
from flowsplat.priors.given.gaps import fill_gaps, find_frames
from flowsplat.scenes import Scene
from flowsplat.scenes.formats.images import natural_key
from flowsplat.scenes.formats.nerfstudio import transforms_camera


def is_nerfstudio(content: Any) -> bool:
    """Return whether JSON has nerfstudio's layout."""
    return isinstance(content, dict) and isinstance(content.get("frames"), list)


def read_nerfstudio(path: Path, content: dict[str, Any], scene: Scene) -> tuple[list[Camera], str, dict[int, Distortion]]:
    """Return one camera a frame, what is to be said about them, and how the lens bends each frame of the file.

    Frames are in the order of their times where all have one, else in the natural order of their images.

    Raises:
        InputError: a value is missing, a lens is not known here, or too many frames in a row have no camera.
    """
    frames = content["frames"]
    try:
        if len(frames) == scene.num_frames and all("time" in frame for frame in frames):
            frames = sorted(frames, key=lambda frame: float(frame["time"]))
            numbers = list(range(len(frames)))
        else:
            frames = sorted(frames, key=lambda frame: natural_key(Path(frame["file_path"])))
            numbers = find_frames(path, [frame["file_path"] for frame in frames], scene, "frames")
        found = [transforms_camera(path, {**content, **frame}, (scene.width, scene.height)) for frame in frames]
    except (KeyError, TypeError, ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        raise InputError(f"{path} is no transforms.json of nerfstudio: {_reason(error)}.") from error
    cameras = {i: camera for i, (camera, _) in zip(numbers, found, strict=True)}
    return *fill_gaps(path, cameras, scene), {i: distortion for i, (_, distortion) in zip(numbers, found, strict=True)}


def _reason(error: Exception) -> str:
    return f"it has no {error}" if isinstance(error, KeyError) else str(error)
