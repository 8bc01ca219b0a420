"""The rows: the paper's are all there with its differences, and every one can be trained."""

from __future__ import annotations

from dataclasses import asdict

import pytest

from flowsplat.common.errors import InputError
from flowsplat.gaussians.motion import motion_model
from flowsplat.training.config import PRESETS, TrainConfig
from flowsplat_benchmarks.ablations.claims import CLAIMS, FULL, PAPER_ORDERS, TITLES, choose_claims, list_needed_variants
from flowsplat_benchmarks.ablations.variants import Variant, change_settings

PAPER = {
    "linear": -0.85, "no-q": -0.71, "no-mu": -0.78, "random": -2.05, "no-velocity": -3.13, "no-rigid": -1.15,
    "orders-1133": -0.28, "orders-3333": 0.0, "orders-3366": -0.16, "orders-6611": -0.24, "orders-6666": -0.16,
    "orders-8866": -0.32, "4dgs": -5.81,
}  # fmt: skip


def test_the_papers_differences():
    found = {claim.variant.name: claim.paper for claim in CLAIMS if claim.paper is not None}
    assert found == PAPER
    for claim in CLAIMS:
        if claim.paper is not None:
            assert claim.expected == (claim.paper > 0) - (claim.paper < 0)


def test_names_are_unique_and_settings_exist():
    names = [(claim.group, claim.variant.name) for claim in CLAIMS]
    assert len(set(names)) == len(names)
    assert {claim.group for claim in CLAIMS} == set(TITLES)
    by_name = {}
    for variant in list_needed_variants(CLAIMS):
        assert by_name.setdefault(variant.name, variant) == variant
        config = variant.config(100, 5000, 3)
        assert (config.iterations, config.frames_per_iteration, config.seed, config.density.max_gaussians) == (100, 1, 3, 5000)
    configs = [asdict(v.config(100, 5000, 0)) for v in by_name.values() if v.kind == "moving"]
    assert all(configs.count(config) == 1 for config in configs), "no two rows train the same"


def test_the_baseline_of_the_paper():
    variant = next(claim.variant for claim in CLAIMS if claim.variant.name == "4dgs")
    config = variant.config(1500, 5000, 0)
    assert type(motion_model(config.model)).__name__ == "LinearMotion"
    assert not config.init.from_priors
    assert config.loss.flow == config.loss.rigid == config.loss.depth == 0
    assert config.density.gradient == PRESETS["paper"].density.gradient
    assert variant.settings.startswith("preset paper, model.move_means False")


def test_choosing_rows_brings_their_bases():
    claims = choose_claims(["sh-0", "orders-1133"])
    assert [variant.name for variant in list_needed_variants(claims)] == ["orders-6633", "full", "orders-1133", "sh-0"]
    assert {claim.group for claim in choose_claims(["training"])} == {"training"}
    assert choose_claims([]) == list(CLAIMS)
    assert PAPER_ORDERS in list_needed_variants(choose_claims(["ours"]))
    assert FULL in list_needed_variants(choose_claims(["static"]))
    with pytest.raises(InputError, match="no row 'nothing': choose from representation, "):
        choose_claims(["nothing"])


def test_changing_settings():
    config = change_settings(TrainConfig(), {"seed": 4, "model.gains": 3, "loss.flow": 0.0})
    assert (config.seed, config.model.gains, config.loss.flow) == (4, 3, 0.0)
    assert config.model.sh_degree == TrainConfig().model.sh_degree
    for path in ("nothing", "model.nothing", "seed.nothing"):
        with pytest.raises(ValueError, match="no setting"):
            change_settings(TrainConfig(), {path: 1})
    assert Variant("full", "all").settings == ""
