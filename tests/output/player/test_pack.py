"""What the player's file holds, read back by a second reader and drawn by our own rasterizer."""

from __future__ import annotations

import zlib
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from flowsplat.gaussians.render import render
from flowsplat.output.player.chebyshev import find_seen_in_clip, fit_motion, visible_interval
from flowsplat.output.player.pack import MIN_PSNR, Packed, estimate_bytes, pack
from flowsplat.output.player.quantization import QuantizedArray, quantize, quantize_in_chunks, round_steps
from flowsplat.output.player.sensitivity import measure_sensitivity
from tests.output.player.unpacking import chebyshev, show, unpack
from tests.output.small import (
    HEIGHT,
    LINEAR,
    OTHERS,
    OURS,
    PAPER,
    WIDTH,
    five_pairs,
    psnr,
    rendered,
    small_cameras,
    small_gaussians,
    small_model,
    small_times,
)

FLAT_LIGHT = replace(OURS, slopes=False)


def packed(model) -> Packed:
    return pack(model, small_times(), small_cameras(model), "small")


def read_back(array: QuantizedArray) -> np.ndarray:
    header, data = array.encode()
    return unpack({"arrays": [header]}, zlib.compress(data))[array.name]


@pytest.mark.parametrize(("step", "bits"), [(0.5, 8), (1e-3, 16), (1e-5, 24)])
def test_quantized_arrays_round_trip_within_half_a_step(step, bits):
    values = np.random.default_rng(0).normal(size=(1000, 3))
    array = quantize("x", values, step)
    assert array.encode()[0]["bits"] == bits
    np.testing.assert_array_equal(read_back(array), array.values)
    assert np.all(np.abs(array.values - values) <= 0.51 * array.step)


def test_neighbors_that_are_alike_are_stored_as_differences():
    values = np.random.default_rng(0).normal(size=(1000, 3)).cumsum(0)
    array = quantize_in_chunks("x", values, np.full((4, 3), 0.01), 256)
    assert array.encode()[0]["delta"]
    np.testing.assert_array_equal(read_back(array), array.values)
    assert np.all(np.abs(array.values - values) <= 0.0051)


def test_each_chunk_has_its_steps_and_where_they_are_too_fine_coarser_ones():
    values = np.concatenate([np.linspace(0, 1e-3, 256), np.linspace(0, 1000, 44)])[:, None]
    array = quantize_in_chunks("x", values, np.array([[1e-9], [1e-9]]), 256)
    np.testing.assert_array_equal(read_back(array), array.values)
    assert np.abs(array.values - values)[:256].max() < 1e-8
    assert np.abs(array.values - values).max() < 1000 / 2**20
    coarse = quantize_in_chunks("x", values, np.array([[1e-9], [0.5]]), 256)
    assert np.abs(coarse.values - values).max() <= 0.26
    assert len(zlib.compress(coarse.encode()[1])) < len(zlib.compress(array.encode()[1]))


def test_quantized_arrays_may_be_empty():
    for empty in (np.zeros((0, 3)), np.zeros((5, 0))):
        assert read_back(quantize("x", empty, 1.0)).shape == empty.shape
        assert read_back(quantize_in_chunks("x", empty, np.zeros((len(empty) and 3, empty.shape[1])), 2)).shape == empty.shape


def test_rounded_steps_are_few_and_about_as_large():
    steps = np.geomspace(1e-6, 1e3, 500)
    assert len(np.unique(round_steps(steps))) < 70
    assert np.abs(np.log2(round_steps(steps) / steps)).max() <= 0.25 + 1e-9


def test_what_matters_in_the_images_is_what_they_change_by():
    """The sums of squared derivatives, beside the images that a small change makes."""
    model = small_model(FLAT_LIGHT, resting=60, moving=40)
    views = [(model.similarity.camera(camera), model.clip_time(t)) for camera, t in five_pairs(model)[:3]]
    found = measure_sensitivity(model.gaussians, views)
    assert found.numbers == 3 * 3 * WIDTH * HEIGHT
    rest = model.gaussians.at_rest
    generator = torch.Generator().manual_seed(1)

    def changed(name: str, stored: str, size: float) -> tuple[float, float]:
        """Sum of squared differences of the images when all of a parameter change, and what the sums say."""
        gaussians = model.gaussians.select(torch.arange(100))
        signs = 2.0 * torch.randint(0, 2, gaussians.params[stored].shape, generator=generator) - 1
        gaussians.params[stored] += size * signs * rest.reshape(-1, *[1] * (signs.dim() - 1))
        pairs = [(render(gaussians, *view).color, render(model.gaussians, *view).color) for view in views]
        return sum(float(((a - b) ** 2).sum()) for a, b in pairs), size**2 * float(found.sums[name][rest].sum())

    for name, stored, size in (("means", "means", 1e-4), ("logScales", "log_scales", 1e-3), ("gains", "log_gains", 1e-3)):
        true, said = changed(name, stored, size)
        assert 0.6 < said / true < 1.7, name


@pytest.mark.parametrize("config", [OURS, PAPER, LINEAR], ids=["ours", "paper", "linear"])
def test_series_follow_the_motion_model(config):
    gaussians = small_gaussians(config, resting=0, moving=200)
    rows, params = torch.arange(200), gaussians.params
    precision = gaussians.motion.log_precision(params)
    motion = fit_motion(gaussians, rows, params["times"], precision, 1e-4, 1e-3)
    middle, half = visible_interval(params["times"], precision, config.p_min)
    for share in (-1.0, -0.3, 0.6, 1.0):
        state = gaussians.motion.state({**params, "times": params["times"] - (middle + share * half)}, 0.0)
        found = motion.means[:, 0].numpy() + chebyshev(motion.means[:, 1:].numpy(), np.full(200, share))
        assert np.quantile(np.abs(found - state.means.numpy()).max(1), 0.98) < 4e-4
        if state.quats is not None:
            quats = motion.quats[:, 0].numpy() + chebyshev(motion.quats[:, 1:].numpy(), np.full(200, share))
            cosines = (quats * state.quats.numpy()).sum(1) / np.linalg.norm(state.quats, axis=1) / np.linalg.norm(quats, axis=1)
            assert np.quantile(np.abs(cosines), 0.05) > 0.9999


def test_series_follow_more_than_one_turn():
    gaussians = small_gaussians(PAPER, resting=0, moving=3)
    params, rows = gaussians.params, torch.arange(3)
    params["quats"] = torch.tensor([[0.1, 0.2, 0, 0]]).repeat(3, 1)
    for name in ("quat_poly", "quat_cos", "quat_sin"):
        params[name].zero_()
    params["quat_cos"][:, 0, 0] = 1
    params["quat_sin"][:, 0, 1] = 1
    precision = torch.full((3,), 3.5)
    motion = fit_motion(gaussians, rows, params["times"], precision, 1e-4, 1e-3)
    middle, half = visible_interval(params["times"], precision, PAPER.p_min)
    assert (2 * np.pi * half > np.pi / 2).all(), "more than half a turn to either side"
    for share in np.linspace(-1, 1, 9):
        state = gaussians.motion.state({**params, "times": params["times"] - (middle + float(share) * half)}, 0.0)
        quats = motion.quats[:, 0].numpy() + chebyshev(motion.quats[:, 1:].numpy(), np.full(3, share))
        cosines = (quats * state.quats.numpy()).sum(1) / np.linalg.norm(state.quats, axis=1) / np.linalg.norm(quats, axis=1)
        assert np.abs(cosines).min() > 0.99


@pytest.mark.parametrize("width", [WIDTH, 40 * WIDTH])
def test_what_crosses_the_scene_is_where_it_belongs(width):
    """However small the pixels are, and with them the steps of what is stored."""
    model = small_model(resting=0, moving=40)
    params = model.gaussians.params
    params["mean_poly"][:, 0, 0] = torch.linspace(-3, 3, 40)
    params["log_lambdas"][:] = 0.0
    pack_ = pack(model, small_times(), small_cameras(model, width, HEIGHT * width // WIDTH), "small")
    arrays = unpack(pack_.about, pack_.data)
    middle, half = visible_interval(
        torch.from_numpy(arrays["times"][:, 0]), torch.from_numpy(arrays["logLambdas"][:, 0]), model.gaussians.config.p_min
    )
    for share in (-0.9, 0.7):
        found = arrays["means"] + chebyshev(arrays["meanCoefficients"].reshape(40, -1, 3), np.full(40, share))
        gaps = []
        for k in range(40):  # the page has an order of its own
            t = float(middle[k] + share * half[k])
            true = model.gaussians.motion.state({**params, "times": params["times"] - t}, 0.0).means.numpy()
            gaps.append(np.linalg.norm(true - found[k], axis=1).min())
        assert max(gaps) < 0.2 * 0.045, "a fifth of the standard deviation that they have in the middle"


@pytest.mark.parametrize(
    ("config", "counts"),
    [
        (OURS, {}), (PAPER, {}), (LINEAR, {}), (OURS, {"moving": 0}), (OURS, {"resting": 0}), (OURS, {"moving": 1}),
        *((config, {}) for config in OTHERS.values()),
    ],
    ids=["ours", "paper", "linear", "nothing moves", "all move", "one moves", *OTHERS],
)  # fmt: skip
def test_what_is_read_back_looks_the_same(config, counts):
    model = small_model(config, **counts)
    pack_ = packed(model)
    arrays = unpack(pack_.about, pack_.data)
    for camera, seconds in five_pairs(model):
        assert psnr(show(pack_.about, arrays, camera, seconds), rendered(model, camera, seconds)) > 38


def test_images_are_as_near_as_the_page_promises():
    """Along the clip. Which of two is in front of the other changes all at once, so that a first guess is not enough here."""
    model = small_model(OURS)
    pack_ = packed(model)
    arrays = unpack(pack_.about, pack_.data)
    cameras, times = small_cameras(model), small_times()
    views = [(cameras[k], times[k]) for k in (0, 4, 8)]
    shown, truth = ([draw(*view) for view in views] for draw in (partial(show, pack_.about, arrays), partial(rendered, model)))
    assert psnr(np.stack(shown), np.stack(truth)) >= MIN_PSNR


def test_every_gaussian_keeps_the_number_of_its_object():
    """Whatever the number; a scene without objects has no array for them."""
    model = small_model(OURS)
    model.gaussians.object_ids[:10] = 255
    pack_ = packed(model)
    arrays = unpack(pack_.about, pack_.data)
    counts = [[n, int((model.gaussians.object_ids == n).sum())] for n in (1, 2, 255)]
    assert pack_.about["objects"] == counts
    assert [[n, int((arrays["object_ids"] == n).sum())] for n in (1, 2, 255)] == counts
    # The page has an order of its own: those at rest are told by where they are.
    rest = model.gaussians.select(torch.nonzero(model.gaussians.at_rest).squeeze(1))
    means = torch.from_numpy(arrays["means"][: len(rest)])
    nearest = torch.cdist(means, rest.params["means"], compute_mode="donot_use_mm_for_euclid_dist").argmin(1)
    np.testing.assert_array_equal(arrays["object_ids"][: len(rest), 0], rest.object_ids[nearest])
    model.gaussians.object_ids[:] = 0
    plain = packed(model)
    assert plain.about["objects"] == []
    assert "object_ids" not in {array["name"] for array in plain.about["arrays"]}


def test_gaussians_that_are_never_seen_are_left_out():
    model = small_model(resting=3, moving=4)
    model.gaussians.params["times"][4:6] = torch.tensor([-30.0, 30.0])
    assert find_seen_in_clip(model.gaussians).tolist() == [True] * 4 + [False, False, True]
    assert packed(model).about["moving"] == 2


def test_what_matters_less_is_rounded_more_coarsely():
    """Behind the others nobody sees it."""
    model = small_model(resting=2000, moving=0)
    params = model.gaussians.params
    params["means"][1000:, 2] += 3
    params["logit_opacities"][:1000] = 6
    params["log_scales"][:1000] += 1
    found = measure_sensitivity(model.gaussians, [(model.similarity.camera(c), model.clip_time(t)) for c, t in five_pairs(model)])
    assert float(found.sums["colors"][1000:].mean()) < 0.1 * float(found.sums["colors"][:1000].mean())
    pack_ = packed(model)
    means, colors = (unpack(pack_.about, pack_.data)[name] for name in ("means", "colors"))
    kinds = [len(np.unique(colors[rows, 0])) for rows in (means[:, 2] < 2, means[:, 2] > 2)]
    assert kinds[1] < 0.7 * kinds[0]


def test_the_estimate_is_near_the_size():
    model = small_model(resting=20_000, moving=20_000)
    assert 0.6 < estimate_bytes(model.gaussians) / (len(packed(model).data) * 8 / 7) < 1.6
