"""Record what a client exports: screenshots, camera paths and recordings, in ``OUT/viewer``."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.files import plain_name
from flowsplat.geometry import Camera
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
OWN_SIZE, OWN_RATE = "as the path", "as the clip"
_SIZES = {OWN_SIZE: None, "480p": 480, "720p": 720, "1080p": 1080, "2160p": 2160}
"""Pixels of the shorter side of a recording, by what people call it."""
SIZES = tuple(_SIZES)
RATES = (OWN_RATE, "10", "12.5", "15", "24", "25", "30", "50", "60")
"""Frames a second of a recording."""
MAX_GIF_FPS = 50.0
"""Frames a second that every browser plays a GIF at: faster ones are slowed down by some."""
MAX_GIF_BYTES = 2**30
"""Bytes of the images of a GIF, which are held until the colors that suit all of them are known. A round number."""


@dataclass(frozen=True)
class Recording:
    """What a camera path is recorded as.

    Attributes:
        path: ``.mp4``, ``.gif`` or ``.webm``.
        size: one of ``SIZES``.
        rate: one of ``RATES``.
    """

    path: Path
    size: str = OWN_SIZE
    rate: str = OWN_RATE

    def choose_fps(self, clip: float) -> float:
        """Return frames a second, those of the clip being ``clip``; a GIF has such as it can say, which are hundredths of a second
        apart."""
        is_gif = self.path.suffix == ".gif"
        fps = (GIF_FPS if is_gif else clip) if self.rate == OWN_RATE else float(self.rate)
        return 100 / round(100 / min(fps, MAX_GIF_FPS)) if is_gif else fps

    def resize(self, camera: Camera) -> Camera:
        """Return the camera with the size of the recording, the shape of the image kept."""
        side = _SIZES[self.size]
        if side is None:
            return camera
        scale = side / min(camera.width, camera.height)
        # Whole pairs of pixels, as videos want them.
        width, height = (2 * round(pixels * scale / 2) for pixels in (camera.width, camera.height))
        return camera.resize(width, height)


def record_path(
    source: Source, browser: BrowserFrame, keys: CameraKeys, fps: float, look: Look, recording: Recording, tell: ShowProgress,
    finished: Callable[[Path], None],
) -> Iterator[None]:  # fmt: skip
    """Yield a task: a camera path as a video of what the client looks at, one frame a step.

    Args:
        source: the scene.
        browser: its coordinates.
        keys: the path.
        fps: frames a second of the clip.
        look: what is shown; a WebM shows the objects in color on transparent, whatever it says.
        recording: file, size and frame rate.
        tell: shows how far it is.
        finished: called with the path in the end.

    Raises:
        InputError: it cannot be written, a WebM is asked for where nothing moves, or a GIF that is too large.
    """
    path = recording.path
    suffix, objects = path.suffix, source.model("objects", look.distances, look.confidence_fade, look.crop)
    if suffix == ".webm" and not len(objects.gaussians):
        where = "in this scene" if look.crop is None else "in the box that is shown"
        raise InputError(f"Nothing moves {where}: record it as mp4 or gif.")
    fps = recording.choose_fps(fps)
    shots = [(recording.resize(camera), t) for camera, t in keys.shots(fps)]
    needed = sum(3 * camera.width * camera.height * (1 + look.stereo) for camera, _ in shots)
    if suffix == ".gif" and needed > MAX_GIF_BYTES:
        size = f"{shots[0][0].width} x {shots[0][0].height}"
        raise InputError(
            f"A GIF of {len(shots)} images of {size} pixels is too large: choose fewer frames a second, a smaller size, or mp4."
        )
    with _WRITERS[suffix](path, fps) as write:
        for k, (camera, t) in enumerate(shots):
            tell(f"Recording frame {k + 1} of {len(shots)}")
            if suffix == ".webm":
                write(on_transparent(objects.render(camera, t)))
            else:
                write(draw_shot(source, browser, camera, t, look))
            yield
    finished(path)
