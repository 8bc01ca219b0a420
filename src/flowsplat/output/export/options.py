"""Define the options of exports: apart from the code that does it, so that the command line need not load that."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

Format = Literal["html", "ply", "ply-sequence", "splat", "spz", "npz", "safetensors", "colmap", "nerfstudio"]
FORMATS: tuple[str, ...] = get_args(Format)


@dataclass(frozen=True)
class ExportOptions:
    """What of a scene is exported, and how."""

    time: float | None = None
    """Seconds of the clip at which ply, splat and spz show it. None = the middle."""
    flip_axes: bool = False
    """Turn y up and z backward (ply, ply-sequence, splat): for viewers that show the scene upside down, as SuperSplat does.
    spz prescribes these axes and always has them."""
    max_gaussians: int | None = None
    """Keep at most this many: those that hold most of the training frames. None = all."""
