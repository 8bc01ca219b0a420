"""What a finished run tells its user to do: commands that can be typed as they are."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path

import pytest

from flowsplat.pipeline.config import RunConfig, list_options, preset
from flowsplat.pipeline.summary import list_steps
from flowsplat.studio.choices import read_config

OUT = Path("out/my clip")
OBJECT = {"number": 2, "sigma": 0.8, "cues": [], "hint": "44,43@7", "depth": 2.0, "largest_step": 0.01}


def words_of(metrics: dict, config: RunConfig | None = None) -> dict[str, str]:
    """Commands by what they are for."""
    steps = list_steps(OUT, "my clip.mp4", metrics, config or RunConfig())
    return {step.words: step.command for step in steps}


def everything() -> RunConfig:
    """A setting of every kind, none as any preset has it."""
    base = preset("default")
    priors = replace(
        base.priors, contact=("3,4@0", "5,6@1"), mask_click=("0.5,0.4@0",),
        given=replace(base.priors.given, masks=Path("a b"), tracks_size=(3, 4), allow_pickle=True),
    )  # fmt: skip
    model = replace(base.train.model, freeze_background=not base.train.model.freeze_background)
    return replace(
        base, priors=priors, input=replace(base.input, start=1.5, holdout=None, holdout_frames=(3, 5)), refine_poses=False,
        render=replace(base.render, paths=(), parts=("all", "objects"), stereo=True),
        train=replace(base.train, iterations=7, model=model),
    )  # fmt: skip


@pytest.mark.parametrize("config", [*map(preset, ("default", "fast", "paper", "high")), everything()])
def test_settings_as_options_are_the_same_settings(config):
    assert read_config(list_options(config)) == config


def test_a_guessed_distance_is_made_sure_by_one_command():
    config = preset("fast")
    (words, command), *_ = words_of({"objects": [OBJECT]}, config).items()
    assert "object 2 is a guess" in words
    assert "at 44,43 in frame 7" in words
    program, name, source, option, out, *options = shlex.split(command)
    assert (program, name, source, option, out) == ("flowsplat", "run", "my clip.mp4", "-o", str(OUT))
    assert read_config(options) == replace(config, priors=replace(config.priors, contact=("44,43@7",)))


def test_what_is_not_needed_is_not_told():
    shown = words_of({"objects": [{**OBJECT, "cues": ["contact"], "sigma": 0.05}], "heldout_frames": {"psnr": 34.0}})
    assert list(shown.values()) == ["flowsplat view 'out/my clip'", "flowsplat export 'out/my clip' --to html"]
    with_objects = words_of({"gaussians": {"objects": {"2": 30}}})
    assert "flowsplat render 'out/my clip' --render.paths input --render.parts background" in with_objects.values()


def test_what_is_soft_can_be_trained_longer_once():
    soft, longer = (
        {"heldout_frames": {"psnr": 25.0}},
        "flowsplat train 'out/my clip' --preset high && flowsplat render 'out/my clip'",
    )
    assert longer in words_of(soft).values()
    assert longer not in words_of(soft, preset("high")).values()
