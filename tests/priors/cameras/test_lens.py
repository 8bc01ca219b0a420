from __future__ import annotations

import cv2
import numpy as np
import pytest

from flowsplat.geometry.similarity import path_errors
from flowsplat.priors.cameras.lens import find_lens, radial_lens
from flowsplat.priors.cameras.observations import Observations
from flowsplat.priors.cameras.solvers import solve
from tests.marks import slow
from tests.priors.cameras.worlds import FOCAL, HEIGHT, WIDTH, bend, cameras_of, observed, path, world


@pytest.mark.parametrize(("distortion", "travel"), [(-0.2, 1.5), slow(0.12, 1.5), slow(-0.25, 0.0)])
def test_a_known_distortion_is_recovered(distortion, travel):
    cameras = path(16, travel)
    positions = Observations.of(bend(observed(cameras, world(400), 0.1), distortion))
    pinhole = solve(positions, WIDTH, HEIGHT, None, "auto")
    lens = find_lens(positions, WIDTH, HEIGHT, None, pinhole.found, None)
    assert lens.distortion.coefficients[0] == pytest.approx(distortion, rel=0.1)
    assert lens.K[0, 0] == pytest.approx(FOCAL, rel=0.06)
    straight = solve(positions.at(lens.straighten_positions(positions.uv)), WIDTH, HEIGHT, None, "auto")
    errors = path_errors(cameras_of(straight.found.fit.state), cameras)
    assert errors["rotation"] < 0.3
    if travel:
        assert straight.judgments[0].pixels < 0.9 * pinhole.judgments[0].pixels
        assert errors["path"] < 0.005
        again = find_lens(positions, WIDTH, HEIGHT, None, straight.found, lens)
        assert again.distortion.coefficients[0] == pytest.approx(lens.distortion.coefficients[0], rel=0.05)


@pytest.mark.parametrize("travel", [1.5, 0.0])
def test_a_pinhole_has_no_lens(travel):
    positions = Observations.of(observed(path(12, travel), world(400), 0.1))
    found = solve(positions, WIDTH, HEIGHT, None, "auto").found
    assert find_lens(positions, WIDTH, HEIGHT, None, found, None) is None


@pytest.mark.parametrize("distortion", [-0.3, -0.05, 0.2])
def test_the_straightened_image_is_full_and_no_smaller_than_it_must_be(distortion):
    lens = radial_lens(FOCAL, distortion, WIDTH, HEIGHT)
    corners = np.array([[0.0, 0], [WIDTH, 0], [WIDTH / 2, 0], [0, HEIGHT / 2], [WIDTH, HEIGHT]])
    middle = np.array([WIDTH / 2, HEIGHT / 2])
    x = (corners - middle) / lens.pinhole[0, 0]
    source = x * (1 + distortion * (x**2).sum(1, keepdims=True)) * FOCAL + middle
    assert (source > -1e-6).all()
    assert (source < np.array([WIDTH, HEIGHT]) + 1e-6).all()
    slack = np.minimum(source, [WIDTH, HEIGHT] - source).min()
    assert slack < 1e-6
    np.testing.assert_allclose(lens.straighten_positions(source), corners, atol=1e-4)


def test_images_are_straightened_where_the_tracks_are():
    lens = radial_lens(FOCAL, -0.2, WIDTH, HEIGHT)
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    spots = np.array([[60.5, 50.5], [320.5, 180.5], [560.5, 300.5], [200.5, 320.5]])
    for x, y in (spots - 0.5).astype(int):
        cv2.circle(image, (int(x), int(y)), 3, (255, 255, 255), -1)
    straight = lens.straighten(image)[..., 0].astype(float)
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    for expected in lens.straighten_positions(spots):
        weight = straight * (np.hypot(x - expected[0], y - expected[1]) < 8)
        assert np.hypot((x * weight).sum() / weight.sum() - expected[0], (y * weight).sum() / weight.sum() - expected[1]) < 0.2
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[100:200, 100:300] = 7
    assert set(np.unique(lens.straighten(mask))) == {0, 7}
