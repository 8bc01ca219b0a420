"""A folder with one .ply of 3D Gaussian Splatting a frame, as SuperSplat plays it."""

from __future__ import annotations

import re
from pathlib import Path

from flowsplat.common.errors import InputError
from flowsplat.common.progress import track
from flowsplat.common.registry import Entry
from flowsplat.gaussians.model import SceneModel
from flowsplat.output.export.formats import EXPORTERS, Exporter
from flowsplat.output.export.formats.ply import count_record_bytes, write_at
from flowsplat.output.export.options import ExportOptions
from flowsplat.scenes import Scene

_SEQUENCE_FILE = re.compile(r"frame\d{4,}\.ply")


def write(folder: Path, model: SceneModel, scene: Scene, options: ExportOptions) -> None:
    """``frame0001.ply`` and so on, one a frame of the clip; files of a longer sequence that was there before go."""
    entries = [entry for entry in folder.iterdir() if not entry.name.startswith(".")]
    foreign = [entry.name for entry in entries if not _SEQUENCE_FILE.fullmatch(entry.name)]
    if foreign:
        raise InputError(f"{folder} holds something else ({min(foreign)}): give an empty folder with -o.")
    names = [f"frame{k:04d}.ply" for k in range(1, scene.num_frames + 1)]
    for name, seconds in zip(names, track(scene.timestamps.tolist(), "Writing the sequence"), strict=True):
        write_at(folder / name, model, scene, seconds, options.flip_axes)
    for entry in entries:
        if entry.name not in names:
            entry.unlink()


def estimate_bytes(model: SceneModel, scene: Scene, options: ExportOptions) -> int:
    """Exact but for the headers."""
    return count_record_bytes(model) * sum(model.active_count(float(t)) for t in scene.timestamps)


SENTENCE = "A folder with one ply a frame, as SuperSplat plays it."
SEQUENCE = Exporter(write, estimate_bytes, "ply-sequence", can_flip_axes=True)
EXPORTERS.add(Entry("ply-sequence", "PLY sequence", SENTENCE, SEQUENCE, place=30))
