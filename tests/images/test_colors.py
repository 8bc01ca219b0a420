"""Colors of flow, depth and error."""

from __future__ import annotations

import colorsys

import numpy as np
import pytest

from flowsplat.images.colors import (
    MIN_FLOW_SCALE,
    depth_range,
    depth_to_color,
    error_to_color,
    float_to_bytes,
    flow_legend,
    flow_scale,
    flow_to_color,
)


def color_of(x: float, y: float, scale: float = 1.0) -> np.ndarray:
    return flow_to_color(np.array([[[x, y]]], np.float32), scale)[0, 0].astype(int)


def hue_of(x: float, y: float) -> float:
    return 360 * colorsys.rgb_to_hsv(*(color_of(x, y) / 255))[0]


def test_the_directions_of_the_usual_wheel():
    # Baker et al.: 15 steps red to yellow, 6 to green, 4 to cyan, 11 to blue, 13 to magenta, 6 to red. A quarter turn is
    # 13.75 of the 55 steps.
    assert color_of(1, 0).tolist() == [255, 0, 0]
    assert hue_of(0, 1) == pytest.approx(60 * 13.75 / 15, abs=1), "down is yellow"
    assert hue_of(-1, 0) == pytest.approx(180 + 60 * 2.5 / 11, abs=1), "left is cyan, a little to the blue"
    assert hue_of(0, -1) == pytest.approx(240 + 60 * 5.25 / 13, abs=1), "up is violet"


def test_the_hue_goes_round_without_a_jump():
    angles = np.linspace(0, 2 * np.pi, 721)
    ring = flow_to_color(np.stack([np.cos(angles), np.sin(angles)], -1)[None] * 0.999, 1.0)[0].astype(int)
    assert np.abs(np.diff(ring, axis=0)).max() < 15


def test_length_is_strength():
    assert color_of(0, 0).tolist() == [255, 255, 255]
    assert color_of(0.5, 0).tolist() == [255, 128, 128]
    assert color_of(4, 0, scale=8).tolist() == [255, 128, 128]
    assert color_of(2, 0).tolist() == [191, 0, 0], "beyond the scale it is darker"


def test_unknown_flow_is_black_and_does_not_touch_the_scale():
    flow = np.full((4, 4, 2), 3.0, np.float32)
    flow[0, 0], flow[1, 1, 0] = np.nan, np.inf
    color = flow_to_color(flow)
    assert (color[[0, 1], [0, 1]] == 0).all()
    assert (color[2, 2] > 0).any()
    assert flow_scale([flow]) == pytest.approx(3 * np.sqrt(2), rel=1e-5)
    assert flow_scale([np.full((2, 2, 2), np.nan)]) == MIN_FLOW_SCALE


def test_a_clip_at_rest_stays_pale():
    noise = np.random.default_rng(0).normal(0, 0.01, (20, 20, 2))
    assert flow_to_color(noise).min() > 220


def test_legend_shows_where_colors_lead_to():
    legend = flow_legend(65)
    assert legend.shape == (65, 65, 3)
    assert (legend[32, 32] > 245).all()
    assert (legend[0, 0] == 255).all()
    assert legend[32, 63, 0] > 250
    assert legend[32, 63, 1] < 20


def test_depth_is_red_near_blue_far_black_unknown():
    color = depth_to_color(np.array([[1.0, 4.0, 0.0, np.nan, 0.5, 9.0]]), 1.0, 4.0)[0].astype(int)
    near, far, nothing, unknown, nearer, farther = color
    assert near[0] > near[2]
    assert far[2] > far[0]
    assert (nothing == 0).all()
    assert (unknown == 0).all()
    assert (nearer == near).all()
    assert (farther == far).all()


def test_depth_range():
    depth = np.linspace(2, 4, 1000)
    depth[:3] = 0, np.nan, np.inf
    near, far = depth_range([depth, depth + 1])
    assert (near, far) == pytest.approx((2.03, 4.98), abs=0.02)
    assert depth_range([np.zeros(3)]) == (1.0, 2.0)
    assert np.isfinite(depth_to_color(np.full((2, 2), 3.0), 3.0, 3.0)).all()


def test_error_grows_with_the_difference_and_mixes_types():
    a = np.zeros((1, 3, 3), np.float32)
    b = np.zeros((1, 3, 3), np.uint8)
    b[0, 1], b[0, 2] = 20, 255
    brightness = error_to_color(a, b).astype(int).sum(-1)[0]
    assert brightness[0] < brightness[1] < brightness[2]


def test_float_to_bytes_rounds_and_clips():
    values = np.array([-1, 0, 0.5, 1, 2, np.nan, 0.999])
    assert float_to_bytes(values).tolist() == [0, 0, 128, 255, 255, 0, 255]
    same = np.array([3, 4], np.uint8)
    assert float_to_bytes(same) is same
