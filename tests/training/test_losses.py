"""Loss terms: what registers itself has a weight, a curve and a gradient."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from flowsplat.common.errors import InputError
from flowsplat.common.settings import to_plain
from flowsplat.training import losses
from flowsplat.training.losses import LOSSES, add_weights, register_loss
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
    monkeypatch.setattr(losses, "_taken", set())
    register_loss("smooth", "Smooth", "Is smooth.", weight=0.25)(lambda step: torch.zeros(()))

    @dataclass
    @add_weights
    class Settings:
        flow: float = 1.0

    assert Settings().smooth == 0.25
    assert Settings(smooth=0.5) == Settings(1.0, 0.5)
    # Where it is the default it is not written: who has not the term can read all the rest.
    assert to_plain(Settings()) == {"flow": 1.0}
    assert to_plain(Settings(smooth=0.0)) == {"flow": 1.0, "smooth": 0.0}


@pytest.mark.parametrize("name", ["flow", "terms", "rigid_beta", "step", "psnr", "lambda", "depth-order", "Upper", "scale"])
def test_names_that_mean_something_else_are_refused(name):
    with pytest.raises(ValueError, match=name):
        register_loss(name, "", "", weight=0.1)(lambda step: torch.zeros(()))


def test_a_negative_weight_is_refused():
    with pytest.raises(ValueError, match=r"is -1\.0: give 0 or more"):
        register_loss("smooth", "", "", weight=-1.0)


@pytest.mark.parametrize("returned", [torch.zeros(2), 0.5, np.float32(1)])
def test_what_is_no_number_of_torch_is_named(monkeypatch, returned):
    term = replace(LOSSES["opacity"], compute=lambda step: returned)
    monkeypatch.setitem(LOSSES._found, "opacity", replace(LOSSES.entry("opacity"), value=term))
    with pytest.raises(TypeError, match="the loss term 'opacity' returned"):
        trained(tiny("default"), opacity=0.1)


def test_a_loss_that_is_no_number_ends_the_training_and_names_the_term(monkeypatch):
    term = replace(LOSSES["opacity"], compute=lambda step: step.rendered.alpha.mean() * float("nan"))
    monkeypatch.setitem(LOSSES._found, "opacity", replace(LOSSES.entry("opacity"), value=term))
    with pytest.raises(InputError, match=r"The loss is no number at step 2 .*opacity"):
        trained(tiny("default"), opacity=0.1)
