"""Videos of a trained scene: along the clip's own cameras, round its middle, with time standing still, along a given path.

A path gives two files: ``<name>.mp4`` with color, flow and depth beside each other, and ``<name>_color.mp4`` with the
color alone; what else there is (stereo pairs, objects on transparent, a wiggle) gives one. ``renders.json`` beside them
tells what they were made of; a video that is there and would come out the same is not rendered again.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from typing_extensions import NotRequired, TypedDict

from flowsplat import __version__
from flowsplat.common.errors import InputError
from flowsplat.common.files import plain_name, read_json, write_json
from flowsplat.common.files.json_file import Count, Number, Positive, Text
from flowsplat.gaussians.renderer import PartedRenderer
from flowsplat.images.video import read_first_frame
from flowsplat.output.videos.options import RenderOptions, factors_of
from flowsplat.output.videos.plans import VideoPlan, name_of, plan_videos, settle, settle_clip
from flowsplat.output.videos.writing import Scales, write_plan
from flowsplat.scenes import Scene

__all__ = [
    "RenderOptions", "SwingFile", "are_rendered", "forget_videos", "list_frame_rates", "list_rendered", "name_of",
    "read_posters", "read_swing", "render_videos", "settle", "settle_clip",
]  # fmt: skip

_RECORD = "renders.json"


class SwingFile(TypedDict):
    """How far a loop goes, in ``renders.json`` and ``metrics.json``: as ``amplitudes.Swing``."""

    degrees: Positive
    unknown: Number
    holds: bool


class RenderedFile(TypedDict):
    """A video in ``renders.json``."""

    key: Text
    fps: Positive
    frames: Count
    files: list[Text]
    swing: NotRequired[SwingFile]


def render_videos(model: PartedRenderer, scene: Scene, folder: Path, options: RenderOptions) -> None:
    """Render the videos that ``options`` ask for into ``folder``.

    Raises:
        InputError: an option or the camera file cannot be used, or the folder cannot be written.
    """
    record = _record(folder)
    if options.object_depth:
        model = model.at_distances(factors_of(options.object_depth), scene.timestamps.tolist(), scene.cameras)
    plans = plan_videos(model, scene, options)
    if options.confidence_fade:
        model = model.fade_by_confidence(scene.timestamps.tolist(), scene.cameras)
    parts = {part: model.part(part) for part in options.parts}
    for plan in plans:
        shown = parts[plan.part]
        scales = Scales.of(shown, plan.shots)
        entry = {"key": _key(plan, scales), "fps": plan.fps, "frames": len(plan.shots), "files": plan.files}
        if plan.swing is not None:
            entry["swing"] = asdict(plan.swing)
        if record.get(plan.name) != entry or not all((Path(folder) / file).exists() for file in plan.files):
            write_plan(shown, plan, scales, Path(folder))
            record[plan.name] = entry
            write_json(Path(folder) / _RECORD, record)


def list_rendered(folder: Path) -> dict[str, str]:
    """Return what was rendered into ``folder``, by name, to the file's name in it.

    Names: the ``file`` of each camera path (``input_path``, ``orbit``, ...), and ``custom_path_`` with the name of its camera file;
    behind it ``_slow4`` where time plays four times slower, ``_confidence_fade`` where guesses fade,
    ``_distance_2x1.2`` where object 2 is that much farther away, ``_background``, ``_objects`` or ``_objects_1_3`` where a part is
    shown, then ``_stereo`` or ``_color`` for the other files.

    Raises:
        InputError: ``renders.json`` is damaged.
    """
    return {name + "_color" * k: file for name, entry in _record(folder).items() for k, file in enumerate(entry["files"])}


def list_frame_rates(folder: Path) -> dict[str, float]:
    """Return frames a second of what was rendered into ``folder``, by the names that ``rendered`` has without ``_color``.

    Raises:
        InputError: ``renders.json`` is damaged.
    """
    return {name: float(entry["fps"]) for name, entry in _record(folder).items()}


def read_posters(folder: Path, videos: Mapping[str, str]) -> dict[str, np.ndarray]:
    """Return the first image [H, W, 3] uint8 of videos in ``folder``, by their names, without those that cannot be read.

    Args:
        videos: file names by name, as of ``list_rendered``.
    """
    found = {}
    for name, file in videos.items():
        if file.endswith(".mp4"):
            with suppress(InputError):
                found[name] = read_first_frame(Path(folder) / file)
    return found


def read_swing(folder: Path) -> dict[str, Any] | None:
    """Return how far loops round the clip's cameras go, of the narrowest in ``folder``; None where it was measured for none.

    Raises:
        InputError: ``renders.json`` is damaged.
    """
    found = (entry["swing"] for entry in _record(folder).values() if "swing" in entry)
    return min(found, key=lambda swing: swing["degrees"], default=None)


def are_rendered(folder: Path) -> bool:
    """Return whether videos were rendered into ``folder``, and all their files are still there."""
    return bool(list_rendered(folder)) and all((Path(folder) / file).exists() for file in list_rendered(folder).values())


def forget_videos(folder: Path) -> None:
    """Note that what is in ``folder`` shows another scene; the files stay until new ones take their place."""
    (Path(folder) / _RECORD).unlink(missing_ok=True)


def _record(folder: Path) -> dict[str, Any]:
    path = Path(folder) / _RECORD
    record: dict[str, Any] = read_json(path, dict[Text, RenderedFile]) if path.exists() else {}
    for entry in record.values():
        for file in entry["files"]:
            plain_name(file, f"{path}: the video")
    return record


def _key(plan: VideoPlan, scales: Scales) -> str:
    """Return a hash of all that a video depends on; what the model is shows in the shots that were looked at."""
    text = json.dumps([__version__, plan.to_json(), scales.looks])
    return hashlib.sha256(text.encode()).hexdigest()[:16]
