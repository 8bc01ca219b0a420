"""Clicks and boxes as they are typed."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from flowsplat.common.errors import InputError

_EXAMPLES = {2: "320,180@0", 4: "280,120,400,240@0"}
_NUMBER = r"-?\d+(?:\.\d+)?"

Point = tuple[float, float]


class FrameNumbers(Protocol):
    """What is known of the frames that places are given on, those of a scene or of a clip that is no scene yet."""

    @property
    def width(self) -> int:
        """Pixels of the frames."""

    @property
    def height(self) -> int:
        """Pixels of the frames."""

    @property
    def num_frames(self) -> int:
        """How many there are."""

    @property
    def train_frames(self) -> list[int]:
        """Numbers of those that places may be given on."""

    @property
    def heldout_frames(self) -> list[int]:
        """Numbers of the others."""


class ClipFrames(FrameNumbers, Protocol):
    """The frames themselves."""

    def frame(self, i: int) -> np.ndarray:
        """Return training frame ``i``, RGB [H, W, 3] uint8."""


@dataclass(frozen=True)
class Prompt:
    """What was said of an object on one frame, in pixels of the frames.

    Attributes:
        frame: of the clip.
        clicks: [(x, y), ...] on it.
        box: (left, top, right, bottom) round it, or None.
        beside: [(x, y), ...] that are not it.
        number: of the object, from 1.
    """

    frame: int
    clicks: tuple[Point, ...] = ()
    box: tuple[float, float, float, float] | None = None
    beside: tuple[Point, ...] = ()
    number: int = 1


CLICK_RADIUS = 0.006
"""Share of the long side of the image: of what is clicked, of what is drawn, and within which two clicks are on one place.
Chosen by eye."""


def parse_prompts(clicks: Sequence[str], boxes: Sequence[str], scene: FrameNumbers, beside: Sequence[str] = ()) -> list[Prompt]:
    """Prompts as they are typed: ``x,y@frame`` and ``x0,y0,x1,y1@frame``, and ``=number`` of the object behind it if need be.

    Values that are all at most 1 are shares of width and height, others are pixels of the frames. Boxes are objects of their own,
    and so is a click that lies in no box of its frame; they count from 1, boxes first. A click or box with a number belongs to the
    object of that number, which another one shows. What is ``beside`` is no object, or not that of its number.

    Returns:
        one for each object and frame, by number and frame. The first of an object shows it, the others correct it.

    Raises:
        InputError: not of that form, outside the image, on a frame that is held out or does not exist, or of an object that
            nothing shows.
    """
    shown: dict[tuple[int, int], Prompt] = {}
    count, corrections = 0, []
    points = [_Place(text, "--mask-click", 2, scene) for text in clicks]
    for box in [_Place(text, "--mask-box", 4, scene) for text in boxes]:
        x0, y0, x1, y1 = box.values
        if x1 - x0 < 2 or y1 - y0 < 2:
            raise InputError(f"--mask-box {box.text} is empty: give left,top,right,bottom@frame.")
        inside = [p for p in points if p.number is None and p.frame == box.frame and box.holds(p)]
        points = [p for p in points if p not in inside]
        prompt = Prompt(box.frame, tuple(p.point for p in inside), (x0, y0, x1, y1))
        if box.number is not None:
            corrections.append((box, prompt))
            continue
        count += 1
        shown[count, box.frame] = replace(prompt, number=count)
    for point in points:
        prompt = Prompt(point.frame, (point.point,))
        if point.number is not None:
            corrections.append((point, prompt))
            continue
        count += 1
        shown[count, point.frame] = replace(prompt, number=count)
    without = [_Place(text, "--mask-negative", 2, scene) for text in beside]
    if without and not count:
        raise InputError("--mask-negative takes away from what --mask-click or --mask-box shows: give one of these, too.")
    for place, prompt in corrections:
        key = place.among(count), place.frame
        before = shown.get(key, Prompt(place.frame, number=key[0]))
        shown[key] = replace(before, clicks=before.clicks + prompt.clicks, box=prompt.box or before.box)
    for place in without:
        numbers = range(1, count + 1) if place.number is None else [place.among(count)]
        for number in numbers:
            before = shown.get((number, place.frame), Prompt(place.frame, number=number))
            shown[number, place.frame] = replace(before, beside=(*before.beside, place.point))
    near = CLICK_RADIUS * max(scene.width, scene.height)
    for prompt in shown.values():
        if any(np.hypot(x - u, y - v) < near for x, y in prompt.clicks for u, v in prompt.beside):
            raise InputError(f"A click and --mask-negative say the opposite of one place on frame {prompt.frame}: leave one out.")
    first = {number: next(frame for n, frame in shown if n == number) for number in range(1, count + 1)}
    return [shown[key] for key in sorted(shown, key=lambda key: (key[0], key[1] != first[key[0]], key[1]))]


class _Place:
    """A place as it is typed, perhaps with the number of an object."""

    def __init__(self, text: str, option: str, count: int, scene: FrameNumbers):
        place, equals, number = text.partition("=")
        if equals and not re.fullmatch(r"\s*[1-9]\d{0,2}\s*", number):
            raise InputError(f"{option} {text} cannot be understood: behind = stands the number of an object, 1 or more.")
        self.text, self.option = text, option
        self.number = int(number) if equals else None
        self.frame, self.values = parse_place(place, option, count, scene)

    @property
    def point(self) -> Point:
        return self.values[0], self.values[1]

    def holds(self, other: _Place) -> bool:
        """Return whether a point lies in this box."""
        x0, y0, x1, y1 = self.values
        return x0 <= other.values[0] <= x1 and y0 <= other.values[1] <= y1

    def among(self, count: int) -> int:
        """Return the number, which must be one of ``count`` objects."""
        assert self.number is not None
        if self.number > count:
            shown = f"{self.option} {self.text}: there is no object {self.number}"
            raise InputError(f"{shown}; clicks and boxes show {count or 'none'}.")
        return self.number


def split_shot(text: str) -> tuple[int | None, str]:
    """Return the shot that a place on a frame of a clip with cuts names, and the place as the run of that shot takes it.

    Args:
        text: ``x,y@shot/frame``, perhaps with more behind it; shots count from 1. Anything else names no shot.

    Examples:
        >>> split_shot("0.5,0.4@2/7=1"), split_shot("0.5,0.4@7")
        ((2, '0.5,0.4@7=1'), (None, '0.5,0.4@7'))
    """
    match = re.fullmatch(r"([^@]*@)\s*([1-9]\d{0,3})\s*/(.*)", text, re.DOTALL)
    return (None, text) if match is None else (int(match[2]), match[1] + match[3])


def parse_place(text: str, option: str, count: int, scene: FrameNumbers) -> tuple[int, tuple[float, ...]]:
    """Return the frame and the ``count`` (2 or 4) values, in pixels, of a place in a training frame as it is typed.

    Args:
        option: that it was given to, for messages.

    Raises:
        InputError: as ``parse_prompts``.
    """
    form = ("x,y" if count == 2 else "x0,y0,x1,y1") + "@frame"
    match = re.fullmatch(rf"\s*({_NUMBER}(?:\s*,\s*{_NUMBER}){{{count - 1}}})\s*@\s*(\d{{1,9}})\s*", text)
    if match is None:
        shot, place = split_shot(text)
        if shot is not None:
            raise InputError(f"{option} {text} names shot {shot} of a clip with cuts, and this is one scene: give {place}.")
        raise InputError(f"{option} {text} cannot be understood: give {form}, for example {option} {_EXAMPLES[count]}.")
    values, frame = np.array([float(value) for value in match[1].split(",")]), int(match[2])
    limits = np.array([scene.width, scene.height] * (count // 2))
    if values.max() <= 1:
        values = values * limits
    if count == 4:
        values = np.clip(values, 0, limits)  # A box may reach over the edge.
    if (values < 0).any() or (values > limits).any():
        raise InputError(f"{option} {text} lies outside the frames, which have {scene.width}x{scene.height} pixels.")
    if frame in scene.heldout_frames:
        near = min(scene.train_frames, key=lambda i: abs(i - frame))
        raise InputError(f"{option} {text}: frame {frame} is held out for the figures; choose another, for example {near}.")
    if frame not in scene.train_frames:
        raise InputError(f"{option} {text}: there is no frame {frame}; they count from 0 to {scene.num_frames - 1}.")
    return frame, tuple(values.tolist())
