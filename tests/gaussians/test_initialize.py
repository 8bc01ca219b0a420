"""The first Gaussians under a cap: fewer of them, evenly, and large enough to leave no holes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from flowsplat.gaussians import initialize as initialization
from flowsplat.gaussians.density import largest_scale
from flowsplat.gaussians.initialize import choose_frames, initialize
from flowsplat.gaussians.observations import load_observations
from flowsplat.gaussians.render import render
from flowsplat.gaussians.sampling import detail, grid, spacings
from flowsplat.priors.options import PriorsOptions
from flowsplat.priors.prepare import prepare_priors
from flowsplat.scenes import Scene
from flowsplat.scenes.synthetic import SyntheticScene, write_synthetic
from flowsplat.training.config import PRESETS

CONFIG = PRESETS["default"]


@pytest.fixture(scope="module")
def observations(tmp_path_factory):
    folder = tmp_path_factory.mktemp("init") / "scene"
    write_synthetic(folder, SyntheticScene(width=96, height=64, frames=6, fps=6.0), holdout=None)
    prepare_priors(Scene(folder), PriorsOptions(priors="true"))
    return load_observations(Scene(folder))


def start(observations, cap, **changes):
    return initialize(observations, None, CONFIG.model, replace(CONFIG.init, **changes), 0, cap)


def test_a_cap_that_does_not_bind_changes_nothing(observations):
    free = start(observations, 10**6)
    same = start(observations, len(free))
    assert len(same) == len(free)
    assert all((same.params[name] == value).all() for name, value in free.params.items())


@pytest.mark.parametrize("share", [0.7, 0.3, 0.1])
def test_a_cap_thins_background_and_objects_alike(observations, share):
    free = start(observations, 10**6)
    cap = int(share * len(free))
    capped = start(observations, cap)
    assert 0.8 * cap < len(capped) <= cap
    dynamic = free.dynamic.float().mean()
    assert capped.dynamic.float().mean() == pytest.approx(float(dynamic), rel=0.25)
    # The area of a Gaussian grows as their number falls.
    growth = (largest_scale(capped).median() / largest_scale(free).median()) ** 2
    assert float(growth) == pytest.approx(1 / share, rel=0.35)


def test_in_large_frames_gaussians_are_farther_apart(observations, monkeypatch):
    """Four times the side at which they begin to be, and a power of one half: twice as far apart, a quarter of them."""
    small = start(observations, 10**6, spacing_growth=0.5)
    monkeypatch.setattr(initialization, "SPACED_SIDE", max(observations.size) // 4)
    large, even = (start(observations, 10**6, spacing_growth=growth) for growth in (0.5, 0.0))
    assert len(even) == len(small), "up to that side nothing grows"
    for part in (False, True):
        count = int((even.dynamic == part).sum())
        assert int((large.dynamic == part).sum()) == pytest.approx(count / 4, rel=0.15)


def test_fewer_gaussians_leave_no_holes(observations):
    frame, free = observations[3], start(observations, 10**6)
    capped = start(observations, len(free) // 6)
    dropped = free.select(torch.randperm(len(free), generator=torch.Generator().manual_seed(0))[: len(capped)])
    covered = {name: render(each, frame.camera, frame.time).alpha.mean() for name, each in (("even", capped), ("random", dropped))}
    assert covered["even"] > 0.8
    assert covered["even"] > covered["random"] + 0.2


def test_a_cap_holds_for_a_random_start_and_for_tracks(observations):
    assert len(start(observations, 500, from_priors=False)) == 500
    assert len(start(observations, 500, foreground="tracks", background_spacing=1.0)) <= 500


@pytest.mark.parametrize("foreground", ["pixels", "tracks"])
def test_every_gaussian_knows_its_object(observations, foreground):
    """Seen from the frame that it was made from, it lies on the mask of its number."""
    made = start(observations, 10**6, foreground=foreground)
    assert not made.object_ids[~made.dynamic].any()
    seeds, found = made.select(torch.nonzero(made.dynamic).squeeze(1)), 0
    for frame in observations.frames:
        here = seeds.params["times"] == frame.time
        uv, _ = frame.camera.project(seeds.params["means"][here].double().numpy())
        x, y = uv.astype(np.int64).T
        np.testing.assert_array_equal(seeds.object_ids[here].numpy(), frame.object_ids[y, x])
        found += int(here.sum())
    assert found == len(seeds)
    assert set(made.object_counts) == set(np.unique(observations[0].object_ids)) - {0}
    assert len(made.object_counts) > 1
    assert start(observations, 500, from_priors=False).object_counts == {}, "a random start knows no masks"


@pytest.mark.parametrize("spacing", [1.0, 1.4142, 1.7, 2.0, 3.3, 7.5])
def test_grids_are_as_dense_as_they_say_and_even(spacing):
    for each in (spacing, np.full((150, 200), spacing)):
        pixels = grid(200, 150, each, np.random.default_rng(0))
        assert pixels.mean() == pytest.approx(1 / spacing**2, rel=0.03)
        side = int(np.ceil(4 * spacing))
        blocks = pixels[: 150 // side * side, : 200 // side * side].reshape(150 // side, side, 200 // side, side).sum((1, 3))
        expected = side**2 / spacing**2
        assert np.abs(blocks - expected).max() < 0.3 * expected + 1, "no clumps and no holes"


@pytest.mark.parametrize("spacing", [1.0, 1.4142, 2.0, 5.0])
def test_spacings_share_out_as_many_points_where_there_is_detail(spacing):
    rng = np.random.default_rng(0)
    image = np.full((120, 160, 3), 100, np.uint8)
    image[:, 80:] += rng.integers(0, 60, (120, 80, 3)).astype(np.uint8)
    region = np.ones((120, 160), bool)
    region[:30] = False
    apart = spacings(detail(image), region, spacing)
    assert (1 / apart[region] ** 2).mean() == pytest.approx(1 / spacing**2, rel=0.02)
    assert apart.min() >= 0.999
    assert apart.max() <= 2.001 * spacing
    if spacing > 1:
        assert apart[60:, :60].mean() > 1.3 * apart[60:, 100:].mean()
    assert (spacings(detail(image), np.zeros_like(region), spacing) == np.float32(spacing)).all()


def test_more_gaussians_where_there_is_detail(observations):
    """As many as when they are spread evenly, within what merging leaves; and the smaller ones where the detail is."""
    even, ours = start(observations, 10**6, detail=0.0), start(observations, 10**6)
    assert len(ours) == pytest.approx(len(even), rel=0.15)
    assert size_where_busy(observations[3], ours) < 0.9 * size_where_busy(observations[3], even)


def size_where_busy(frame, gaussians):
    """Of the background in the frame, in pixels: the quarter with most detail against the quarter with least."""
    finer, width, height = detail(frame.image), frame.camera.width, frame.camera.height
    uv, depth = frame.camera.project(gaussians.params["means"].numpy().astype(float))
    inside = ~gaussians.dynamic.numpy() & (depth > 0) & (uv >= 0).all(1) & (uv < (width, height)).all(1)
    x, y = uv[inside].astype(int).T
    size = torch.exp(gaussians.params["log_scales"][:, 1]).numpy()[inside] / depth[inside]
    least, most = np.quantile(finer, [0.25, 0.75])
    return np.median(size[finer[y, x] > most]) / np.median(size[finer[y, x] < least])


@pytest.mark.parametrize(("frames", "gap", "samples"), [(1, 4, 1), (10, 4, 10), (74, 4, 24), (270, 4, 69), (270, 0, 24)])
def test_a_long_clip_has_more_samples(frames, gap, samples):
    """Objects live for a spacing or so: what is seldom sampled would have to stay for long and fit nowhere."""
    sampled, log_lambda = choose_frames(frames, replace(CONFIG.init, sample_gap=gap))
    assert len(sampled) == samples
    assert (sampled[0], sampled[-1]) == (0, frames - 1)
    assert not gap or frames == 1 or np.diff(sampled).max() <= gap
    assert log_lambda == pytest.approx(np.log(CONFIG.init.precision_factor * (np.pi * max(samples - 1, 1)) ** 2))


@pytest.mark.parametrize("share", [0.0, 0.02])
def test_objects_whose_depth_is_a_guess_are_there_all_the_same(observations, share):
    """A Gaussian for every pixel as where depth is trusted: nothing else would make them."""
    rng = np.random.default_rng(0)
    frames = [
        replace(frame, depth_trusted=frame.depth_trusted & (~frame.mask | (rng.random(frame.mask.shape) < share)))
        for frame in observations.frames
    ]
    guessed = start(replace(observations, frames=frames), 10**6)
    assert int(guessed.dynamic.sum()) == int(start(observations, 10**6).dynamic.sum())
