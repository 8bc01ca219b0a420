"""Record what a client exports: screenshots, camera paths and recordings, in ``OUT/viewer``."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.files import plain_name
from flowsplat.images.gif import write_gif
from flowsplat.images.transparent import webm_writer
from flowsplat.images.video import mp4_writer
from flowsplat.output.videos.shots import GIF_FPS
from flowsplat.output.videos.writing import on_transparent
from flowsplat.output.viewer.browser_frame import BrowserFrame
from flowsplat.output.viewer.drawing import Look, Wish, draw, draw_shot
from flowsplat.output.viewer.keys import CameraKeys
from flowsplat.output.viewer.source import Source
from flowsplat.scenes.layers import write_image

ShowProgress = Callable[[str], None]
"""Takes a line on how far it is."""
Writer = Callable[[Path, float], contextlib.AbstractContextManager[Callable[[np.ndarray], None]]]


_PROMISED: set[Path] = set()
"""Names that were given away, so that two recordings at once do not write to one file."""
_PROMISING = threading.Lock()


def next_file(folder: Path, stem: str, suffix: str) -> Path:
    """``stem_001.suffix``, or the first number that neither exists nor was given away before."""
    with _PROMISING:
        number = 1
        while (path := folder / plain_name(f"{stem}_{number:03d}{suffix}")).exists() or path in _PROMISED:
            number += 1
        _PROMISED.add(path)
    return path


def take_screenshot(
    source: Source, browser: BrowserFrame, wish: Wish, path: Path, finished: Callable[[Path], None]
) -> Iterator[None]:
    """Yield a task: what a client sees, as a PNG.

    Raises:
        InputError: it cannot be written.
    """
    write_image(path, draw(source, browser, wish).image)
    finished(path)
    yield


@contextlib.contextmanager
def _gif_writer(path: Path, fps: float) -> Iterator[Callable[[np.ndarray], None]]:
    frames: list[np.ndarray] = []
    yield frames.append
    write_gif(path, frames, fps)


_WRITERS: dict[str, Writer] = {".mp4": mp4_writer, ".gif": _gif_writer, ".webm": webm_writer}
RECORDINGS = tuple(_WRITERS)
"""Suffixes of what can be recorded."""


def record_path(
    source: Source, browser: BrowserFrame, keys: CameraKeys, fps: float, look: Look, path: Path, tell: ShowProgress,
    finished: Callable[[Path], None],
) -> Iterator[None]:  # fmt: skip
    """Yield a task: a camera path as a video of what the client looks at, one frame a step.

    Args:
        source: the scene.
        browser: its coordinates.
        keys: the path.
        fps: frames a second; a GIF has those of the wiggle.
        look: what is shown; a WebM shows the objects in color on transparent, whatever it says.
        path: ``.mp4``, ``.gif`` or ``.webm``.
        tell: shows how far it is.
        finished: called with the path in the end.

    Raises:
        InputError: it cannot be written, or a WebM is asked for where nothing moves.
    """
    suffix, objects = path.suffix, source.model("objects", look.distances, look.confidence_fade)
    if suffix == ".webm" and not len(objects.gaussians):
        raise InputError("Nothing moves in this scene: record it as mp4 or gif.")
    fps = GIF_FPS if suffix == ".gif" else fps
    shots = keys.shots(fps)
    with _WRITERS[suffix](path, fps) as write:
        for k, (camera, t) in enumerate(shots):
            tell(f"Recording frame {k + 1} of {len(shots)}")
            if suffix == ".webm":
                write(on_transparent(objects.render(camera, t)))
            else:
                write(draw_shot(source, browser, camera, t, look))
            yield
    finished(path)
