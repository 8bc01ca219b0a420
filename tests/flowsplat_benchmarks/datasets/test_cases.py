"""What each protocol finds under a data root, and what it fixes."""

from __future__ import annotations

import shutil
from dataclasses import replace

import pytest

from flowsplat.common.errors import InputError
from flowsplat.pipeline import RunConfig, preset
from flowsplat_benchmarks.datasets import davis_cases, nvidia_cases, rig_cases


def test_davis_with_the_masks_that_are_given(runs_root):
    bear, plain = davis_cases(runs_root)
    assert (bear.name, plain.name) == ("bear_given-masks_default", "plain_own-masks_default")
    assert bear.source == runs_root / "davis" / "bear"
    assert plain.source == runs_root / "davis" / "plain" / "images"
    assert bear.is_tuned
    assert not plain.is_tuned
    for case in (bear, plain):
        assert case.lent is None
        assert case.config.input.holdout == 10
        assert case.config.input.every == 1
        assert case.config.baselines == "all"
        assert case.config.refine_poses


def test_davis_with_our_own_masks(runs_root):
    (bear,) = davis_cases(runs_root, ["bear"], masks="own", preset_name="fast")
    assert bear.name == "bear_own-masks_fast"
    assert bear.source == runs_root / "davis" / "bear" / "images"
    assert bear.lent == (runs_root / "davis" / "bear", bear.config.input)
    assert bear.config.input.resize is None  # half the size is not the protocol
    assert bear.config.train == preset("fast").train


def test_davis_as_it_is_published(runs_root, tmp_path):
    for kind, ours in (("JPEGImages", "images"), ("Annotations", "masks")):
        shutil.copytree(runs_root / "davis" / "bear" / ours, tmp_path / kind / "480p" / "bear")
    (given,) = davis_cases(tmp_path)
    assert given.source == tmp_path
    assert given.config.input.sequence == "bear"
    (own,) = davis_cases(tmp_path, masks="own")
    assert own.source == tmp_path / "JPEGImages/480p/bear"
    assert own.config.input.sequence is None
    assert own.lent == (tmp_path, given.config.input)


def test_the_folder_itself_may_be_given(runs_root):
    assert [case.scene for case in davis_cases(runs_root / "davis")] == ["bear", "plain"]


@pytest.mark.parametrize("priors", ["true", "own"])
def test_rig(runs_root, priors):
    (case,) = rig_cases(runs_root, priors=priors)
    assert case.name == f"tiny_{priors}-priors_default"
    assert case.config.priors.priors == priors
    assert case.config.input.holdout is None


def test_nvidia_in_every_form(runs_root):
    cases = {case.scene: case for case in nvidia_cases(runs_root)}
    assert {name: case.form for name, case in cases.items()} == {"Raw": "raw", "jumping": "twelve", "Balloon1": "nerfies"}
    sizes = {name: (case.config.input.resize, case.config.input.max_frames) for name, case in cases.items()}
    assert sizes["Raw"] == (384, 24)  # 288 high
    assert sizes["jumping"][0] == 480
    assert sizes["Balloon1"][0] == 96 // 2
    assert cases["jumping"].name == "jumping_twelve_given-cameras_default"


def test_what_differs_from_a_preset_is_named(runs_root):
    config = RunConfig()
    config = replace(config, train=replace(config.train, iterations=7, loss=replace(config.train.loss, flow=0.0)))
    (case,) = rig_cases(runs_root, config=config)
    assert case.settings == "default, iterations 7, loss.flow 0.0"
    assert case.name == "tiny_own-priors_default"


@pytest.mark.parametrize("find", [davis_cases, rig_cases, nvidia_cases])
def test_roots_that_cannot_be_used(find, runs_root, tmp_path):
    with pytest.raises(InputError, match="is no folder"):
        find(tmp_path / "missing")
    with pytest.raises(InputError, match="holds no scenes"):
        find(tmp_path)
    with pytest.raises(InputError, match="no scene 'nothing': choose from"):
        find(runs_root, ["nothing"])
