"""The motion models of other papers go the whole way: start, training, density control, checkpoints, files, export, page."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from flowsplat.common.errors import InputError
from flowsplat.gaussians.model import SceneModel
from flowsplat.gaussians.model_config import ModelConfig
from flowsplat.geometry import Similarity
from flowsplat.output.export.parameters import estimate_parameters_bytes, parameter_tensors
from flowsplat.training.checkpoint import load_checkpoint, load_model, read_tensors, save_model, write_tensors
from flowsplat.training.trainer import Trainer
from tests.training.handful import a_few, seen, tiny

KINDS = ("splines", "marbles", "bases", "hexplane", "deformation")
SHARING = ("bases", "hexplane", "deformation")


def settings(kind, **changes):
    config = tiny("default")
    config = replace(
        config, model=ModelConfig(kind=kind, knots=6, bases=3, sh_degree=1, freeze_background=True), iterations=30,
        checkpoint_every=20, init=replace(config.init, background_spacing=1.0, foreground_spacing=1.0, samples=3),
        density=replace(config.density, every=8, start=8, gradient=3e-3, clone_below=0.02),
    )  # fmt: skip
    return replace(config, **changes)


@pytest.fixture(scope="module")
def observations():
    """Of Gaussians with a series motion, so that there is something to learn; everything may move."""
    found = seen(a_few(tiny("default")))
    return replace(found, frames=[replace(frame, object_ids=np.ones_like(frame.object_ids)) for frame in found.frames])


@pytest.mark.parametrize("kind", KINDS)
def test_each_learns_under_density_control_and_goes_on_from_a_checkpoint_to_the_same_bits(kind, observations, tmp_path):
    config = settings(kind)
    trainer = Trainer(observations, None, config, tmp_path)
    whole = trainer.run()
    assert trainer.history[-1]["color"] < 0.95 * trainer.history[0]["color"]
    assert trainer.history[-1]["gaussians"] != trainer.history[0]["gaussians"]
    assert all(value.isfinite().all() for value in whole.values.values())
    kept, step, _ = load_checkpoint(tmp_path, Similarity(), 0.0, 1.0, 20.0)
    assert (step, kept.gaussians.config.kind) == (20, kind)
    for name, parameter in getattr(whole.motion, "shared_parameters", {}).items():
        assert torch.equal(whole.shared[name], kept.gaussians.shared[name]) == (parameter.rate == 0), name
    again = Trainer(observations, None, config, tmp_path).run()
    for name, value in whole.values.items():
        assert torch.equal(again.values[name], value), name

    model = SceneModel(whole, Similarity(), 0.0, 1.0)
    save_model(tmp_path / "model", model)
    loaded, camera = load_model(tmp_path / "model"), observations[1].camera
    assert loaded.gaussians.shared.keys() == whole.shared.keys()
    ours, theirs = (each.render(camera, 0.4, (camera, 0.6)) for each in (model, loaded))
    np.testing.assert_array_equal(ours.color, theirs.color)
    np.testing.assert_array_equal(ours.flow, theirs.flow)
    assert float(np.abs(ours.flow).max()) > 0


@pytest.mark.parametrize("kind", SHARING)
def test_a_step_of_several_frames_goes_along_their_mean(kind, observations):
    """Of two frames that are the same one, as far as that alone."""
    config = settings(kind, iterations=1, checkpoint_every=0, density=replace(tiny("default").density, every=0))
    found = []
    for frames in (1, 2):
        same = replace(observations, frames=[replace(observations[0], forward=None)] * frames)
        chosen = replace(config, frames_per_iteration=frames, loss=replace(config.loss, rigid=0.0))
        start = a_few_of(kind)
        found.append(Trainer(same, None, chosen, start=start).run().shared)
    for name in found[0]:
        torch.testing.assert_close(found[0][name], found[1][name], atol=1e-4, rtol=1e-3, msg=name)


def a_few_of(kind):
    """With values that move them."""
    gaussians = a_few(settings(kind))
    g = torch.Generator().manual_seed(3)
    for name, parameter in gaussians.motion.shared_parameters.items():
        if parameter.rate > 0:
            gaussians.shared[name] += 0.05 * torch.randn(parameter.shape, generator=g)
    return gaussians


def test_rates_of_what_gaussians_share_fall_as_those_of_motion(observations):
    config = settings("bases", iterations=1)
    trainer = Trainer(observations, None, config)
    trainer.begin()
    declared = trainer.gaussians.motion.shared_parameters["basis_quats"]
    first, last = (trainer.rates.of_shared(step, trainer.gaussians)["basis_quats"] for step in (0, 1))
    assert len(first) == 3 * 6 * 4
    assert float(first[0]) == pytest.approx(declared.rate)
    assert float(last[0]) == pytest.approx(declared.rate * config.rates.motion_decay)


def test_the_network_sees_more_frequencies_as_training_goes_on(observations):
    trainer = Trainer(observations, None, settings("deformation", iterations=4))
    counts = []
    trainer.callbacks.append(lambda state, *_: counts.append(float(state.gaussians.shared["octaves"])))
    trainer.run()
    assert counts == [2.0, 6.0, 10.0, 10.0]


def test_a_network_that_goes_on_keeps_its_frequencies(observations):
    """Where a scene is fitted to formats with one color, say, which begins early in the fall of the rates."""
    start = a_few_of("deformation")
    start.shared["octaves"].fill_(10.0)
    found = Trainer(observations, None, settings("deformation", iterations=6), start=start, first_step=2).run()
    assert float(found.shared["octaves"]) == 10.0


@pytest.mark.parametrize(
    "spoil",
    [
        lambda tensors: tensors.pop("shared.basis_quats"),
        lambda tensors: tensors.update({"shared.more": torch.zeros(2)}),
        lambda tensors: tensors.update({"shared.basis_quats": tensors["shared.basis_quats"][:2].clone()}),
        lambda tensors: tensors["shared.basis_quats"].fill_(torch.nan),
        lambda tensors: tensors.update({"shared_adam.mean.basis_quats": torch.zeros(1, 2)}),
        lambda tensors: tensors.pop("shared_adam.square.basis_translations"),
        lambda tensors: tensors.update({"shared_adam.counts": torch.zeros(3, dtype=torch.int32)}),
    ],
)
def test_a_checkpoint_with_other_shared_parameters_is_refused(spoil, observations, tmp_path):
    config = settings("bases", iterations=3, checkpoint_every=2)
    Trainer(observations, None, config, tmp_path).run()
    (path,) = tmp_path.glob("*.safetensors")
    tensors, values = read_tensors(path)
    spoil(tensors)
    write_tensors(path, tensors, values)
    with pytest.raises(InputError, match=r"damaged|incomplete"):
        Trainer(observations, None, config, tmp_path).run()


@pytest.mark.parametrize("value", [torch.zeros(2), torch.full((3, 6, 4), torch.inf)])
def test_a_model_with_other_shared_parameters_is_refused(value, tmp_path):
    save_model(tmp_path, SceneModel(a_few_of("bases"), Similarity(), 0.0, 1.0))
    path = tmp_path / "gaussians.safetensors"
    tensors, values = read_tensors(path)
    write_tensors(path, {**tensors, "shared.basis_quats": value}, values)
    with pytest.raises(InputError, match=r"damaged|does not hold a trained model"):
        load_model(tmp_path)


def test_files_of_all_parameters_have_the_shared_ones(tmp_path):
    model = SceneModel(a_few_of("hexplane"), Similarity(), 0.0, 1.0)
    tensors = parameter_tensors(model)
    assert tensors["time_planes_0"].shape[0] == 3
    assert estimate_parameters_bytes(model, None, None) > 4 * tensors["time_planes_0"].numel()
