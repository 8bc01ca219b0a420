"""Every setting of a run in one frozen dataclass, and its presets. The command line, the API and ``run.json`` share it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, cast, get_args, get_type_hints

import tyro

from flowsplat.common.devices import DeviceName, pick_device
from flowsplat.common.errors import InputError
from flowsplat.common.settings import to_plain
from flowsplat.output.videos import RenderOptions
from flowsplat.priors.prepare import PriorsOptions
from flowsplat.scenes.clip import InputOptions
from flowsplat.training.config import PRESETS, TrainConfig

Config = TypeVar("Config")
Baselines = Literal["simple", "all"]


@dataclass(frozen=True)
class RunConfig:
    """All settings of a run."""

    input: Annotated[InputOptions, tyro.conf.arg(name="")] = field(default_factory=InputOptions)
    """What to take from the input."""
    priors: Annotated[PriorsOptions, tyro.conf.arg(name="")] = field(default_factory=PriorsOptions)
    """Where cameras, depth, masks, flow and tracks come from."""
    train: TrainConfig = field(default_factory=lambda: PRESETS["default"])
    """How the scene is trained."""
    render: RenderOptions = field(default_factory=RenderOptions)
    """Which videos are made."""
    baselines: Baselines = "simple"
    """What the result is compared with; ``all`` also trains our own static scene (a quarter of the training time)."""
    refine_poses: bool = True
    """Also measure held-out frames with their poses refined on their own pictures: beside the strict figures, never instead."""
    device: DeviceName = "auto"
    """What to train and render on: ``auto`` is the GPU where it works."""


def preset(name: str) -> RunConfig:
    """The settings called ``name``.

    ``fast``: half size and 400 steps, about two minutes: does this clip work at all? ``default``: the best within minutes.
    ``paper``: the paper's settings (METHOD 5). ``high``: a denser background and four times as many steps, which is about five
    times the training of ``default``.

    Raises:
        InputError: there is no such preset.
    """
    ours = PRESETS["default"]
    presets = {
        "default": RunConfig(),
        "fast": RunConfig(
            input=InputOptions(resize=427),
            train=replace(ours, iterations=400, density=replace(ours.density, every=100, start=100)),
            render=RenderOptions(max_frames=48),
        ),
        "paper": RunConfig(train=PRESETS["paper"]),
        "high": RunConfig(
            train=replace(ours, iterations=4 * ours.iterations, init=replace(ours.init, background_spacing=1.2))
        ),
    }
    if name not in presets:
        raise InputError(f"Unknown preset {name!r}: choose one of {', '.join(presets)}.")
    return presets[name]


def flat(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings (``to_plain``) by dotted name."""
    found: dict[str, Any] = {}
    for name, value in config.items():
        found |= flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return found


def check(config: RunConfig) -> None:
    """Refuse settings that no run can have.

    Raises:
        InputError: names the option, or says why the device does not work.
    """
    for name, value in flat(to_plain(config)).items():
        if isinstance(value, float) and not math.isfinite(value):
            option = name.removeprefix("input.").removeprefix("priors.").replace("_", "-")
            raise InputError(f"--{option} is {value}: give a number.")
    config.train.check()
    pick_device(config.device)


def from_plain(kind: type[Config], value: dict[str, Any]) -> Config:
    """The inverse of ``to_plain``. Fields that the file lacks keep their defaults.

    Raises:
        InputError: the file has a field that does not exist.
    """
    hints = get_type_hints(kind)
    arguments: dict[str, Any] = {}
    for name, item in value.items():
        if name not in hints:
            raise InputError(f"Unknown setting {name!r} in {kind.__name__}.")
        hint = hints[name]
        if dataclasses.is_dataclass(hint) and isinstance(item, dict):
            item = from_plain(cast("type[Any]", hint), item)
        elif isinstance(item, list):
            item = tuple(item)
        elif isinstance(item, str) and (hint is Path or Path in get_args(hint)):
            item = Path(item)
        arguments[name] = item
    return kind(**arguments)
