"""Lenses bend as OpenCV's and COLMAP's formulas say, and what is straightened fills its image."""

from __future__ import annotations

import json

import numpy as np
import pytest

from flowsplat.geometry import Camera
from flowsplat.geometry.cameras import pixel_grid
from flowsplat.geometry.lens import Distortion, Lens, compute_shift

WIDTH, HEIGHT = 160, 100
K = np.array([[120.0, 0, 84], [0, 126, 47], [0, 0, 1]])
LENSES = {
    "barrel": Distortion((-0.25, 0.06, 0.001, -0.002)),
    "pincushion": Distortion((0.15, 0.02, -0.002, 0.001, 0.01)),
    "rational": Distortion((0.3, -0.05, 0.001, 0.0, 0.01, 0.45, -0.02, 0.004)),
    "fisheye": Distortion((0.03, -0.02, 0.004, -0.001), is_fisheye=True),
    "equidistant": Distortion((), is_fisheye=True),
}


def by_formula(lens: Distortion, x: np.ndarray) -> np.ndarray:
    """https://docs.opencv.org/4.x/d9/d0c/group__calib3d.html and .../db/d58/group__calib3d__fisheye.html."""
    a, b = x.T
    square = a**2 + b**2
    if lens.is_fisheye:
        k1, k2, k3, k4 = lens.coefficients or (0,) * 4
        angle = np.arctan(np.sqrt(square))
        bent = angle * (1 + k1 * angle**2 + k2 * angle**4 + k3 * angle**6 + k4 * angle**8)
        return x * (bent / np.sqrt(square))[:, None]
    k1, k2, p1, p2, k3, k4, k5, k6 = (*lens.coefficients, *(0,) * 8)[:8]
    radial = (1 + k1 * square + k2 * square**2 + k3 * square**3) / (1 + k4 * square + k5 * square**2 + k6 * square**3)
    u = a * radial + 2 * p1 * a * b + p2 * (square + 2 * a**2)
    v = b * radial + p1 * (square + 2 * b**2) + 2 * p2 * a * b
    return np.stack([u, v], -1)


@pytest.mark.parametrize("name", LENSES)
def test_points_are_bent_as_the_formulas_say_and_come_back(name: str):
    x = np.random.default_rng(0).uniform(-0.7, 0.7, (50, 2))
    bent = LENSES[name].bend(x)
    np.testing.assert_allclose(bent, by_formula(LENSES[name], x), atol=1e-12)
    np.testing.assert_allclose(LENSES[name].straighten(bent), x, atol=1e-7)
    assert LENSES[name].straighten(np.zeros((0, 3, 2))).shape == (0, 3, 2)
    assert np.isnan(LENSES[name].straighten(np.array([[np.nan, 0.1]]))).all()


def test_what_a_lens_shows_of_nothing_is_unknown():
    # x (1 - .3 x^2) is .70 at most, and a fisheye shows the half space within 90 degrees.
    assert np.isnan(Distortion((-0.3, 0, 0, 0)).straighten(np.array([[0.8, 0.0]]))).all()
    assert np.isnan(Distortion((), is_fisheye=True).straighten(np.array([[1.7, 0.0]]))).all()


@pytest.mark.parametrize("name", LENSES)
def test_the_straightened_image_is_full_and_no_smaller_than_it_must_be(name: str):
    lens = Lens.of(K, LENSES[name], WIDTH, HEIGHT)
    x, y = np.linspace(0, WIDTH, 41), np.linspace(0, HEIGHT, 41)
    border = np.concatenate([np.stack(np.broadcast_arrays(a, b), -1) for a, b in ((x, 0), (x, HEIGHT), (0, y), (WIDTH, y))])
    source = lens.distortion.bend((border - K[:2, 2]) / (K[[0, 1], [0, 1]] * lens.zoom)) * K[[0, 1], [0, 1]] + K[:2, 2]
    inside = np.minimum(source, [WIDTH, HEIGHT] - source)
    assert -1e-2 < inside.min() < 1e-2
    np.testing.assert_allclose(lens.straighten_positions(source), border, atol=1e-5)
    camera = Camera(np.eye(4), K, WIDTH, HEIGHT)
    np.testing.assert_allclose(lens.straighten_camera(camera).K, lens.pinhole)
    np.testing.assert_allclose(lens.pinhole[:2, 2], K[:2, 2])


def test_a_wide_fisheye_is_cut_where_a_pinhole_would_stretch_it_too_far():
    wide = np.array([[45.0, 0, 80], [0, 45, 50], [0, 0, 1]])  # 80 pixels are 102 degrees
    lens = Lens.of(wide, Distortion((), is_fisheye=True), WIDTH, HEIGHT)
    corner = np.hypot(80, 50) / lens.pinhole[0, 0]
    assert np.cos(np.arctan(corner)) ** 2 == pytest.approx(0.1, rel=1e-3)


@pytest.mark.parametrize("coefficients", [(np.nan, 0, 0, 0), (1e300, -1e300, 0, 0), (-1e4, 0, 0, 0), (0, 0, 50, 50)])
def test_a_lens_that_cannot_be_is_none(coefficients: tuple[float, ...]):
    with pytest.raises(ValueError, match="no pinhole"):
        Lens.of(K, Distortion(coefficients), WIDTH, HEIGHT)


def test_how_far_a_lens_bends_the_border():
    middle = np.array([[100.0, 0, 80], [0, 100, 50], [0, 0, 1]])
    corner = np.hypot(80, 50) / 100
    assert compute_shift(middle, Distortion((0.1, 0, 0, 0)), WIDTH, HEIGHT) == pytest.approx(100 * 0.1 * corner**3)
    assert compute_shift(middle, Distortion(), WIDTH, HEIGHT) == 0


def paint(points: np.ndarray) -> np.ndarray:
    """Return a smooth image [..., 3] of positions [..., 2]."""
    x, y = points[..., 0], points[..., 1]
    return (128 + 100 * np.stack([np.sin(x / 9), np.cos(y / 7), np.sin((x + y) / 11)], -1)).astype(np.float32)


def seen_by_pinhole(lens: Lens) -> np.ndarray:
    """Return [H, W, 2]: where the straightened image has what the pixels of the bent one show."""
    return lens.straighten_positions(pixel_grid(WIDTH, HEIGHT).astype(np.float64))


@pytest.mark.parametrize("name", LENSES)
def test_images_and_maps_are_straightened(name: str):
    lens = Lens.of(K, LENSES[name], WIDTH, HEIGHT)
    there = seen_by_pinhole(lens)
    bent = np.clip(np.nan_to_num(paint(there)) + 0.5, 0, 255).astype(np.uint8)
    difference = np.abs(lens.straighten(bent).astype(np.float32) - paint(pixel_grid(WIDTH, HEIGHT)))
    assert difference.max() < 4
    assert difference.mean() < 0.6
    labels = (7 * (there[..., 0] > 60)).astype(np.uint8)
    np.testing.assert_array_equal(np.unique(lens.straighten(labels)), [0, 7])
    assert (lens.straighten(labels) != 7 * (pixel_grid(WIDTH, HEIGHT)[..., 0] > 60)).mean() < 0.01
    depth = there[..., 0].astype(np.float32)
    assert np.abs(lens.straighten(depth) - pixel_grid(WIDTH, HEIGHT)[..., 0]).max() < 1.5


@pytest.mark.parametrize("name", LENSES)
def test_flow_is_straightened_at_both_ends(name: str):
    lens = Lens.of(K, LENSES[name], WIDTH, HEIGHT)

    def move(points: np.ndarray) -> np.ndarray:
        return points + 6 * np.stack([np.cos(points[..., 1] / 30), np.sin(points[..., 0] / 40)], -1)

    def bend(points: np.ndarray) -> np.ndarray:
        x = (points - lens.pinhole[:2, 2]) / lens.pinhole[[0, 1], [0, 1]]
        return lens.distortion.bend(x) * K[[0, 1], [0, 1]] + K[:2, 2]

    grid = pixel_grid(WIDTH, HEIGHT)
    flow = (bend(move(np.nan_to_num(seen_by_pinhole(lens)))) - grid).astype(np.float32)
    found, confidence = lens.straighten_flow(flow, np.ones((HEIGHT, WIDTH), np.float32))
    inside = ((move(grid) > 1) & (move(grid) < [WIDTH - 1, HEIGHT - 1])).all(-1)
    assert confidence[inside].min() == 1
    assert np.abs(found - (move(grid) - grid))[inside].max() < 0.3
    outside = ((move(grid) < -1) | (move(grid) > [WIDTH + 1, HEIGHT + 1])).any(-1)
    assert confidence[outside].max() == 0
    assert found.dtype == np.float32
    assert np.isfinite(found).all()


@pytest.mark.parametrize("name", LENSES)
def test_a_lens_is_the_same_after_json(name: str):
    lens = Lens.of(K, LENSES[name], WIDTH, HEIGHT)
    values = json.loads(json.dumps(lens.to_json()))
    again = Lens.from_json(values)
    assert again.to_json() == lens.to_json() == values
    np.testing.assert_array_equal(again.pinhole, lens.pinhole)
    assert again.distortion.is_fisheye is lens.distortion.is_fisheye
    assert lens.scale(2).shift == pytest.approx(2 * lens.shift)
