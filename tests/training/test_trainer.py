"""The training loop: who is stepped how far."""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from flowsplat.common.bounds import numbers
from flowsplat.common.errors import InputError
from flowsplat.gaussians.model import SceneModel
from flowsplat.geometry import Similarity
from flowsplat.training import state
from flowsplat.training.checkpoint import load_checkpoint, load_model, read_tensors, save_model, write_tensors
from flowsplat.training.config import PRESETS, TrainConfig
from flowsplat.training.frame_order import spread_order
from flowsplat.training.strategies import STRATEGIES
from flowsplat.training.strategies.default import DefaultStrategy
from flowsplat.training.trainer import Trainer
from flowsplat.training.weight_averaging import AVERAGE_STRIDE, TailAverage
from flowsplat_benchmarks.ablations.variants import change_settings
from tests.output.small import small_model
from tests.training.handful import HEIGHT, WIDTH, a_few, seen, tiny


def test_the_first_step_is_as_long_as_the_learning_rate_says():
    """Adam's first step has the length of its rate, whatever the gradient."""
    config = tiny("default")
    rates = replace(config.rates, along_ray=1.0, moving=3.0, gains=0.01, gains_falloff=0.5)
    config = replace(config, iterations=1, rates=rates)
    start = a_few(config)
    trained = Trainer(seen(start), None, config, start=start.select(torch.arange(len(start)))).run()
    steps = {name: (value - start.params[name]).abs() for name, value in trained.params.items()}
    drawn = steps["log_scales"].amax(1) > 0
    still, moving = drawn & ~start.dynamic, drawn & start.dynamic
    assert int(still.sum()) > 2
    assert int(moving.sum()) > 2
    for name, rate in (("log_scales", config.rates.scales), ("means", config.rates.means)):
        torch.testing.assert_close(steps[name][still].amax(), torch.tensor(rate), rtol=1e-3, atol=1e-7)
        torch.testing.assert_close(steps[name][moving].amax(), torch.tensor(3 * rate), rtol=1e-3, atol=1e-7)
    torch.testing.assert_close(steps["log_lambdas"].amax(), torch.tensor(3 * config.rates.log_lambdas), rtol=1e-3, atol=1e-7)
    # Every second wave is at its height in each of the three frames, the others are 0 in the middle one.
    waves = steps["log_gains"].amax(0)[1::2]
    torch.testing.assert_close(waves, 0.01 / torch.arange(2.0, 2 * len(waves) + 1, 2).sqrt(), rtol=1e-3, atol=1e-7)


@pytest.mark.parametrize(("rate", "pixels", "share"), [(2e-3, 0.0, 1.0), (2e-3, 1e-3, 0.5), (2e-3, 1.0, 1.0), (0.0, 1e-3, 1.0)])
def test_positions_move_no_more_pixels_a_step_than_allowed(rate, pixels, share):
    config = tiny("default")
    start = a_few(config)
    observations = seen(start)
    focal = float(observations[0].camera.K[0, 0])
    config = replace(config, iterations=1, rates=replace(config.rates, means=rate / focal, means_pixels=pixels))
    trained = Trainer(observations, None, config, start=start.select(torch.arange(len(start)))).run()
    steps = {name: (value - start.params[name]).abs().amax() for name, value in trained.params.items()}
    rates = config.rates
    for name, rate in (("means", share * rates.means), ("mean_poly", share * rates.motion), ("quats", rates.quats)):
        torch.testing.assert_close(steps[name], torch.tensor(rates.moving * rate), rtol=1e-2, atol=1e-7)


def test_at_the_end_objects_still_learn_what_looks_good():
    config = tiny("default")
    config = replace(config, iterations=10, rates=replace(config.rates, moving=3.0, decay=0.1, moving_decay=0.5))
    trainer = Trainer(seen(a_few(config)), None, config, start=a_few(config))
    trainer.run()
    still, moving = (trainer.rates.at(10, trainer.gaussians, moving=each) for each in (False, True))
    torch.testing.assert_close(still["log_scales"], torch.full((3,), 0.1 * config.rates.scales))
    torch.testing.assert_close(moving["log_scales"], torch.full((3,), 3 * 0.5 * config.rates.scales))
    torch.testing.assert_close(moving["means"], 3 * still["means"])


def test_the_result_is_the_mean_over_the_last_steps():
    config = replace(tiny("default"), iterations=5 * AVERAGE_STRIDE, average=0.5)
    start = a_few(config)
    mean = Trainer(seen(start), None, config, start=start.select(torch.arange(len(start)))).run()
    by_hand = []

    def look(state, step, figures):
        if state.step in (3 * AVERAGE_STRIDE, 4 * AVERAGE_STRIDE, 5 * AVERAGE_STRIDE):
            by_hand.append({name: value.clone() for name, value in state.gaussians.params.items()})

    watched = Trainer(seen(start), None, replace(config, average=0.0), start=start.select(torch.arange(len(start))))
    watched.callbacks.append(look)
    watched.run()
    for name, value in mean.params.items():
        torch.testing.assert_close(value, torch.stack([params[name] for params in by_hand]).mean(0))
    assert not torch.equal(mean.params["means"], by_hand[-1]["means"])


def test_a_mean_that_was_begun_goes_on_to_the_same_bits(tmp_path):
    config = replace(tiny("default"), iterations=4 * AVERAGE_STRIDE, average=0.6, checkpoint_every=3 * AVERAGE_STRIDE)
    start = a_few(config)
    whole = Trainer(seen(start), None, config, tmp_path, start=start.select(torch.arange(len(start)))).run()
    resumed = Trainer(seen(start), None, config, tmp_path)
    again = resumed.run()
    assert resumed.state.step == 4 * AVERAGE_STRIDE
    for name, value in whole.params.items():
        assert torch.equal(value, again.params[name]), name


def test_a_mean_follows_who_is_pruned_and_begins_anew_with_who_is_born():
    average, params = TailAverage(), {"means": torch.arange(4.0)}
    average.add(params)
    average.reindex(torch.tensor([0, 2, 3]), torch.zeros(3, dtype=torch.bool))
    average.add({"means": torch.tensor([2.0, 4.0, 3.0])})
    mean = {"means": torch.zeros(3)}
    average.write(mean)
    assert mean["means"].tolist() == [1, 3, 3]
    average.reindex(torch.tensor([0, 1, 1]), torch.tensor([False, False, True]))
    assert average.count == 0
    average.write(mean)
    assert mean["means"].tolist() == [1, 3, 3]


def test_objects_keep_their_numbers_and_change_no_training(tmp_path):
    """Through density control, checkpoints and files; a file without them is refused."""
    config = replace(tiny("paper"), iterations=4, checkpoint_every=2, average=0.0)
    config = replace(config, density=replace(config.density, every=1, start=1, gradient=1e-9, max_gaussians=60))
    start = a_few(config)
    start.object_ids = (torch.arange(len(start)) % 4).to(torch.uint8)
    # Whoever descends from a Gaussian has its color nearly still: four steps change it less than they differ.
    kinds = torch.linspace(-3, 3, 4)
    start.params["sh"][:, 0, 0] = kinds[start.object_ids.long()]
    unnumbered = start.select(torch.arange(len(start)))
    unnumbered.object_ids = torch.zeros(len(start), dtype=torch.uint8)
    observations = seen(start)
    trained = Trainer(observations, None, config, tmp_path / "steps", start=start).run()
    assert len(trained) > len(start) + 8
    nearest = (trained.params["sh"][:, 0, 0, None] - kinds).abs().argmin(1)
    assert torch.equal(trained.object_ids.long(), nearest)
    other = Trainer(observations, None, config, start=unnumbered).run()
    assert not other.object_ids.any()
    for name, value in trained.params.items():
        assert torch.equal(value, other.params[name]), name
    again = Trainer(observations, None, config, tmp_path / "steps").run()
    assert torch.equal(again.object_ids, trained.object_ids)

    kept, step, _ = load_checkpoint(tmp_path / "steps", Similarity(), 0.0, 1.0, 20.0)
    assert step == 2
    assert set(kept.gaussians.object_counts) == {1, 2, 3}
    save_model(tmp_path, SceneModel(trained, Similarity(), 0.0, 1.0))
    assert torch.equal(load_model(tmp_path).gaussians.object_ids, trained.object_ids)
    for path in (tmp_path / "gaussians.safetensors", *(tmp_path / "steps").glob("*.safetensors")):
        tensors, values = read_tensors(path)
        write_tensors(path, {name: value for name, value in tensors.items() if name != "object_ids"}, values)
    for read in (
        lambda: load_model(tmp_path),
        lambda: load_checkpoint(tmp_path / "steps", Similarity(), 0.0, 1.0, 20.0),
        lambda: Trainer(observations, None, config, tmp_path / "steps").run(),
    ):
        with pytest.raises(InputError, match="object_ids"):
            read()


@pytest.mark.parametrize("focal", [1e-300, 5e-324, -3.0, 1e11])
def test_a_model_whose_focal_length_is_none_is_refused(tmp_path, focal):
    save_model(tmp_path, SceneModel(a_few(tiny("default")), Similarity(), 0.0, 1.0, focal=300.0))
    assert load_model(tmp_path).focal == 300
    value = json.loads((tmp_path / "model.json").read_text())
    (tmp_path / "model.json").write_text(json.dumps({**value, "focal": focal}))
    with pytest.raises(InputError, match="does not hold a trained model: its focal length is"):
        load_model(tmp_path)


def test_after_the_last_step_no_gaussian_is_added_or_reset():
    config = tiny("paper")
    every = replace(config.density, every=1, start=2, gradient=1e-9, reset_every=2)
    start = a_few(config)
    trained = Trainer(seen(start), None, replace(config, density=every), start=start.select(torch.arange(len(start)))).run()
    assert len(trained) == len(start)
    assert float(trained.params["logit_opacities"].max()) > -4


def test_after_a_reset_the_next_gradient_alone_says_where_opacities_go(tmp_path):
    """Moments from before the reset would let them fall for many steps more, whatever the gradient."""
    config = tiny("paper")
    config = replace(
        config, iterations=12, frames_per_iteration=0, density=replace(config.density, reset_every=10), checkpoint_every=11
    )
    observations, found = seen(a_few(config)), []

    trainer = Trainer(observations, None, config, tmp_path, start=a_few(config))
    take_step = trainer._optimize

    def watched(state, gradients):
        before = state.gaussians.params["logit_opacities"].clone()
        take_step(state, gradients)
        step = (state.gaussians.params["logit_opacities"] - before)[gradients.active.rows]
        found.append((state.step, step[gradients.drawn], gradients.values["logit_opacities"][gradients.drawn]))

    trainer._optimize = watched
    whole = trainer.run()
    rate = float(trainer.rates.at(12, trainer.gaussians)["logit_opacities"])
    at, step, gradient = found[10]
    assert at == 10
    assert len(step) > 10
    # Adam's first step has the length of its rate and goes down the gradient.
    torch.testing.assert_close(step, -rate * gradient.sign(), rtol=1e-3, atol=1e-7)
    _, before, earlier = found[9]
    assert not torch.allclose(before, -rate * earlier.sign(), rtol=1e-3)  # which is no rule without a reset
    again = Trainer(observations, None, config, tmp_path)
    assert torch.equal(again.run().params["logit_opacities"], whole.params["logit_opacities"])


@pytest.mark.parametrize("alone", [0.01, 1.0])
def test_who_turns_out_to_move_gets_neighbors_at_once_unless_they_are_few(monkeypatch, alone):
    monkeypatch.setattr(state, "MAX_ALONE_SHARE", alone)
    config = tiny("default")
    config = replace(
        config, iterations=4, loss=replace(config.loss, rigid_refresh=1000),
        density=replace(config.density, every=2, start=2, revise_rest=0.0),
    )  # fmt: skip
    start, had, moved = a_few(config), [], []
    start.dynamic[:12] = False

    class Watched(DefaultStrategy):
        def step_post_backward(self, state, step):
            if not had or len(had) == state.step - 1:
                had.append((state.neighbors.indices >= 0).any(1))
            super().step_post_backward(state, step)

        def control(self, state, statistics):
            before = state.gaussians.dynamic.clone()
            statistics.flow_visits[:2], statistics.flow_residual[:2], statistics.color_residual[:2] = 2.0, 200.0, 2.0
            super().control(state, statistics)
            moved.append(torch.nonzero(state.gaussians.dynamic & ~before).squeeze(1).tolist())

    monkeypatch.setitem(STRATEGIES._found, "default", replace(STRATEGIES.entry("default"), value=Watched))
    Trainer(seen(a_few(config)), None, config, start=start).run()
    assert moved == [[0, 1]]
    assert not had[1][:2].any()
    assert had[2][:2].all() == (alone < 1)


@pytest.mark.parametrize("count", [1, 2, 7, 74])
def test_frames_of_steps_in_a_row_lie_far_apart(count):
    rng = np.random.default_rng(0)
    rounds = [spread_order(count, rng).tolist() for _ in range(2)]
    for each in rounds:
        assert sorted(each) == list(range(count))
        assert all(abs(a - b) > count // 4 for a, b in itertools.pairwise(each))
    if count == 74:
        assert rounds[0] != rounds[1]
        assert all(min(abs(a - b) for b in each[k + 1 : k + 5]) >= 8 for each in rounds for k, a in enumerate(each[:-4]))


def test_the_paper_draws_frames_at_random():
    assert PRESETS["default"].order == "spread"
    assert PRESETS["paper"].order == "random"


def test_without_checkpoints_none_is_written(tmp_path):
    config = replace(tiny("default"), checkpoint_every=0)
    Trainer(seen(a_few(config)), None, config, tmp_path, start=a_few(config)).run()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "value", "rule"),
    [
        ("seed", -1, "0 or more"), ("seed", 10**30, "at most 9.22337e"), ("iterations", -5, "0 or more"),
        ("average", 1.5, "at most 1"), ("rates.means", math.nan, "0 or more"),
        ("density.max_gaussians", 0, "1 or more"), ("init.opacity", 1.0, "between 0 and 1"), ("density.reset_to", 0.0, "between"),
        ("loss.rigid_neighbors", 0, "1 or more"), ("model.sh_degree", 4, "at most 3"), ("init.samples", 0, "1 or more"),
        ("init.detail", 5.0, "at most 4"), ("init.detail", -1.0, "0 or more"), ("init.sample_gap", -1, "0 or more"),
        ("init.flatness", 0.0, "more than 0"), ("init.size", 0.0, "more than 0"), ("init.precision_factor", 0.0, "more than 0"),
        ("loss.flow", 1e308, "at most 1000"), ("init.edge", 10**6, "at most 256"), ("loss.rigid_neighbors", 10**6, "at most 256"),
        ("model.mean_fourier", 10**8, "at most 64"), ("density.max_gaussians", 10**12, "at most 1e"),
        ("rates.moving", 0.0, "more than 0"), ("rates.time_factor", 0.0, "more than 0"),
        ("init.samples", 10**9, "at most"), ("rates.means", 1e30, "at most 1000"), ("iterations", 10**15, "at most 1e"),
    ],
)  # fmt: skip
def test_settings_that_make_no_sense_are_named(name, value, rule):
    with pytest.raises(InputError, match=f"--train.{name.replace('_', '-')} .*{rule}"):
        change_settings(PRESETS["default"], {name: value}).check()


@pytest.mark.slow
def test_the_largest_values_train_or_say_why_not():
    start = a_few(tiny("default"))
    for name, _, bounds in numbers(TrainConfig()):
        most = 1 if bounds.le is None else bounds.le
        if name in ("iterations", "frames_per_iteration", "loss.rigid_refresh") or name.startswith(("init.", "model.")):
            continue  # how long it takes, and what the start was made with
        config = change_settings(tiny("default"), {name: 0.999 if most == 1 else most})
        try:
            trained = Trainer(seen(start), None, config, start=start).run()
        except InputError:
            continue
        assert all(values.isfinite().all() for values in trained.params.values()), name


def test_all_presets_make_sense():
    for preset in PRESETS.values():
        preset.check()


def test_a_training_that_prunes_all_gaussians_says_so():
    config = tiny("paper")
    density = replace(config.density, every=1, start=1, prune_opacity=2.0)
    start = a_few(config)
    with pytest.raises(InputError, match="No Gaussian is left at step 1"):
        Trainer(seen(start), None, replace(config, density=density), start=start).run()


def edited(path, **changed):
    """Write a checkpoint anew with other tensors."""
    tensors, values = read_tensors(path)
    write_tensors(path, {**tensors, **changed}, values)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda t: {"neighbors.indices": torch.full_like(t["neighbors.indices"], 10**9)},
        lambda t: {"neighbors.indices": torch.full_like(t["neighbors.indices"], -2)},
        lambda t: {"neighbors.weights": t["neighbors.weights"][:, :1].clone()},
        lambda t: {"adam.counts": t["adam.counts"][:-1].clone()},
        lambda t: {"adam.counts": t["adam.counts"].double()},
        lambda t: {"adam.mean.means": t["adam.mean.means"][:, :2].clone()},
        lambda t: {"adam.square.means": torch.full_like(t["adam.square.means"], math.nan)},
        lambda t: {"adam.mean.other": torch.zeros(1)},
        lambda t: {"statistics.visits": t["statistics.visits"][:1].clone()},
    ],
)
def test_a_checkpoint_with_what_kernels_would_read_or_write_beside_is_refused(tmp_path, spoil):
    config = replace(tiny("default"), iterations=4, checkpoint_every=3)
    start = a_few(config)

    def trainer():
        return Trainer(seen(start), None, config, tmp_path, start=start.select(torch.arange(len(start))))

    trainer().run()
    (path,) = tmp_path.glob("*.safetensors")
    tensors, _ = read_tensors(path)
    if "neighbors.indices" not in tensors:  # nothing here moves: neighbors as they would be
        count = len(tensors["dynamic"])
        tensors |= {"neighbors.indices": torch.zeros(count, 2, dtype=torch.int32), "neighbors.weights": torch.zeros(count, 2)}
    edited(path, **{name: value for name, value in tensors.items() if name.startswith("neighbors.")})
    trainer().run()  # that is one to go on from
    edited(path, **spoil(tensors))
    with pytest.raises(InputError, match=f"{path.name} is damaged: {next(iter(spoil(tensors)))}"):
        trainer().run()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("queue", [0, 10**6]), ("queue", ["a"]), ("step", -1), ("rng", {"state": 1}), ("history", 3), ("recent", [{"loss": None}]),
        ("history", [{"step": 10.0, "psnr": None}]), ("history", [{"step": 10.0, "loss": 0.5}]), ("config", {"\ud800": 1}),
        ("rng", {"bit_generator": "\ud800"}),
    ],
)  # fmt: skip
def test_a_checkpoint_with_other_values_than_it_can_have_is_refused(tmp_path, name, value):
    config = replace(tiny("default"), iterations=4, checkpoint_every=3)
    start = a_few(config)
    Trainer(seen(start), None, config, tmp_path, start=start).run()
    (path,) = tmp_path.glob("*.safetensors")
    tensors, values = read_tensors(path)
    write_tensors(path, tensors, {**values, name: value})
    with pytest.raises(InputError, match=path.name):
        Trainer(seen(start), None, config, tmp_path, start=start).run()


def test_a_checkpoint_whose_history_lacks_a_figure_goes_on(tmp_path):
    config = replace(tiny("default"), iterations=4, checkpoint_every=3)
    start = a_few(config)
    Trainer(seen(start), None, config, tmp_path, start=start).run()
    (path,) = tmp_path.glob("*.safetensors")
    tensors, values = read_tensors(path)
    assert len(values["recent"]) == 3
    for entry in values["recent"]:
        del entry["depth"]
    write_tensors(path, tensors, values)
    again = Trainer(seen(start), None, config, tmp_path, start=start)
    again.run()
    assert math.isfinite(again.history[-1]["depth"])


def test_what_is_burnt_in_has_no_loss_and_no_gradient(tmp_path):
    """Where all is covered, color says nothing, and nobody learns from it."""
    config = tiny("default")
    config = replace(config, iterations=1, loss=replace(config.loss, flow=0, depth=0, rigid=0, coverage=0), average=0)
    observations, color, learned = seen(a_few(config)), {}, {}
    for name, covered in (("none", None), ("half", np.arange(WIDTH) < WIDTH // 2), ("all", np.ones(WIDTH, bool))):
        overlay = None if covered is None else np.tile(covered, (HEIGHT, 1))
        training = Trainer(replace(observations, overlay=overlay), None, config, tmp_path / name, start=a_few(config))
        after = training.run().params["sh"]
        color[name], learned[name] = training.history[-1]["color"], float((after - a_few(config).params["sh"]).abs().max())
    assert color["all"] < 1e-6 < color["half"] < color["none"]  # to rounding
    assert learned["all"] == 0 < learned["half"]


def test_brightness_that_would_be_infinite_is_refused(tmp_path):
    """Each number is one that may stand there, but not all of them together."""
    model = small_model()
    for name, gain in (("log_gains", 9.0), ("shadow_free", 9.0)):
        gaussians = model.gaussians
        spoiled = {**gaussians.params, "log_gains": gaussians.params["log_gains"].clone()}
        shadow_free = torch.zeros(len(gaussians), 1 + gaussians.config.gains)
        (spoiled["log_gains"] if name == "log_gains" else shadow_free)[3] = gain
        save_model(tmp_path, replace(model, gaussians=replace(gaussians, params=spoiled, shadow_free=shadow_free)))
        with pytest.raises(InputError, match="log_gains add up" if name == "log_gains" else "without shadows"):
            load_model(tmp_path)
