"""Loss terms: what registers itself has a weight, a curve and a gradient."""

from __future__ import annotations

from dataclasses import dataclass, replace

import pytest
import torch

from flowsplat.common.registry import Entry
from flowsplat.training import losses
from flowsplat.training.losses import LOSSES, LossTerm, add_weights
from flowsplat.training.trainer import Trainer
from tests.training.handful import a_few, seen, tiny


def trained(config, **weights):
    config = replace(config, loss=replace(config.loss, **weights))
    trainer = Trainer(seen(a_few(config)), None, config, start=a_few(config))
    trainer.run()
    return trainer


def test_what_has_no_weight_is_not_computed_and_has_no_curve():
    config = tiny("default")
    assert [name for name, _, _ in config.loss.terms()] == ["photometric", "rigid", "coverage"]
    assert [name for name, _, _ in replace(config.loss, rigid=0, scale=0.1).terms()] == ["photometric", "coverage", "scale"]
    history = trained(config, rigid=0, opacity=0.1).history
    assert set(history[-1]) == {
        "step", "color", "flow", "depth", "psnr", "coverage", "opacity", "loss", "active", "gaussians"
    }  # fmt: skip


def test_the_loss_is_the_sum_of_its_terms_by_their_weights():
    config = tiny("default", average=0.0)
    config = replace(config, iterations=1)
    plain, more = trained(config), trained(config, opacity=0.5, scale=2.0)
    for name in ("color", "rigid", "coverage"):
        assert more.history[0][name] == plain.history[0][name]
    added = 0.5 * more.history[0]["opacity"] + 2.0 * more.history[0]["scale"]
    assert more.history[0]["loss"] == pytest.approx(plain.history[0]["loss"] + added, rel=1e-5)


@pytest.mark.parametrize(("name", "parameter"), [("opacity", "logit_opacities"), ("scale", "log_scales")])
def test_small_is_what_is_made_small(name, parameter):
    config = replace(tiny("default", average=0.0), iterations=30)
    plain, pressed = trained(config), trained(config, **{name: 10.0})
    assert pressed.history[0][name] > 0
    assert float(pressed.gaussians.params[parameter].mean()) < float(plain.gaussians.params[parameter].mean()) - 0.1


def test_a_term_brings_the_field_of_its_weight(monkeypatch):
    monkeypatch.setattr(losses, "LOSSES", type(LOSSES)("loss term"))
    losses.LOSSES.add(Entry("smooth", "Smooth", "Is smooth.", LossTerm(lambda step: torch.zeros(()), 0.25)))

    @dataclass
    @add_weights
    class Settings:
        flow: float = 1.0

    assert Settings().smooth == 0.25
    assert Settings(smooth=0.5) == Settings(1.0, 0.5)
    losses.LOSSES.add(Entry("flow", "Flow", "Flows.", LossTerm(lambda step: torch.zeros(()), 1.0)))
    with pytest.raises(ValueError, match="the loss term 'flow' would take the place of the setting of that name"):

        @add_weights
        class Other:
            flow: float = 1.0
