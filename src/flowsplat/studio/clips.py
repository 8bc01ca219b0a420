"""Frames, masks and times of a clip before anything was computed of it: what the page shows while one chooses."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from flowsplat.common.devices import pick_device
from flowsplat.common.errors import InputError
from flowsplat.common.files import write_bytes
from flowsplat.images.colors import object_color
from flowsplat.images.html import encode, shrink_to_page
from flowsplat.pipeline.compiling import are_missing
from flowsplat.pipeline.config import RunConfig
from flowsplat.pipeline.shot_places import names_frames, take_places
from flowsplat.pipeline.shots import FoundShots, find_shots, input_of
from flowsplat.pipeline.speed import COMPILING_SECONDS, Speed, TimeEstimate, estimate_seconds_of_clip
from flowsplat.priors.flow import dis_estimator
from flowsplat.priors.prompts import cut_prompts, parse_prompts
from flowsplat.scenes.bars import CroppedClip
from flowsplat.scenes.clip import Clip, InputOptions, choose_working_size, resize_image
from flowsplat.scenes.formats.video import VideoClip
from flowsplat.scenes.ingest import kind_of_input, open_clip
from flowsplat.studio.choices import (
    PRESETS,
    Choices,
    list_cut,
    list_places,
    name_frame,
    read_config,
    shot_of,
    split_frame,
)

MAX_OPEN_CLIPS = 6
"""Clips that are kept open, with their frames. Chosen by eye."""
MAX_KEPT_FRAMES = 24
"""Frames of each that are kept in memory. Chosen by eye."""
FRAME_QUALITY = 88
"""Of JPEG. Chosen by eye."""
POSTER_WIDTH = 480
"""Pixels. Chosen by eye."""
MASK_OPACITY = 130
"""Of 255: how much of the color of an object is seen on the page. Chosen by eye."""


class OpenClip:
    """A clip as a run takes it: its frames by their numbers there (``prompts.ClipFrames``). Any thread may ask."""

    def __init__(self, path: Path, options: InputOptions, kept_frames: int = MAX_KEPT_FRAMES):
        """Open it.

        Args:
            kept_frames: that are kept in memory.

        Raises:
            InputError: it cannot be used.
        """
        self._kept_frames = kept_frames
        if kind_of_input(path) != "video":
            raise InputError(f"{path.name} is no video.")
        self.path = path
        self.clip = open_clip(path, options)
        self.train_frames, self.heldout_frames = self.clip.split(options)
        self._lock = threading.Lock()
        self._kept: OrderedDict[int, np.ndarray] = OrderedDict()

    @property
    def width(self) -> int:
        """Pixels of the frames."""
        return self.clip.width

    @property
    def height(self) -> int:
        """Pixels of the frames."""
        return self.clip.height

    @property
    def num_frames(self) -> int:
        """How many there are."""
        return self.clip.num_frames

    @cached_property
    def seconds(self) -> dict[int, float]:
        """Seconds in the whole clip of the frames that places may be given on, by their numbers."""
        start = self._first_second()
        return {i: round(start + float(self.clip.timestamps[i]), 4) for i in self.train_frames}

    def move(self, path: Path) -> None:
        """Its file lies elsewhere now."""
        self.path = path
        video = replace(self._video, path=path, source=str(path), audio=path if self._video.audio else None)
        self.clip = replace(self.clip, whole=video, source=str(path)) if isinstance(self.clip, CroppedClip) else video

    def _first_second(self) -> float:
        return float(self._video.index.seconds[self._video.numbers[0]] - self._video.index.seconds[0])

    @property
    def duration(self) -> float:
        """Seconds of the whole clip, the last frame included."""
        index = self._video.index
        return float(index.seconds[-1] - index.seconds[0]) + 1 / index.fps

    @property
    def _video(self) -> VideoClip:
        clip = self.clip.whole if isinstance(self.clip, CroppedClip) else self.clip
        assert isinstance(clip, VideoClip)
        return clip

    def frame(self, i: int) -> np.ndarray:
        """Return frame ``i``, RGB [H, W, 3] uint8.

        Raises:
            InputError: there is none, or it cannot be read.
        """
        return self.frames([i])[0]

    def frames(self, numbers: Sequence[int]) -> list[np.ndarray]:
        """Return some frames, whose numbers rise, in one go through the file; raises as ``frame``."""
        if any(i not in self.train_frames for i in numbers):
            raise InputError("There is no such frame.")
        with self._lock:
            missing = [i for i in numbers if i not in self._kept]
            for i, image in zip(missing, self.clip.frames(missing), strict=True):
                self._kept[i] = image
            found = [self._kept[i] for i in numbers]
            for i in numbers:
                self._kept.move_to_end(i)
            while len(self._kept) > self._kept_frames:
                self._kept.popitem(last=False)
        return found


class CutClip:
    """A clip as it is cut: the shots that become scenes, or all of it as one. Any thread may ask.

    Attributes:
        parts: a clip for each scene.
        are_shots: whether these are shots.
        has_cuts: whether it has shots, even if they are not wanted.
        notes: what was left out, and why, in sentences.
    """

    def __init__(
        self, whole: OpenClip, options: InputOptions, spans: Sequence[tuple[float, float]], found: FoundShots | None = None
    ):
        """
        Args:
            whole: all of it.
            options: it was opened with.
            spans: first and last second of each shot; none: it becomes one scene.
            found: shots that it has, whether they are wanted or not.

        Raises:
            InputError: a shot cannot be read.
        """
        self._whole, self.are_shots = whole, bool(spans)
        self.has_cuts = bool(spans) or found is not None
        kept = max(MAX_KEPT_FRAMES // max(len(spans), 1), 2)
        self.parts = [OpenClip(whole.path, input_of(span, options), kept) for span in spans] or [whole]
        notes = found.notes if found is not None and self.are_shots else []
        self.notes = [*notes, *dict.fromkeys(note for part in self.parts for note in part.clip.notes)]

    @property
    def duration(self) -> float:
        """Seconds of the whole clip, the last frame included."""
        return self._whole.duration

    @cached_property
    def seconds(self) -> dict[int | str, float]:
        """Seconds in the whole clip of the frames that places may be given on, by what stands behind the @ of a place."""
        return {
            name_frame(number * self.are_shots, i): second
            for number, part in enumerate(self.parts, 1)
            for i, second in part.seconds.items()
        }

    def find(self, frame: int | str) -> tuple[OpenClip, int]:
        """Return the part that a frame is in, and its number there.

        Raises:
            InputError: there is none.
        """
        if frame not in self.seconds:
            raise InputError("There is no such frame.")
        shot, number = split_frame(frame)
        return self.parts[max(shot, 1) - 1], number

    def frame(self, frame: int | str) -> np.ndarray:
        """Return a frame, RGB [H, W, 3] uint8.

        Raises:
            InputError: there is none, or it cannot be read.
        """
        part, number = self.find(frame)
        return part.frame(number)


class _Resized:
    """A clip whose frames have another size (``prompts.ClipFrames``)."""

    def __init__(self, opened: OpenClip, options: InputOptions):
        self._opened = opened
        (self.width, self.height), _ = choose_working_size(opened.width, opened.height, options, opened.clip.name)
        self.num_frames = opened.num_frames
        self.train_frames, self.heldout_frames = opened.train_frames, opened.heldout_frames

    def frame(self, i: int) -> np.ndarray:
        return resize_image(self._opened.frame(i), (self.width, self.height))


class Clips:
    """The clips that are open, those that were asked for last."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._open: OrderedDict[tuple[str, str], OpenClip] = OrderedDict()
        self._cut: OrderedDict[tuple[str, str], CutClip] = OrderedDict()

    def open(self, path: Path, options: InputOptions) -> OpenClip:
        """Return a clip; raises as ``OpenClip``."""
        key = str(path), repr(options)
        with self._lock:
            if key in self._open:
                self._open.move_to_end(key)
                return self._open[key]
        return self.keep(path, options, OpenClip(path, options))

    def cut(self, path: Path, config: RunConfig, is_split: bool, spans: Sequence[tuple[float, float]] | None = None) -> CutClip:
        """Return a clip as it is cut, or will be; raises as ``OpenClip``.

        Args:
            config: settings of its run, at any size.
            is_split: whether each of its shots is to become a scene.
            spans: what its run has done; None where there is none yet. Then its cuts are looked for.
        """
        key = str(path), repr((config.input, is_split, spans))
        with _BUSY_LOCK:
            found = self._cut.get(key)
            if found is None:
                whole = self.open(path, config.input)
                shots = find_shots(path, config.input) if spans is None and not names_frames(config) else None
                shots = shots if isinstance(shots, FoundShots) else None
                wanted = shots.spans if shots is not None and is_split else spans or []
                found = CutClip(whole, config.input, wanted, shots)
            with self._lock:
                self._cut[key] = found
                self._cut.move_to_end(key)
                while len(self._cut) > MAX_OPEN_CLIPS:
                    self._cut.popitem(last=False)
        return found

    def keep(self, path: Path, options: InputOptions, found: OpenClip) -> OpenClip:
        """Remember one that was opened."""
        with self._lock:
            self._open[str(path), repr(options)] = found
            while len(self._open) > MAX_OPEN_CLIPS:
                self._open.popitem(last=False)
        return found

    def forget(self, path: Path) -> None:
        """Close what is open of a file."""
        with self._lock:
            for kept in (self._open, self._cut):
                for key in [key for key in kept if key[0] == str(path)]:
                    del kept[key]


@dataclass(frozen=True)
class Looks:
    """What the page is told of a clip as it is cut now.

    Attributes:
        frames: of those that places may be given on, what stands behind the @ of a place, and second.
        num_frames: those that a run uses.
        duration: seconds of the whole clip.
        notes: what was left out, and why, in sentences.
        shots: how many become scenes, 0 where all of it is one.
        has_cuts: whether there is a choice between the two.
        estimates: how long a run with each preset takes here.
        expected: seconds of the stages of the chosen one, of each scene.
    """

    frames: list[tuple[int | str, float]]
    num_frames: int
    duration: float
    notes: list[str]
    shots: int
    has_cuts: bool
    estimates: dict[str, TimeEstimate]
    expected: list[dict[str, float]]


_BUSY_LOCK = threading.Lock()
"""One at a time measures how fast the machine is, or looks for cuts."""


def look(opened: CutClip, choices: Choices, run_options: Sequence[str]) -> Looks:
    """Return what there is to know before a run.

    Args:
        opened: the clip with this cut, as large as any preset takes it.
    """
    estimates, expected = {}, []
    for name in PRESETS:
        config = read_config([*run_options, *list_cut(choices, name)])
        seconds, estimate = estimate_run([part.clip for part in opened.parts], config)
        estimates[name] = estimate
        if name == choices["preset"]:
            expected = seconds
    return Looks(
        list(opened.seconds.items()), sum(part.num_frames for part in opened.parts), opened.duration, opened.notes,
        len(opened.parts) if opened.are_shots else 0, opened.has_cuts, estimates, expected,
    )  # fmt: skip


def estimate_run(clips: Sequence[Clip], config: RunConfig) -> tuple[list[dict[str, float]], TimeEstimate]:
    """Return seconds of every stage of a run here, of each scene, and of all of it.

    Args:
        clips: of each scene, at this size or a larger one.
    """
    references = []
    for k, clip in enumerate(clips):
        (width, height), _ = choose_working_size(clip.width, clip.height, config.input, clip.name)
        compiling = COMPILING_SECONDS if not k and are_missing(pick_device(config.device).type) else 0.0
        options = {"compiling": compiling}
        references.append(options | estimate_seconds_of_clip(replace(clip, width=width, height=height), config))
    with _BUSY_LOCK:
        speed = Speed(config.device)
        expected = [
            {stage: seconds * speed.factor(stage) for stage, seconds in reference.items() if seconds > 0}
            for reference in references
        ]
        total = {stage: sum(reference[stage] for reference in references) for stage in references[0]}
        return expected, speed.estimate(total)


def draw_masks(opened: CutClip, options: InputOptions, choices: Choices, frame: int | str) -> tuple[bytes, list[float]]:
    """Return what the clicks on one frame mean: an image of colors on nothing (PNG with alpha), and the share of each object.

    Args:
        opened: the clip with this cut, at this size or a larger one.
        options: say how large a run takes it.

    Raises:
        InputError: a click cannot be, or there is no such frame.
    """
    part, number = opened.find(frame)
    shot = split_frame(frame)[0]
    config = read_config(list_places({**choices, "contacts": []})).priors
    config = take_places(config, shot) if shot else config
    clip = _Resized(part, options)
    prompts = [
        each for each in parse_prompts(config.mask_click, config.mask_box, clip, config.mask_negative) if each.frame == number
    ]
    masks = cut_prompts(clip, prompts, dis_estimator)
    drawn = np.zeros((clip.height, clip.width, 4), np.uint8)
    shares = [0.0] * len(choices["objects"])
    numbers = [k for k, each in enumerate(choices["objects"]) if any(shot_of(mark) == shot for mark in each["clicks"])]
    for prompt, mask in list(zip(prompts, masks, strict=True))[::-1]:
        place = numbers[prompt.number - 1]
        drawn[mask] = (*object_color(place + 1), MASK_OPACITY)
        shares[place] = float(mask.mean())
    return _encode_with_alpha(drawn), shares


def _encode_with_alpha(image: np.ndarray) -> bytes:
    import cv2

    ok, data = cv2.imencode(".png", np.ascontiguousarray(image[..., [2, 1, 0, 3]]))
    assert ok
    return bytes(data.tobytes())


def check_clip(path: Path, options: InputOptions, poster: Path) -> OpenClip:
    """Return a clip, once it is certain that a run could begin with it, and write an image of it.

    Raises:
        InputError: why it is refused, with the name of the file alone.
    """
    try:
        opened = OpenClip(path, options)
        middle = opened.train_frames[len(opened.train_frames) // 2]
        image = shrink_to_page(opened.frame(middle), POSTER_WIDTH)
    except InputError as error:
        raise InputError(str(error).replace(str(path), path.name)) from error
    write_bytes(poster, encode(image, FRAME_QUALITY))
    return opened
