"""The benchmarks of clicks and of shadows draw prompts and suns, and tell figures by kind."""

from __future__ import annotations

import numpy as np

from flowsplat_benchmarks.scripts import clicks, shadows


def test_prompts_lie_on_their_objects():
    masks = np.zeros((3, 60, 80), np.uint8)
    masks[1, 10:30, 20:40] = 1
    masks[2, 40:43, 5:8] = 2  # too small
    box, click = (clicks.draw_prompts(masks, 0, each) for each in (False, True))
    assert list(box) == list(click) == [1]
    left, top, right, bottom = box[1].box
    assert (15 <= left <= 18, 5 <= top <= 8, 42 <= right <= 45, 32 <= bottom <= 35) == (True,) * 4
    ((x, y),) = click[1].clicks
    assert abs(x - 30) <= 1
    assert abs(y - 20) <= 1
    assert clicks.overlap(masks == 1, masks == 1) == 1


def test_a_strong_sun_throws_shadows_that_the_sky_does_not():
    sun, sky = (shadows.draw_lit_world(204, each) for each in (False, True))
    assert sky.light.sun == 0
    assert np.isclose(np.linalg.norm(sun.light.direction), 1)
    assert 35 < np.degrees(np.arcsin(sun.light.direction[2])) < 45
    text = shadows.table([{"all": (30.0, 31.0), "hidden": (20.0, 20.0)}, {"all": (32.0, 34.0), "shadow": (15.0, 25.0)}])
    assert text.splitlines()[2] == "| 31.00, 32.50 | 15.00, 25.00 | 20.00, 20.00 |  |"
