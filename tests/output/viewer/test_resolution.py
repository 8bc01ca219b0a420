"""How large images are."""

from __future__ import annotations

from flowsplat.output.viewer.resolution import AdaptiveResolution


def test_still_images_are_as_large_as_the_canvas_up_to_a_limit():
    resolution = AdaptiveResolution(800)
    assert resolution.still((640, 480)) == (640, 480)
    assert resolution.still((1600, 400)) == (800, 200)
    assert resolution.still((300, 1600)) == (150, 800)


def test_moving_images_become_as_large_as_stays_fluent():
    resolution, canvas = AdaptiveResolution(1600), (1600, 900)
    for _ in range(30):
        size = resolution.choose_moving_size(canvas)
        resolution.learn(size, size[0] * size[1] * 1e-6)  # a slow machine: a second for a million pixels
    pixels = size[0] * size[1]
    assert 60_000 < pixels < 100_000
    for _ in range(30):
        size = resolution.choose_moving_size(canvas)
        resolution.learn(size, size[0] * size[1] * 1e-9)
    assert size == canvas, "a fast one shows everything"


def test_one_slow_image_does_not_spoil_the_next():
    resolution, canvas = AdaptiveResolution(1600), (1600, 900)
    before = resolution.choose_moving_size(canvas)
    resolution.learn(before, 30.0)
    after = resolution.choose_moving_size(canvas)
    assert after[0] > before[0] / 2


def test_they_never_get_too_small_to_see_or_larger_than_still_ones():
    resolution = AdaptiveResolution(1600)
    for _ in range(50):
        resolution.learn(resolution.choose_moving_size((1600, 900)), 10.0)
    assert max(resolution.choose_moving_size((1600, 900))) >= 240
    assert resolution.choose_moving_size((100, 50)) == (100, 50)
    assert min(resolution.choose_moving_size((1, 1000))) >= 1
