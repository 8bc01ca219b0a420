"""A motion model that the package does not know goes the whole way: start, training, density control, checkpoints, page."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from flowsplat.common.errors import InputError
from flowsplat.gaussians.density import DensityStatistics, densify
from flowsplat.gaussians.initialize import initialize
from flowsplat.gaussians.model import SceneModel
from flowsplat.gaussians.model_config import ModelConfig
from flowsplat.geometry import Similarity
from flowsplat.output.export.still import still_at
from flowsplat.output.player.pack import pack
from flowsplat.training.checkpoint import load_checkpoint, load_model, save_model
from flowsplat.training.trainer import Trainer
from tests.gaussians import balls  # noqa: F401  Registers its model.
from tests.output.player.unpacking import unpack
from tests.training.handful import HEIGHT, WIDTH, a_few, seen, tiny


def settings(**changes):
    config = tiny("default", average=0.0)
    return replace(config, model=ModelConfig(kind="balls", sh_degree=1, freeze_background=True), **changes)


@pytest.fixture(scope="module")
def observations():
    """Of Gaussians with a series motion, so that there is something to learn; everything may move."""
    found = seen(a_few(tiny("default")))
    frames = [replace(frame, object_ids=np.ones_like(frame.object_ids)) for frame in found.frames]
    return replace(found, frames=frames)


def test_it_learns_under_density_control_and_goes_on_from_a_checkpoint_to_the_same_bits(observations, tmp_path):
    config = settings(iterations=30, checkpoint_every=20)
    config = replace(
        config, init=replace(config.init, background_spacing=1.0, foreground_spacing=1.0, samples=3),
        density=replace(config.density, every=8, start=8, gradient=3e-3, clone_below=0.02),
    )  # fmt: skip
    trainer = Trainer(observations, None, config, tmp_path)
    whole = trainer.run()
    assert set(whole.params) == {
        "means", "times", "logit_opacities", "sh", "log_gains", "drifts", "log_radii", "log_lives"
    }  # fmt: skip
    assert trainer.history[-1]["color"] < 0.8 * trainer.history[0]["color"]
    assert trainer.history[-1]["gaussians"] != trainer.history[0]["gaussians"]
    kept, step, _ = load_checkpoint(tmp_path, Similarity(), 0.0, 1.0, 20.0)
    assert step == 20
    assert kept.gaussians.config.kind == "balls"
    again = Trainer(observations, None, config, tmp_path).run()
    for name, value in whole.params.items():
        assert torch.equal(again.params[name], value), name
    save_model(tmp_path / "model", SceneModel(whole, Similarity(), 0.0, 1.0))
    loaded = load_model(tmp_path / "model")
    camera = observations[1].camera
    rendering = loaded.render(camera, 0.5, (camera, 0.6))
    assert float(rendering.alpha.max()) > 0.3
    assert float(np.abs(rendering.flow).max()) > 0


def test_every_parameter_learns_at_the_rate_of_its_group(observations):
    config = settings(iterations=1)
    trainer = Trainer(observations, None, config)
    trainer.run()
    rates = trainer.rates.at(0, trainer.gaussians)
    share = config.rates.means_pixels / 20 / config.rates.means
    assert float(rates["log_radii"]) == pytest.approx(config.rates.scales)
    assert float(rates["log_lives"]) == pytest.approx(config.rates.log_lambdas)
    assert float(rates["drifts"][0]) == pytest.approx(min(share, 1) * config.rates.motion)


def test_a_split_puts_children_where_the_parent_was(observations):
    config = settings()
    start = initialize(observations, None, config.model, config.init, 0, 10_000)
    statistics = DensityStatistics.zeros(len(start))
    statistics.visits[:], statistics.gradient[3] = 1, 1.0
    result = densify(start, statistics, 0.5, 0.0, 10_000, torch.Generator().manual_seed(0))
    children, parent = result.gaussians.select(torch.nonzero(result.is_new).squeeze(1)), start.select(torch.tensor([3]))
    assert len(children) == 2
    torch.testing.assert_close(children.params["log_radii"], (parent.params["log_radii"] - np.log(1.6)).expand(2))
    radius = float(torch.exp(parent.params["log_radii"]))
    line = parent.motion.state({n: v.expand(2, *v.shape[1:]) for n, v in parent.params.items()} | {"times": -(
        children.params["times"] - parent.params["times"])}, 0.0)  # fmt: skip
    offset = (children.params["means"] - line.means).norm(dim=1)
    assert ((offset > 0) & (offset < 5 * radius)).all()


def test_it_can_be_exported_and_packed_for_the_page(observations):
    config = settings()
    gaussians = initialize(observations, None, config.model, config.init, 0, 10_000)
    gaussians.params["drifts"][:] = torch.tensor([0.3, 0.0, 0.0])
    model = SceneModel(gaussians, Similarity(), 0.0, 1.0)
    still = still_at(model, 0.5)
    torch.testing.assert_close(
        still.log_scales, gaussians.params["log_radii"][gaussians.active(0.5).rows][:, None].expand(-1, 3), rtol=1e-3, atol=1e-3
    )
    cameras = [frame.camera for frame in observations.frames]
    packed = pack(model, [0.0, 0.5, 1.0], cameras, "balls")
    about = json.loads(json.dumps(packed.about))
    planes = unpack(about, packed.data)
    assert about["moving"] == int(gaussians.dynamic.sum())
    assert (about["width"], about["height"]) == (WIDTH, HEIGHT)
    moves = planes["meanCoefficients"].reshape(about["moving"], -1, 3)
    assert float(np.abs(moves[:, 0, 0]).min()) > 0
    assert float(np.abs(moves[:, 0, 1:]).max()) < 1e-2


def test_an_unknown_model_is_named():
    config = tiny("default")
    with pytest.raises(InputError, match=r"Unknown motion model 'circles': choose one of .*linear, .*series"):
        replace(config, model=replace(config.model, kind="circles")).check()
