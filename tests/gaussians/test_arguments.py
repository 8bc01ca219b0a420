"""What ``render`` is given: taken as it is meant, or refused in a sentence that names the argument."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import flowsplat
from flowsplat.common.errors import InputError
from flowsplat.gaussians.gaussians4d import Gaussians4D
from tests.output.small import FIRST, LAST, small_cameras, small_model


@pytest.fixture(scope="module")
def model() -> flowsplat.SceneModel:
    return small_model(resting=60, moving=30)


@pytest.fixture(scope="module")
def camera(model) -> flowsplat.Camera:
    return small_cameras(model)[4]


@pytest.mark.parametrize(
    "t", [1.5, np.float64(1.5), np.float32(1.5), np.array([1.5]), torch.tensor(1.5), torch.tensor([1.5], dtype=torch.float64)]
)
def test_any_number_is_a_time(model, camera, t):
    expected = model.render(camera, 1.5, (camera, 2.0))
    rendering = model.render(camera, t, (camera, torch.tensor(2.0)))
    assert np.array_equal(rendering.color, expected.color)
    assert np.array_equal(rendering.flow, expected.flow)


def test_rounded_seconds_are_within_the_clip(model, camera):
    model.render(camera, LAST + 1e-3 * (LAST - FIRST))
    model.render(camera, FIRST, [camera, LAST])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"t": float("nan")}, "t must be finite, not nan"), ({"t": np.inf}, "t must be finite"),
        ({"t": 9.0}, "t is 9 s, outside the clip (0.5 to 2.5 s)"), ({"t": "1"}, "t must be one number, not str '1'"),
        ({"t": None}, "t must be one number"), ({"t": torch.zeros(2)}, "t must be one number, not Tensor of shape [2]"),
        ({"camera": np.eye(4)}, "camera must be a flowsplat.Camera, not ndarray of shape [4, 4]"),
        ({"flow_to": 1.0}, "flow_to must be a pair (camera, t), not float 1.0"),
        ({"flow_to": (None, 1.0)}, "the camera of flow_to must be"),
        ({"flow_to": ("camera", -1.0)}, "the time of flow_to is -1"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(model, camera, change, said):
    given = {"camera": camera, "t": 1.0, "flow_to": None, **change}
    if change == {"flow_to": ("camera", -1.0)}:
        given["flow_to"] = (camera, -1.0)
    with pytest.raises(InputError) as error:
        model.render(**given)
    assert said in str(error.value)
    with pytest.raises(InputError):
        flowsplat.render(model.gaussians, **{**given, "t": given["t"] if "t" in change else 0.5})


def test_clip_time_is_checked_in_its_own_unit(model, camera):
    with pytest.raises(InputError, match=r"t is 1\.5, outside the clip \(0 to 1\)"):
        flowsplat.render(model.gaussians, model.similarity.camera(camera), 1.5)


@pytest.mark.parametrize(
    "change", [{"viewmat": np.full((4, 4), np.nan)}, {"viewmat": np.diag([2.0, 1, 1, 1])}, {"width": 0}, {"K": np.zeros((3, 3))}]
)
def test_a_camera_that_is_none_is_refused(model, camera, change):
    with pytest.raises(InputError, match="camera is none that can look"):
        model.render(replace(camera, **change), 1.0)


def test_float64_gives_the_same_image(model, camera):
    g = model.gaussians
    doubled = {name: value.double() for name, value in g.params.items()}
    rendering = replace(model, gaussians=replaced(g, doubled)).render(camera, 1.0)
    assert rendering.color.dtype == np.float32
    np.testing.assert_allclose(rendering.color, model.render(camera, 1.0).color, atol=1e-4)


def replaced(g: Gaussians4D, params, dynamic=None) -> Gaussians4D:
    return Gaussians4D(params, g.dynamic if dynamic is None else dynamic, g.config, g.sh_degree, g.object_ids)


def test_arrays_of_numpy_are_taken_as_float32(model, camera):
    g = model.gaussians
    arrays = {name: value.double().numpy() for name, value in g.params.items()}
    taken = replaced(g, arrays, g.dynamic.numpy())
    assert {value.dtype for value in taken.params.values()} == {torch.float32}
    expected = model.render(camera, 1.0)
    assert np.array_equal(replace(model, gaussians=taken).render(camera, 1.0).color, expected.color)


def test_parameters_of_several_types_are_refused(model):
    g = model.gaussians
    with pytest.raises(ValueError, match="times is float64, means float32"):
        replaced(g, {**g.params, "times": g.params["times"].double()})
    with pytest.raises(ValueError, match="dynamic must be bool, not float32"):
        replaced(g, g.params, g.dynamic.float())


def test_they_say_in_a_line_what_they_are(model):
    for value in (model, model.gaussians):
        assert len(repr(value)) < 120
        assert "90" in repr(value)
    assert "<table>" in model._repr_html_()
    assert "<img" not in model._repr_html_(), "it is not known from where"


def test_a_notebook_shows_it_from_its_viewpoint(model, camera):
    assert 'src="data:image/jpeg;base64,' in replace(model, viewpoint=(camera, 1.0))._repr_html_()
    wide = replace(model, viewpoint=(camera.resize(2000, 1000), 1.0)).thumbnail()
    assert wide.shape == (160, 320, 3)
