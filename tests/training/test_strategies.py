"""Strategies of density control: each trains, goes on from a checkpoint to the same bits, and does what it says."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from flowsplat.common.errors import InputError
from flowsplat.gaussians.density import DensityResult
from flowsplat.splatting.relocation import share_place
from flowsplat.training.checkpoint import read_tensors, write_tensors
from flowsplat.training.strategies import STRATEGIES
from flowsplat.training.strategies.mcmc import GROWTH, MCMCStrategy
from flowsplat.training.trainer import Trainer
from tests.training.handful import a_few, seen, tiny


def settings(strategy, **density):
    config = tiny("default", average=0.0)
    chosen = {"every": 3, "start": 2, "gradient": 1e-6, "reset_every": 5, "prune_scale": 0.0, "max_gaussians": 60, **density}
    return replace(config, strategy=strategy, iterations=12, density=replace(config.density, **chosen))


def same(a, b):
    return all(torch.equal(a.params[name], b.params[name]) for name in a.params) and torch.equal(a.dynamic, b.dynamic)


@pytest.mark.parametrize("strategy", STRATEGIES.names())
def test_each_trains_and_goes_on_from_a_checkpoint_to_the_same_bits(strategy, tmp_path):
    config = replace(settings(strategy), checkpoint_every=7)
    start = a_few(config)
    whole = Trainer(seen(start), None, config, tmp_path, start=start).run()
    assert all(value.isfinite().all() for value in whole.params.values())
    assert 0 < len(whole) <= 60
    if strategy in ("default", "paper", "gsplat", "mcmc"):
        assert len(whole) > len(a_few(config))
    again = Trainer(seen(a_few(config)), None, config, tmp_path)
    assert same(again.run(), whole)
    assert again.state.history.entries[-1]["step"] == 12


def test_the_papers_is_ours_where_nothing_is_revised():
    found = []
    for strategy in ("default", "paper"):
        config = settings(strategy, revise=False)
        found.append(Trainer(seen(a_few(config)), None, config, start=a_few(config)).run())
    assert same(*found)


def test_an_unknown_one_is_refused_with_those_that_there_are():
    with pytest.raises(InputError, match=r"Unknown strategy 'best': choose one of default, paper, gsplat, mcmc"):
        replace(tiny("default"), strategy="best").check()


def test_a_checkpoint_without_its_statistics_or_with_others_is_refused(tmp_path):
    config = replace(settings("gsplat"), checkpoint_every=7)
    Trainer(seen(a_few(config)), None, config, tmp_path, start=a_few(config)).run()
    (path,) = tmp_path.glob("*.safetensors")
    tensors, values = read_tensors(path)
    count = len(tensors["statistics.visits"])
    without = {name: value for name, value in tensors.items() if name != "statistics.visits"}
    for wrong in (
        without,
        {**tensors, "statistics.visits": torch.zeros(count, 2)},
        {**tensors, "statistics.more": torch.zeros(count)},
    ):
        write_tensors(path, wrong, values)
        with pytest.raises(InputError, match=r"damaged: .*statistics\.(visits|more)"):
            Trainer(seen(a_few(config)), None, config, tmp_path).run()


def test_gsplats_resets_to_twice_the_opacity_that_is_pruned():
    config = settings("gsplat", gradient=1e3, reset_every=5)
    trainer = Trainer(seen(a_few(config)), None, replace(config, iterations=12), start=a_few(config))
    highest = []
    trainer.callbacks.append(
        lambda state, _, __: highest.append(float(torch.sigmoid(state.gaussians.params["logit_opacities"]).max()))
    )
    trainer.run()
    reset = 2 * config.density.prune_opacity
    assert highest[5] == pytest.approx(reset, rel=1e-4)
    assert highest[4] > 0.3


@pytest.mark.parametrize("opacity", [0.006, 0.3, 0.97])
@pytest.mark.parametrize("count", [1, 2, 5, 51])
def test_those_who_share_a_place_look_together_as_the_one_did(opacity, count):
    """Against the double sum of the paper's eq. 9, and the opacity of several in one place."""
    new, factor = share_place(torch.tensor([opacity], dtype=torch.float64), torch.tensor([count]))
    assert 1 - (1 - float(new)) ** count == pytest.approx(opacity)
    total = sum(
        math.comb(i, k) * (-1) ** k * float(new) ** (k + 1) / math.sqrt(k + 1) for i in range(count) for k in range(i + 1)
    )  # fmt: skip
    assert float(factor) == pytest.approx(opacity / total, rel=1e-6)
    assert 0 < float(factor) <= 1 + 1e-9


def test_mcmc_moves_the_transparent_and_adds_some_until_the_cap():
    config = settings("mcmc", max_gaussians=30)
    start = a_few(config)
    start.params["logit_opacities"][:] = torch.where(torch.arange(24) < 6, -9.0, 0.0)  # a quarter of them is not to be seen
    trainer = Trainer(seen(a_few(config)), None, config, start=start)
    counts, dead = [], []

    def look(state, _step, _figures):
        counts.append(len(state.gaussians))
        dead.append(int((torch.sigmoid(state.gaussians.params["logit_opacities"]) <= config.density.prune_opacity).sum()))

    trainer.callbacks.append(look)
    trainer.run()
    assert dead[0] == 6
    assert counts[2] == 24
    assert counts[3] == int((1 + GROWTH) * 24)
    assert dead[3] == 0
    assert counts[-1] == int((1 + GROWTH) * int((1 + GROWTH) * counts[3]))


def test_mcmc_moves_about_only_what_is_transparent():
    config = settings("mcmc", every=0)
    trainer = Trainer(seen(a_few(config)), None, config, start=a_few(config))
    trainer.begin()
    opaque = torch.arange(24) % 2 > 0
    trainer.gaussians.params["logit_opacities"][:] = torch.where(opaque, 3.0, -9.0)
    before = trainer.gaussians.params["means"].clone()
    MCMCStrategy(config, trainer.observations)._add_noise(trainer.state)
    moved = (trainer.gaussians.params["means"] - before).norm(dim=1)
    assert float(moved[opaque].max()) < 1e-3 * float(moved[~opaque].min())
    assert float(moved[~opaque].min()) > 0


@pytest.mark.parametrize(
    ("index", "is_new"),
    [([0, 1], [False]), ([0, 1, 2], [False] * 3), ([0, 24], [False] * 2), ([0, -1], [False] * 2), ([0, 1], [0, 0])],
)
def test_rows_that_cannot_be_are_refused_before_anything_changes(index, is_new):
    config = settings("default")
    trainer = Trainer(seen(a_few(config)), None, config, start=a_few(config))
    trainer.begin()
    two = trainer.gaussians.select(torch.tensor([0, 1]))
    with pytest.raises(ValueError, match="index"):
        trainer.state.adopt(DensityResult(two, torch.tensor(index), torch.tensor(is_new)))
    assert len(trainer.gaussians) == len(trainer.state.optimizer.counts) == 24
