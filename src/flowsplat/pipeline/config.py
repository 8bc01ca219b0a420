"""Configure a run: every setting in one frozen dataclass, and its presets. The command line, the API and ``run.json`` share it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal, get_type_hints

import tyro

from flowsplat.common.devices import DeviceName, pick_device
from flowsplat.common.errors import InputError
from flowsplat.common.settings import flat, list_setting_types, to_plain
from flowsplat.output.videos import RenderOptions
from flowsplat.output.videos.options import check_paths
from flowsplat.priors.options import PriorsOptions
from flowsplat.scenes.clip import InputOptions
from flowsplat.training.config import PRESETS, TrainConfig

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
    """Also measure held-out frames with their poses refined on their own images: beside the strict figures, never instead."""
    final_fit: bool = True
    """After the measurement, fit the held-out frames, too, and make videos, exports and the viewer's images of the result. The
    figures stay those of the model that has not seen them."""
    coarse_scene: bool = True
    """Begin a run of more than some four minutes with a coarse scene of few small frames (``coarse/``), to look at meanwhile."""
    device: DeviceName = "auto"
    """What to train and render on: ``auto`` is the GPU where it works."""


PRESET_NAMES = ("default", "fast", "paper", "high")
"""Those of ``preset``, the one without a name first."""


def preset(name: str) -> RunConfig:
    """Return the settings called ``name``.

    ``fast``: half size, 300 steps and no final fit, about two minutes: does this clip work at all? ``default``: the best
    within minutes. ``paper``: the paper's settings (docs/method/training.md). ``high``: Gaussians closer together and five times
    as many steps, which is about ten times the training of ``default``.

    Raises:
        InputError: there is no such preset.

    Examples:
        >>> flowsplat.preset("fast").train.iterations, flowsplat.preset("high").train.iterations
        (300, 8000)
    """
    ours = PRESETS["default"]
    presets = {
        "default": RunConfig(),
        "fast": RunConfig(
            input=InputOptions(resize=427),
            train=replace(ours, iterations=300, density=replace(ours.density, every=100, start=100)),
            render=RenderOptions(max_frames=48),
            final_fit=False,
        ),
        "paper": RunConfig(train=PRESETS["paper"]),
        "high": RunConfig(
            train=replace(ours, iterations=5 * ours.iterations, init=replace(ours.init, background_spacing=1.2, spacing_growth=0.0))
        ),
    }
    if name not in presets:
        raise InputError(f"Unknown preset {name!r}: choose one of {', '.join(presets)}.")
    return presets[name]


def format_option(name: str) -> str:
    """Return the option of the command line for a setting of a run by its dotted name."""
    return "--" + name.removeprefix("input.").removeprefix("priors.").replace("_", "-")


def _short_options() -> dict[str, str]:
    """Return the settings of training that the command line takes by a short name, too (``tyro.conf.arg(aliases=...)``)."""
    hints = get_type_hints(TrainConfig, include_extras=True)
    annotated = ((name, extra) for name, hint in hints.items() for extra in getattr(hint, "__metadata__", ()))
    return {alias: f"train.{name}" for name, extra in annotated for alias in getattr(extra, "aliases", None) or ()}


def list_options(config: RunConfig) -> list[str]:
    """Return the options of ``flowsplat run`` that give these settings: the preset from which the fewest differ, and those.

    Examples:
        >>> from dataclasses import replace
        >>> list_options(replace(preset("fast"), final_fit=True))
        ['--preset', 'fast', '--final-fit']
    """
    wanted = flat(to_plain(config))
    differing = {}
    for name in PRESET_NAMES:
        base = flat(to_plain(preset(name)))
        differing[name] = [(key, value) for key, value in wanted.items() if key not in base or base[key] != value]
    nearest = min(differing, key=lambda name: len(differing[name]))
    words = [] if nearest == PRESET_NAMES[0] else ["--preset", nearest]
    return words + [word for key, value in differing[nearest] for word in _format_setting(key, value)]


def _format_setting(name: str, value: Any) -> list[str]:
    option = format_option(name)
    if isinstance(value, bool):
        *within, last = option.removeprefix("--").split(".")
        return ["--" + ".".join([*within, last if value else f"no-{last}"])]
    if not isinstance(value, list):
        return [option, str(value)]
    hint = get_type_hints(PriorsOptions, include_extras=True).get(name.removeprefix("priors."))
    if tyro.conf.UseAppendAction in getattr(hint, "__metadata__", ()):
        return [word for each in value for word in (option, str(each))]
    return [option, *map(str, value)]


def find_setting(option: str) -> str | None:
    """Return the inverse of ``format_option``, None where there is no such option.

    Hyphens in front may be missing, and those within may be underscores. Settings with a short name have that, too.
    """
    options = {format_option(name): name for name in list_setting_types(RunConfig)} | _short_options()
    return options.get("--" + option.lstrip("-").replace("_", "-"))


def check(config: RunConfig) -> None:
    """Refuse settings that no run can have.

    Raises:
        InputError: names the option, or says why the device does not work.
    """
    for name, value in flat(to_plain(config)).items():
        if isinstance(value, float) and not math.isfinite(value):
            raise InputError(f"{format_option(name)} is {value}: give a number.")
    config.train.check()
    check_paths(config.render.paths)
    pick_device(config.device)
