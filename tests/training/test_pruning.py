"""Gaussians that are needed: how they are ranked, when the others go, and that a budget holds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from flowsplat.common.errors import InputError
from flowsplat.gaussians.gaussians4d import concatenate
from flowsplat.gaussians.observations import Observations
from flowsplat.training.config import PRESETS, START_FACTOR
from flowsplat.training.final import final_config
from flowsplat.training.per_frame import per_frame_config
from flowsplat.training.pruning import _share_of_part, choose_needed, rank_by_need
from flowsplat.training.static import static_config
from flowsplat.training.strategies import default
from flowsplat.training.trainer import Trainer
from tests.training.handful import a_few, seen, tiny


def settings(gaussians=0, **density):
    config = tiny("default", average=0.0)
    return replace(config, iterations=8, gaussians=gaussians, density=replace(config.density, prune_after=3, **density))


def test_shares_of_the_error_are_those_of_each_part():
    changes = torch.tensor([3.0, 1.0, 2.0, 10.0, 30.0, 0.0], dtype=torch.float64)
    numbers = torch.tensor([0, 0, 0, 7, 7, 9])
    errors = torch.zeros(256, dtype=torch.float64)
    errors[0], errors[7] = 10.0, 100.0
    lost = _share_of_part(changes, numbers, errors)
    torch.testing.assert_close(lost, torch.tensor([0.6, 0.1, 0.3, 0.1, 0.4, 0.0], dtype=torch.float64))
    errors[7] = 0.0
    assert torch.isfinite(_share_of_part(changes, numbers, errors)).all()
    assert float(_share_of_part(changes, numbers, errors)[3]) > 1e10, "a part without an error keeps all"


@pytest.mark.parametrize(
    ("share", "most", "rows"),
    [(0.0, 4, [0, 1, 2, 3]), (0.2, 4, [0, 2, 3]), (0.2, 2, [0, 3]), (0.0, 9, [0, 1, 2, 3]), (5.0, 4, [3]), (0.0, 1, [3])],
)
def test_the_neediest_stay(share, most, rows):
    lost = torch.tensor([0.4, 0.1, 0.2, 0.9], dtype=torch.float64)
    assert choose_needed(lost, share, most).tolist() == rows


def test_what_is_hidden_or_transparent_is_needed_least():
    config = settings()
    gaussians = a_few(config)
    gaussians.params["logit_opacities"] += 4.0
    faint = gaussians.select(torch.arange(0, 24, 4))
    faint.params["logit_opacities"][:] = -4.5
    behind = gaussians.select(torch.arange(1, 24, 4))
    behind.params["means"] *= 4  # on the same rays of the first camera, which hardly moves
    observations = seen(gaussians)
    lost = rank_by_need(concatenate([gaussians, faint, behind]), observations, seed=0)
    assert float(lost[24:].median()) < 0.02 * float(lost[:24].median())
    again = rank_by_need(concatenate([gaussians, faint, behind]), observations, seed=0)
    assert torch.equal(lost, again)


def test_a_small_object_is_measured_by_its_own_error():
    config = settings()
    gaussians = a_few(config)
    gaussians.object_ids = gaussians.dynamic.to(torch.uint8) * 3
    observations = seen(gaussians)
    numbers = np.zeros_like(observations[0].object_ids)
    numbers[4:8, 6:12] = 3
    of_object = Observations([replace(f, object_ids=numbers) for f in observations.frames], observations.similarity)
    whole, own = rank_by_need(gaussians, observations, 0), rank_by_need(gaussians, of_object, 0)
    rests = ~gaussians.dynamic
    ratio = own[rests] / whole[rests]
    assert float(ratio.min()) == pytest.approx(float(ratio.max()), rel=1e-6)
    assert 1 < float(ratio[0]) < 2, "the background's error lacks what is in the object's pixels"
    assert float(whole[~rests].min()) > 1e6, "whose pixels there are none keeps all"
    assert float(own[~rests].max()) < 1e4
    cover = np.ones(numbers.shape, bool)
    hidden = Observations(of_object.frames, of_object.similarity, cover)
    assert not rank_by_need(gaussians, hidden, 0).any(), "where all is burnt in nobody sees them"


def test_they_go_in_rounds_and_a_stopped_training_ends_with_the_same_bits(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(default, "BUDGET_EVERY", 2)
    config = replace(settings(13, prune_change=0.0), checkpoint_every=5)
    counts = []
    start = a_few(config)
    trainer = Trainer(seen(start), None, config, tmp_path, start=start)
    trainer.callbacks.append(lambda state, _, __: counts.append(len(state.gaussians)))
    whole = trainer.run()
    assert counts == [24, 24, 19, 19, 15, 15, 13, 13]
    assert "Step 3: 5 Gaussians that hardly change an image are removed." in capsys.readouterr().err
    again = Trainer(seen(a_few(config)), None, config, tmp_path)
    assert all(torch.equal(again.run().params[name], value) for name, value in whole.params.items())


@pytest.mark.parametrize(("iterations", "after", "placed"), [(8, 3, 24), (60, 3, 24), (8, 8, 13)])
def test_a_budget_holds_however_short_the_training_is(iterations, after, placed):
    config = replace(settings(13, prune_change=0.0), iterations=iterations)
    config = replace(config, density=replace(config.density, prune_after=after))
    assert min(24, config.most_at_start) == placed
    start = a_few(config, placed)
    assert len(Trainer(seen(start), None, config, start=start).run()) == 13


def test_who_changes_little_goes_without_a_budget():
    config = settings(prune_change=0.03)
    start = a_few(config)
    start.params["logit_opacities"][::3] = -4.5  # those at rest
    trainer = Trainer(seen(a_few(config)), None, config, start=start)
    assert 10 <= len(trainer.run()) < 24
    none = settings(prune_change=0.0)
    assert len(Trainer(seen(a_few(none)), None, none, start=a_few(none)).run()) == 24


@pytest.mark.parametrize("others", [lambda c: final_config(c, 3)[0], static_config, lambda c: per_frame_config(c, 4)])
def test_what_goes_on_or_is_compared_with_removes_none(others):
    density = replace(PRESETS["default"].density, prune_change=0.01)
    config = replace(PRESETS["default"], gaussians=1000, density=density)
    found = others(config)
    assert (found.density.prune_change, found.gaussians) == (0, 0)


def test_a_budget_holds_for_what_is_compared_with_and_for_the_start():
    config = replace(PRESETS["default"], gaussians=1000)
    assert static_config(config).density.max_gaussians == 1000
    assert per_frame_config(config, 4).density.max_gaussians == 250
    assert config.most_at_start == START_FACTOR * 1000
    assert replace(config, density=replace(config.density, max_gaussians=1500)).most_at_start == 1500
    assert replace(config, gaussians=0).most_at_start == config.density.max_gaussians


def test_only_our_own_strategy_has_a_budget():
    config = replace(tiny("paper"), gaussians=9)
    with pytest.raises(InputError, match=r"--gaussians is of --train\.strategy default: of paper give --train\.density"):
        config.check()
