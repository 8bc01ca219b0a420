"""What a client takes away: screenshots, camera paths and recordings, in ``OUT/viewer``."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from flowsplat.output.viewer.drawing import Look, Wish, draw, render_look
from flowsplat.output.viewer.keys import Shot
from flowsplat.output.viewer.source import Source
from flowsplat.output.viewer.world import World
from flowsplat.pictures.video import mp4_writer
from flowsplat.scenes.layers import write_image

Told = Callable[[str], None]
"""Takes a line on how far it is."""


def next_file(folder: Path, stem: str, suffix: str) -> Path:
    """``stem_001.suffix``, or the first number that is not taken yet."""
    number = 1
    while (path := folder / f"{stem}_{number:03d}{suffix}").exists():
        number += 1
    return path


def take_screenshot(source: Source, world: World, wish: Wish, path: Path, finished: Callable[[Path], None]) -> Iterator[None]:
    """A task: what a client sees, as a PNG.

    Raises:
        InputError: it cannot be written.
    """
    write_image(path, draw(source, world, wish).image)
    finished(path)
    yield


def record_path(
    source: Source, world: World, shots: Sequence[Shot], fps: float, look: Look, path: Path, tell: Told,
    finished: Callable[[Path], None],
) -> Iterator[None]:  # fmt: skip
    """A task: a camera path as an mp4 that shows what the client looks at, one frame a step.

    Raises:
        InputError: it cannot be written.
    """
    alone = replace(look, compare="off")
    with mp4_writer(path, fps) as write:
        for k, (camera, t) in enumerate(shots):
            tell(f"Recording frame {k + 1} of {len(shots)}")
            write(render_look(source, camera, Wish((camera.width, camera.height), t, alone, world.pose(camera)))[0])
            yield
    finished(path)
