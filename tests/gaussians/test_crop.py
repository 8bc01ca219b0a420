"""A crop keeps what lies in a box in the coordinates of the scene's cameras, and nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.gaussians.crop import CropBox, compute_bounds, crop, parse_crop, select_in_box
from flowsplat.gaussians.model import SceneModel
from flowsplat.geometry import Similarity
from tests.output.small import small_model

TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


def scene() -> SceneModel:
    """One whose own coordinates are others than those of the cameras."""
    return replace(small_model(), similarity=Similarity(0.5, TURN, np.array([0.25, 0.0, -0.5])))


def centers(model: SceneModel) -> np.ndarray:
    return model.similarity.inverse().points(model.gaussians.params["means"].double().numpy())


def test_what_lies_in_the_box_stays():
    model = scene()
    points = centers(model)
    middle = np.median(points, axis=0)
    box = CropBox(tuple((points.min(0) - 1).tolist()), (float(middle[0]), *(points.max(0) + 1)[1:].tolist()))
    cropped = crop(model, box)
    assert 0 < len(cropped.gaussians) < len(model.gaussians)
    np.testing.assert_allclose(centers(cropped), points[points[:, 0] <= middle[0]])
    assert not cropped.fill
    assert len(crop(model, compute_bounds(model)).gaussians) == len(model.gaussians)


def test_a_box_with_nothing_in_it_is_one_sentence():
    with pytest.raises(InputError, match="holds nothing of the scene, whose Gaussians lie in"):
        crop(scene(), CropBox((90.0, 90.0, 90.0), (91.0, 91.0, 91.0)))


@pytest.mark.parametrize("text", ["", "1", "1,2,3,4,5", "0,0,0,1,1,x", "0,0,0,1,1,nan", "0,0,0,1,1,1e999", "0,0,0,1,0,1"])
def test_what_is_no_box_is_refused(text):
    with pytest.raises(InputError, match="--crop"):
        parse_crop(text)
    assert parse_crop(str(parse_crop("-1,-2,0.5,1,1.25,3"))) == CropBox((-1.0, -2.0, 0.5), (1.0, 1.25, 3.0))


def test_where_nothing_lies_nothing_is_left():
    far = CropBox((90.0, 90.0, 90.0), (91.0, 91.0, 91.0))
    model = select_in_box(scene(), far)
    assert (len(model.gaussians), model.fill) == (0, False)


def test_a_box_has_twelve_edges():
    edges = CropBox((0.0, 1.0, 2.0), (1.0, 3.0, 6.0)).edges
    assert edges.shape == (12, 2, 3)
    lengths = np.abs(edges[:, 1] - edges[:, 0])
    assert sorted(map(tuple, lengths)) == [(0, 0, 4)] * 4 + [(0, 2, 0)] * 4 + [(1, 0, 0)] * 4
    assert len(np.unique(edges.reshape(-1, 3), axis=0)) == 8


@pytest.mark.parametrize("low", [0.0, 1.0, -123.456, 98765.4321])
@pytest.mark.parametrize("side", [1e-6, 0.02, 3.0])
def test_a_text_says_where_the_box_is(low, side):
    """However small it is and however far from the origin."""
    box = CropBox((low,) * 3, (low + side,) * 3)
    again = parse_crop(str(box))
    assert np.abs(np.subtract([again.low, again.high], [box.low, box.high])).max() <= 1.001e-3 * side
