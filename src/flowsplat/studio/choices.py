"""What is chosen on the page for a clip, and the options of ``flowsplat run`` that say the same."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Annotated, Any, Literal

import msgspec
import tyro
from msgspec import Meta
from typing_extensions import NotRequired, TypedDict

from flowsplat.common.errors import InputError
from flowsplat.pipeline.config import RunConfig, check, preset

PRESETS = ("fast", "default", "high", "paper")
"""In the order of the page."""
LARGE = "default"
"""One whose frames are as large as those of any."""

Share = Annotated[float, Meta(ge=0, le=1)]
Second = Annotated[float, Meta(ge=0, le=1e6)]


Frame = Annotated[int, Meta(ge=0, le=99_999)] | Annotated[str, Meta(pattern=r"^[1-9][0-9]{0,3}/(0|[1-9][0-9]{0,4})\Z")]
"""What stands behind the @ of a place: the number of a frame among those that are used, or ``shot/number`` of a clip with cuts."""


class Mark(TypedDict):
    """A place on a frame: shares of width and height, the frame, and its second in the whole clip, which stays when the cut
    changes."""

    x: Share
    y: Share
    frame: Frame
    second: Second


class MarkedObject(TypedDict):
    """Something that moves: places on it, and places that are not it."""

    clicks: Annotated[list[Mark], Meta(max_length=100)]
    beside: Annotated[list[Mark], Meta(max_length=100)]


class Choices(TypedDict):
    """All that is chosen. ``shots``: whether each shot of a clip with cuts becomes a scene; what was chosen before there was this
    choice has none."""

    start: Second | None
    end: Second | None
    preset: Literal["fast", "default", "high", "paper"]
    objects: Annotated[list[MarkedObject], Meta(max_length=50)]
    contacts: Annotated[list[Mark], Meta(max_length=50)]
    shots: NotRequired[Literal["split", "off"]]


def first_choices() -> Choices:
    """Return what is chosen before anything is: the whole clip, a quick try."""
    return {"start": None, "end": None, "preset": "fast", "objects": [], "contacts": [], "shots": "split"}


def read_choices(value: Any) -> Choices:
    """Return choices that came from a page.

    Raises:
        InputError: they are none.
    """
    try:
        msgspec.convert(value, Choices)
    except msgspec.ValidationError as error:
        raise InputError(f"The page asks for what cannot be: {error}.") from error
    found: Choices = {name: value[name] for name in Choices.__annotations__ if name in value}  # type: ignore[assignment]
    if found["end"] is not None and found["end"] <= (found["start"] or 0):
        raise InputError("The end of the cut must come after its start.")
    return found


def list_cut(choices: Choices, preset: str | None = None) -> list[str]:
    """Return the options of ``flowsplat run`` that tell which frames are used, and how well.

    Args:
        preset: another one than the chosen one.
    """
    arguments = ["--preset", preset or choices["preset"]]
    for option in ("start", "end"):
        value = choices[option]
        if value is not None:
            arguments += [f"--{option}", f"{value:.3f}".rstrip("0").rstrip(".")]
    return arguments


def list_places(choices: Choices) -> list[str]:
    """Return those of what moves and of where it touches the ground. Each shot counts its objects;
    those without a click on them there say nothing."""
    marks = [mark for each in choices["objects"] for mark in (*each["clicks"], *each["beside"])] + choices["contacts"]
    shots = sorted({shot_of(mark) for mark in marks})
    return [word for shot in shots for word in _list_places_of_shot(choices, shot)]


def _list_places_of_shot(choices: Choices, shot: int) -> list[str]:
    arguments: list[str] = []
    number = 0
    for each in choices["objects"]:
        clicks = [mark for mark in each["clicks"] if shot_of(mark) == shot]
        if not clicks:
            continue
        number += 1
        first, *others = clicks
        arguments += ["--mask-click", _place(first)]
        for mark in others:
            arguments += ["--mask-click", f"{_place(mark)}={number}"]
        for mark in each["beside"]:
            if shot_of(mark) == shot:
                arguments += ["--mask-negative", f"{_place(mark)}={number}"]
    for mark in choices["contacts"]:
        if shot_of(mark) == shot:
            arguments += ["--contact", _place(mark)]
    return arguments


def shot_of(mark: Mark) -> int:
    """Return the number of the shot that a place is in, 0 in a clip that is one scene."""
    return split_frame(mark["frame"])[0]


def split_frame(frame: int | str) -> tuple[int, int]:
    """Return the shot (0: the clip is one scene) and the number in it of a frame.

    Examples:
        >>> split_frame("2/7"), split_frame(7)
        ((2, 7), (0, 7))
    """
    shot, _, number = str(frame).rpartition("/")
    return int(shot or 0), int(number)


def name_frame(shot: int, number: int) -> int | str:
    """Return what stands behind the @ of a place: the opposite of ``split_frame``."""
    return f"{shot}/{number}" if shot else number


def list_idle_marks(choices: Choices) -> list[str]:
    """Return, in sentences, which places say nothing: those that are not an object, in a shot without a click on it."""
    found = []
    for number, each in enumerate(choices["objects"], 1):
        shown = {shot_of(mark) for mark in each["clicks"]}
        idle = sorted({shot_of(mark) for mark in each["beside"]} - shown)
        found += [
            f"What is not object {number} in shot {shot} says nothing: click on the object itself there, too."
            for shot in idle
            if shot
        ]
    return found


def list_arguments(choices: Choices, run_options: Sequence[str] = ()) -> list[str]:
    """Return all options: those that every run gets first, so that the page's own go before them."""
    return [*run_options, *list_cut(choices), *list_places(choices)]


def _place(mark: Mark) -> str:
    return f"{mark['x']:.4g},{mark['y']:.4g}@{mark['frame']}"


def split_options(text: str) -> tuple[str, ...]:
    """Return the options of ``--run-options``, once it is certain that ``flowsplat run`` takes them.

    Raises:
        InputError: it does not.
    """
    try:
        options = tuple(shlex.split(text))
    except ValueError as error:
        raise InputError(f"--run-options {text} cannot be understood: {error}.") from error
    if "--preset" in options:
        raise InputError("--run-options cannot hold --preset, which is chosen on the page.")
    try:
        read_config(options)
    except InputError as error:
        raise InputError(f"--run-options: {error}") from error
    return options


def read_config(arguments: Sequence[str]) -> RunConfig:
    """Return the settings of a run with these options, as the command line would have them.

    Raises:
        InputError: an option is unknown, or its value cannot be.
    """
    return _read_config(tuple(arguments))


@lru_cache(maxsize=256)
def _read_config(arguments: tuple[str, ...]) -> RunConfig:
    rest, name = list(arguments), "default"
    if "--preset" in rest:
        k = rest.index("--preset")
        name = rest[k + 1]
        del rest[k : k + 2]
    try:
        config = tyro.cli(RunConfig, args=rest, default=preset(name), prog="flowsplat run", console_outputs=False)
    except SystemExit as error:
        raise InputError(f"flowsplat run does not take {shlex.join(rest)}: flowsplat run --help-all lists its options.") from error
    config.input.check()
    check(config)
    return config


def keep_marks(choices: Choices, seconds: Mapping[int | str, float], tolerance: float) -> tuple[Choices, int]:
    """Return choices whose places are on the frames that another cut has, and how many had to go.

    Args:
        seconds: of the frames that places may be given on, by what stands behind the @ of a place.
        tolerance: seconds that count as the same moment.
    """
    lost = 0

    def keep(marks: Sequence[Mark]) -> list[Mark]:
        nonlocal lost
        found = []
        for mark in marks:
            number = min(seconds, key=lambda i: abs(seconds[i] - mark["second"]))
            if abs(seconds[number] - mark["second"]) <= tolerance:
                found.append(Mark(x=mark["x"], y=mark["y"], frame=number, second=seconds[number]))
            else:
                lost += 1
        return found

    objects = [MarkedObject(clicks=keep(each["clicks"]), beside=keep(each["beside"])) for each in choices["objects"]]
    kept: Choices = {
        **choices, "objects": [each for each in objects if each["clicks"] or each["beside"]], "contacts": keep(choices["contacts"]),
    }  # fmt: skip
    return kept, lost
