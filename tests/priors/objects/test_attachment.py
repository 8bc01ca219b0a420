"""Parts at the distance of what they end on."""

from __future__ import annotations

import numpy as np
import pytest

from flowsplat.geometry import Camera
from flowsplat.priors.objects.attachment import attach_parts
from flowsplat.priors.objects.contact import find_below, upright_ratio
from flowsplat.priors.objects.distance import Cue
from flowsplat.priors.objects.shape_offset import ShapePoints
from flowsplat.priors.objects.solving import DynamicObject

FRAMES = 20
UP = np.array([0.0, -1.0, 0.0])
CAMERA = Camera(np.eye(4), np.array([[140.0, 0, 80], [0, 140, 45], [0, 0, 1]]), 160, 90)
TIED = {"contact": Cue(0.0, 0.06, 0.2)}


def a_mask(head_at: int = 70) -> np.ndarray:
    """[90, 160] a body, 1, and a head right above it, 2, at a column."""
    mask = np.zeros((90, 160), np.uint8)
    mask[30:80, 64:86] = 1
    mask[18:30, head_at : head_at + 10] = 2
    return mask


def an_object(number: int, log_depth: float, middle: tuple[float, float], cues: dict[str, Cue]) -> DynamicObject:
    points = ShapePoints(np.zeros(1, int), np.array([middle]), np.array([log_depth]), np.array([0.01]))
    return DynamicObject(
        number, np.full(FRAMES, log_depth), np.tile(middle, (FRAMES, 1)), 0.8, False, cues, points, 0.0
    )  # fmt: skip


def test_what_lies_right_below_is_found():
    number, pixels = find_below(a_mask(), 2, CAMERA, UP)
    assert number == 1
    assert (pixels[:, 1] == 29).all()
    assert find_below(a_mask(), 1, CAMERA, UP)[0] == 0, "nothing moves below the body"
    assert find_below(a_mask(head_at=100), 2, CAMERA, UP)[0] == 0, "beside it"


def placed(body: DynamicObject, head: DynamicObject, frames_on_body: int = FRAMES) -> DynamicObject:
    found = find_below(a_mask(), 2, CAMERA, UP)
    below = {1: [(0, found[1])] * FRAMES, 2: [found if k < frames_on_body else (0, found[1]) for k in range(FRAMES)]}
    first, second = attach_parts([body, head], below, [CAMERA] * FRAMES, UP)
    assert first is body
    return second


def test_a_part_that_nothing_ties_is_where_it_ends_on_the_body():
    body, head = an_object(1, 1.0, (75.0, 55.0), TIED), an_object(2, 2.0, (75.0, 24.0), {})
    moved = placed(body, head)
    pixel = np.array([[75.5, 29.5]])
    own, other = (each.log_depth[3] + np.log(upright_ratio(CAMERA, UP, each.middles[3], pixel))[0] for each in (moved, body))
    assert own == pytest.approx(other, abs=1e-3)
    assert moved.points.log_depth[0] - head.points.log_depth[0] == pytest.approx(moved.log_depth[0] - head.log_depth[0])
    assert moved.sigma == head.sigma
    assert not moved.cues, "it stays a guess"


@pytest.mark.parametrize("why", ["tied itself", "nothing ties the body", "it moves before and behind it", "only for moments"])
def test_what_is_no_such_part_stays(why):
    body, head = an_object(1, 1.0, (75.0, 55.0), TIED), an_object(2, 2.0, (75.0, 24.0), {})
    if why == "tied itself":
        head = an_object(2, 2.0, (75.0, 24.0), TIED)
    elif why == "nothing ties the body":
        body = an_object(1, 1.0, (75.0, 55.0), {})
    elif why == "it moves before and behind it":
        head.log_depth[:] = np.linspace(0, 2, FRAMES)
    assert placed(body, head, 6 if why == "only for moments" else FRAMES) is head
