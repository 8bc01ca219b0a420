"""Define the options of exports: apart from the code that does it, so that the command line need not load that."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ExportOptions:
    """What of a scene is exported, and how."""

    time: float | None = None
    """Seconds of the clip that a format of one time shows. None = the middle."""
    flip_axes: bool = False
    """Turn y up and z backward, in formats that do not prescribe their axes: for viewers that show the scene upside down, as
    SuperSplat does."""
    max_gaussians: int | None = None
    """Keep at most this many: those without which the training frames would change most. None = all."""
    size_mb: float | None = None
    """Megabytes (millions of bytes) that the file may have: as many Gaussians are kept as have room. None = any size."""
    crop: str | None = None
    """Only what lies in a box: x0,y0,z0,x1,y1,z1 in the coordinates of the scene's cameras
    (--crop=-1,-1,0.5,1,1,3). None = all."""
    embed: bool = False
    """Of the page, also tell the line of HTML that shows it in another page, such as a blog: playing, without its controls."""
    sound: bool = True
    """Put the clip's sound in, where the format has a place for it."""
