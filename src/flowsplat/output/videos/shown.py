"""Which of the videos of a run are shown, and in which order: every page and record asks here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from flowsplat.output.videos.paths import PATHS

_COLOR = "_color"


class ShownVideo(NamedTuple):
    """A video in color, and the same with flow and depth beside it.

    Attributes:
        name: what was rendered.
        shown: name of the video that is shown: in color alone where there is that.
        beside: name of the one that has more beside it; None where that is the one that is shown.
    """

    name: str
    shown: str
    beside: str | None


def order_videos(videos: Mapping[str, str]) -> Sequence[ShownVideo]:
    """Return what was rendered, along the clip's own path first, otherwise in the order given.

    Args:
        videos: file names by name, as of ``list_rendered``.
    """
    own = {entry.value.file for entry in PATHS.entries() if entry.value.is_input}
    names = sorted((name for name in videos if not name.endswith(_COLOR)), key=lambda name: name not in own)
    return [ShownVideo(name, name + _COLOR, name) if name + _COLOR in videos else ShownVideo(name, name, None) for name in names]


def choose_video(videos: Mapping[str, str]) -> ShownVideo | None:
    """Return the one that is shown where there is room for one, which is no GIF; None where there is none. ``videos`` as above."""
    return next((video for video in order_videos(videos) if videos[video.shown].endswith(".mp4")), None)
