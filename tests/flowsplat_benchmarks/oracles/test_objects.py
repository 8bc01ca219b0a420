"""Objects are found on their true objects, and the errors of their depth are those that were put in."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.priors.prepare import use_truth
from flowsplat.scenes import Scene
from flowsplat_benchmarks.oracles.objects import MatchedObject, depth_scale, match_objects, object_depth_errors, static_error
from tests.flowsplat_benchmarks.oracles.conftest import CONSTANT, SCALE, SHADOW, SHAPE_OFFSET, STATIC, TRAJECTORY


def test_scale_comes_from_the_paths(wrong_scene):
    scene = Scene(wrong_scene)
    assert depth_scale(scene) == pytest.approx(SCALE, rel=1e-6)
    assert static_error(scene) == pytest.approx(STATIC, abs=1e-3)


def test_objects_are_on_their_objects(wrong_scene):
    assert match_objects(Scene(wrong_scene)) == [
        MatchedObject(1, (4,)),
        MatchedObject(2, (5, 6)),
        MatchedObject(3, (7,)),
        MatchedObject(0, (SHADOW,)),
    ]


def test_what_is_compared():
    mask, true = np.array([[4, 5, 5, 0]]), np.array([[1, 2, 0, 2]])
    obj = MatchedObject(2, (5, 6))
    assert obj.region(mask).tolist() == [[False, True, True, False]]
    assert obj.select_compared(mask, true).tolist() == [[False, True, False, False]]
    assert MatchedObject(0, (5,)).select_compared(mask, true).tolist() == [[False, True, True, False]]


def test_errors_are_those_that_were_put_in(wrong_scene):
    first, *others = object_depth_errors(Scene(wrong_scene))
    assert first.matched == MatchedObject(1, (4,))
    assert first.frames == 8
    assert first.constant == pytest.approx(CONSTANT, abs=SHAPE_OFFSET)
    assert first.depth_trajectory == pytest.approx(TRAJECTORY, rel=0.05)
    assert first.shape_offset == pytest.approx(SHAPE_OFFSET, rel=0.05)
    for error in others:
        assert error.constant == pytest.approx(-0.2, abs=1e-3)
        assert error.shape_offset < 1e-3
        assert error.depth_trajectory is not None
        assert error.depth_trajectory < 1e-3


def test_true_priors_have_no_error(wrong_scene, tmp_path):
    shutil.copytree(wrong_scene, tmp_path / "scene")
    scene = Scene(tmp_path / "scene")
    use_truth(scene)
    assert depth_scale(scene) == 1
    assert static_error(scene) == 0
    errors = object_depth_errors(scene)
    assert [error.matched for error in errors] == [MatchedObject(n, (n,)) for n in (1, 2, 3)]
    assert all((error.constant, error.depth_trajectory, error.shape_offset) == (0, 0, 0) for error in errors)


def test_a_scene_without_truth_is_refused(wrong_scene, tmp_path):
    shutil.copytree(wrong_scene, tmp_path / "scene")
    shutil.rmtree(tmp_path / "scene" / "truth")
    with pytest.raises(InputError, match="only rendered scenes do"):
        object_depth_errors(Scene(tmp_path / "scene"))
