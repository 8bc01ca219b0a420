"""Formats of exports: each a file of this folder, or of another package (entry points ``flowsplat.exporters``).

The command line, Python and the documentation know what there is by ``EXPORTERS`` alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from flowsplat.common.registry import Registry
from flowsplat.gaussians.model import SceneModel
from flowsplat.output.export.options import ExportOptions
from flowsplat.scenes import Scene

Write = Callable[[Path, SceneModel, Scene, ExportOptions], None]


@dataclass(frozen=True)
class Exporter:
    """A format.

    Attributes:
        write: writes a file, or into a folder that is there, and raises an ``InputError`` where that is impossible. The model has
            as many Gaussians as ``max_gaussians`` and ``size_mb`` leave, and at least one. For ``size_mb`` it is called several
            times, elsewhere first.
        estimate_bytes: about how many it will be.
        default_name: of the file, or of the folder: what has no suffix is one.
        is_of_one_time: it shows the scene at one time, and takes ``time``.
        can_flip_axes: it takes ``flip_axes``.
        has_gaussians: it takes ``max_gaussians`` and, as one file, ``size_mb``; otherwise it has the cameras alone.
        rounds: it stores coordinates as whole numbers, of which there are only so many: what is far away is brought near before.
        holds_sound: the clip's sound may be in it; it takes ``sound``.
        keeps_slopes: brightness may vary inside its Gaussians; otherwise each has one color, and what is lost is told.
        reader: dotted name of what in flowsplat reads it back.
        note: what is told of a file that was written: what of the clip it holds.
        begin: measures on the whole scene what takes long, once for an export, and gives what takes the place of ``write``, with
            the same arguments; None: there is nothing like it.
        embed: gives the HTML that shows a file in another page; it takes ``embed``.
    """

    write: Write
    estimate_bytes: Callable[[SceneModel, Scene, ExportOptions], int]
    default_name: str
    is_of_one_time: bool = False
    can_flip_axes: bool = False
    has_gaussians: bool = True
    keeps_slopes: bool = False
    rounds: bool = False
    holds_sound: bool = False
    reader: str | None = None
    note: str | None = None
    embed: Callable[[Path, Scene], str] | None = None
    begin: Callable[[SceneModel, Scene], Write] | None = None

    @property
    def is_folder(self) -> bool:
        """Whether it is one, and not a file."""
        return not Path(self.default_name).suffix


EXPORTERS: Registry[Exporter] = Registry("format", __name__, "flowsplat.exporters", are_values=True)
