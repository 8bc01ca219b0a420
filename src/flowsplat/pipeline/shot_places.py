"""Places on the frames of single shots of a clip with cuts: which shot each is of, and what the run of that shot is told."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from flowsplat.common.errors import InputError
from flowsplat.pipeline.config import RunConfig
from flowsplat.priors.options import PriorsOptions
from flowsplat.priors.prepare import check_places
from flowsplat.priors.prompts import split_shot
from flowsplat.scenes.clip import InputOptions
from flowsplat.scenes.ingest import open_clip

PLACES = ("mask_click", "mask_box", "mask_negative", "contact", "same_depth")
"""The options of the priors that hold places."""


def names_frames(config: RunConfig) -> bool:
    """Return whether settings are of frames or seconds of the whole clip, which those of a shot are not."""
    given, render = config.priors.given, config.render
    whole = config.input.holdout_frames or given.named or given.object_depth or render.camera_file
    return bool(whole) or render.bullet_time is not None or any(shot is None for _, _, shot in _list_places(config.priors))


def check_shots(options: PriorsOptions, count: int) -> None:
    """Refuse places that are of no shot of a clip.

    Args:
        count: how many shots it has.

    Raises:
        InputError: names the first such place.
    """
    for option, text, shot in _list_places(options):
        if shot is None:
            raise InputError(f"--{option} {text}: the clip has {count} shots, so say of which one: x,y@shot/frame, as @1/0.")
        if shot > count:
            raise InputError(f"--{option} {text}: there is no shot {shot}; the clip has {count}.")


def take_places(options: PriorsOptions, shot: int) -> PriorsOptions:
    """Return the settings with the places of one shot alone, as its run takes them.

    Args:
        options: whose places all name a shot.
        shot: its number, from 1 on.
    """
    found: dict[str, Any] = {}
    for name in PLACES:
        places = map(split_shot, getattr(options, name))
        found[name] = tuple(place for number, place in places if number == shot)
    return replace(options, **found)


def check_places_of_shot(source: Path, options: InputOptions, priors: PriorsOptions, shot: int) -> None:
    """Refuse places that the run of a shot would refuse, before the shots ahead of it are computed.

    Args:
        source: the clip.
        options: what to take of it for this shot.
        priors: settings with places of all shots.
        shot: its number.

    Raises:
        InputError: says of which shot it is.
    """
    own = take_places(priors, shot)
    if not _list_places(own):
        return
    clip = open_clip(source, options)
    frames = _Frames(clip.width, clip.height, clip.num_frames, *clip.split(options))
    try:
        check_places(frames, own)
    except InputError as error:
        raise InputError(f"Shot {shot}: {error}") from error


@dataclass(frozen=True)
class _Frames:
    """Those of a shot that is no scene yet (``prompts.FrameNumbers``)."""

    width: int
    height: int
    num_frames: int
    train_frames: list[int]
    heldout_frames: list[int]


def _list_places(options: PriorsOptions) -> Sequence[tuple[str, str, int | None]]:
    """Return all places, each with its option as it is typed, and the shot that it names."""
    return [(name.replace("_", "-"), text, split_shot(text)[0]) for name in PLACES for text in getattr(options, name)]
