"""The box of a client: where its sliders end, and the command that exports it."""

from __future__ import annotations

import re
import shlex
from dataclasses import replace

import numpy as np
import pytest
import torch

pytest.importorskip("viser", reason="viser is not installed: pip install 'flowsplat[view]'")

from flowsplat.gaussians.crop import CropBox, compute_bounds, crop, parse_crop
from flowsplat.output.viewer.controls import as_code
from flowsplat.output.viewer.crop_panel import choose_ends, export_command
from flowsplat.output.viewer.source import Source
from tests.output.tiny import tiny_model


def moved(model, means: np.ndarray):
    """The same Gaussians elsewhere, in the coordinates of the scene."""
    there = torch.from_numpy(model.similarity.points(means)).float()
    return replace(model, gaussians=replace(model.gaussians, params={**model.gaussians.params, "means": there}))


def means_of(model) -> np.ndarray:
    return model.similarity.inverse().points(model.gaussians.params["means"].double().numpy())


def test_the_sliders_span_the_scene_but_for_stray_gaussians():
    model = tiny_model(1)
    means = means_of(model)
    means[:3] = [900.0, -900.0, 900.0]
    ends, steps = choose_ends(moved(model, means))
    assert compute_bounds(moved(model, means)).high[0] > 800
    assert np.abs([*ends.low, *ends.high]).max() < 10
    assert ends.low[0] < -4
    assert ends.high[0] > 4
    for low, high, step in zip(ends.low, ends.high, steps, strict=True):
        assert 200 <= round((high - low) / step) <= 510
        assert low / step == pytest.approx(round(low / step), abs=1e-6)
        assert step in [float(f"{factor}e{power}") for factor in (1, 2, 5) for power in range(-6, 3)]


def test_a_flat_scene_has_sliders_and_boxes_that_are_not_empty():
    model = tiny_model(0)  # a wall
    ends, steps = choose_ends(model)
    assert np.ptp(means_of(model)[:, 2]) < 1e-6
    assert ends.high[2] - ends.low[2] > 0.2
    assert parse_crop(str(ends)) is not None
    assert len(crop(model, ends).gaussians) > 0.9 * len(model.gaussians)
    alone = model.gaussians.select(torch.tensor([5]))
    ends, steps = choose_ends(replace(model, gaussians=alone))
    assert all(low < high for low, high in zip(ends.low, ends.high, strict=True))
    assert min(steps) > 0


def test_a_scene_without_gaussians_has_no_ends():
    with pytest.raises(ValueError, match="without Gaussians"):
        choose_ends(replace(tiny_model(0), gaussians=tiny_model(0).gaussians.select(torch.tensor([], dtype=torch.long))))


def test_the_command_is_one_that_a_shell_takes(run_folder):
    source = Source(run_folder)
    source.folder = run_folder.parent / "it's a run"
    box = CropBox((-1.0, -1.0, 0.5), (1.0, 1.25, 3.0))
    words = shlex.split(export_command(source, box))
    assert words[:5] == ["flowsplat", "export", str(source.folder), "--to", "html"]
    assert parse_crop(words[5].removeprefix("--crop=")) == box


@pytest.mark.parametrize("text", ["flowsplat export out/clip", "it`s ```odd```", ""])
def test_text_to_be_copied_is_whole(text):
    """As CommonMark reads code: between the first run of backticks and the next that is as long."""
    code = as_code(text)
    fence = code[: len(code) - len(code.lstrip("`"))]
    inside, rest = re.split(f"(?<!`){fence}(?!`)", code[len(fence) :], maxsplit=1)
    assert (inside, rest) == (f" {text} ", "")
