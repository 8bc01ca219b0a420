"""What is known of objects, in words and figures."""

from __future__ import annotations

import json

import numpy as np
import pytest

from flowsplat.priors.objects.description import describe_objects, object_figures, sureness
from flowsplat.priors.objects.distance import Cue
from flowsplat.priors.objects.shape_offset import ShapePoints
from flowsplat.priors.objects.solving import DynamicObject
from flowsplat.priors.objects.storage import SceneObjects
from tests.priors.planes import FOCAL, WALL, write_planes


def obj(number: int, cues: dict[str, Cue], sigma: float = 0.05, seen: int = 12) -> DynamicObject:
    depth = np.where(np.arange(12) < seen, np.log(WALL / 2), np.nan)
    return DynamicObject(number, depth, np.full((12, 2), 30.0), sigma, False, cues, ShapePoints.none(), 0.0)


def test_each_object_in_words_and_figures(tmp_path):
    scene = write_planes(tmp_path / "scene", step=1, square=True)
    scene.write_depth(0, scene.truth.depth(0))
    stands = obj(2, {"contact": Cue(0.0, 0.03, 0.07)})
    unsure = obj(1, {}, sigma=0.5, seen=4)
    unknown = obj(5, {"something": Cue(0.0, 0.1, 0.1)})
    found = SceneObjects([stands, unsure, unknown, obj(7, {}, seen=0)], np.array([0.0, -1, 0]))
    described = describe_objects(scene, found)
    assert [each.number for each in described] == [1, 2, 5]
    assert [each.words for each in described] == ["nothing: a guess", "stands on the ground", "something"]
    assert described[0].frames == 4
    assert described[1].depth == pytest.approx(WALL / 2)
    # A step of Z / (2 f sigma) shifts what is sigma farther away by half a pixel less, to first order.
    step = described[1].largest_step
    shifts = [FOCAL * step / (WALL / 2 * np.exp(off)) for off in (0, 0.05)]
    assert shifts[0] - shifts[1] == pytest.approx(0.5, rel=0.05)
    assert described[0].largest_step < 0.2 * step


def test_the_figures_are_json(tmp_path):
    scene = write_planes(tmp_path / "scene", step=1, square=True)
    for i in scene.train_frames:
        scene.write_depth(i, scene.truth.depth(i))
        scene.write_mask(i, scene.truth.mask(i))
    figures = json.loads(json.dumps(object_figures(scene, SceneObjects([obj(1, {})], np.array([0.0, -1, 0])))))
    assert figures[0]["number"] == 1
    assert figures[0]["cues"] == []
    assert figures[0]["depth_in_scenes"] == pytest.approx(figures[0]["depth"] * scene.similarity.scale)


def test_how_sure_distances_are_in_words():
    assert sureness([0.07]) == "sure to 7%"
    assert sureness([0.14, 0.07]) == "sure to 7% to 15%"
    assert sureness([0.07, 0.07], 2) == "sure to 7%, 2 of them a guess"
    assert sureness([], 1) == "a guess"
