"""Tracks out of a model whose motion is known."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from flowsplat.gaussians.gaussians4d import Gaussians4D, parameter_shapes
from flowsplat.gaussians.model import SceneModel
from flowsplat.gaussians.model_config import ModelConfig
from flowsplat.gaussians.motion import LinearMotion
from flowsplat.gaussians.render import render_active
from flowsplat.gaussians.tracking import follow_points, pixel_weights
from flowsplat.geometry import Camera, Similarity
from tests.gaussians import spinning


def follow(model, queries):
    return follow_points(model, spinning.cameras(), spinning.timestamps(), np.array(queries, float))


def truth_of(u: float, v: float, frame: int) -> np.ndarray:
    """[T, 3] where the point of the plate that is seen at a pixel really is."""
    camera = spinning.camera_at(frame)
    start = camera.unproject(np.array([u, v]), np.array(spinning.PLATE))
    offset = spinning.off_plate(start, frame / (spinning.FRAMES - 1))
    return np.stack([spinning.on_plate(offset, i / (spinning.FRAMES - 1)) for i in range(spinning.FRAMES)])


def test_weights_are_those_of_the_image():
    """Blending with them gives the rendered pixel: depth and color."""
    model = spinning.model()
    camera = model.similarity.camera(spinning.camera_at(3))
    active = model.gaussians.active(0.25, camera)
    frame = render_active(model.gaussians, active, camera)
    features = torch.cat([frame.sliced.colors, frame.projected.depths[:, None]], 1).numpy()
    for x, y in ((10, 12), (48, 36), (61, 40), (95, 71)):
        index, weights = pixel_weights(frame, np.array([x + 0.5, y + 0.5]))
        np.testing.assert_allclose(weights @ features[index], frame.image[y, x, :4].numpy(), atol=2e-4)
        assert weights.sum() == pytest.approx(float(frame.alpha[y, x]), abs=1e-4)


@pytest.mark.parametrize("frame", [0, 5, 12])
def test_a_point_goes_with_the_plate_both_ways(frame):
    """Through several generations of Gaussians: the error stays below half a percent of the depth."""
    queries = [(48.5, 36.5, frame), (57.0, 30.0, frame), (44.2, 41.7, frame)]
    paths = follow(spinning.model(), queries)
    for query, path in zip(queries, paths.points, strict=True):
        error = np.linalg.norm(path - truth_of(*query), axis=1)
        assert error.max() < 0.005 * spinning.PLATE
    traveled = np.linalg.norm(np.diff(truth_of(*queries[1]), axis=0), axis=1).sum()
    assert traveled > 0.5
    assert paths.visible.all()


def test_one_generation_is_exact():
    """Carriers that never fade: their rigid motion, to rounding."""
    paths = follow(spinning.model(centers=2, life=5.0), [(57.0, 30.0, 4)])
    assert np.abs(paths.points[0] - truth_of(57.0, 30.0, 4)).max() < 0.004


def test_the_wall_stays():
    paths = follow(spinning.model(), [(8.0, 8.0, 2), (90.0, 60.0, 7)])
    assert np.ptp(paths.points, axis=1).max() < 1e-5
    for path, (u, v, i) in zip(paths.points, [(8.0, 8.0, 2), (90.0, 60.0, 7)], strict=True):
        np.testing.assert_allclose(spinning.camera_at(i).project(path[i])[0], [u, v], atol=1e-3)
        assert path[0, 2] == pytest.approx(spinning.WALL, rel=1e-3)
    assert paths.visible[1].all()


def test_hidden_points_are_followed_and_called_hidden():
    """A point of the plate's right side turns behind the screen."""
    plain, hidden = follow(spinning.model(), [(63.0, 36.0, 0)]), follow(spinning.model(screen=True), [(63.0, 36.0, 0)])
    np.testing.assert_allclose(hidden.points, plain.points, atol=1e-3)
    truth = truth_of(63.0, 36.0, 0)
    behind = np.zeros(spinning.FRAMES, bool)
    for i, camera in enumerate(spinning.cameras()):
        ray = camera.center + (truth[i] - camera.center) * (spinning.SCREEN - camera.center[2]) / (truth[i, 2] - camera.center[2])
        behind[i] = -0.5 < ray[0] < 0.06 and abs(ray[1]) < 0.8
    assert 2 <= behind.sum() <= spinning.FRAMES - 3
    assert not hidden.visible[0, behind].any()
    assert plain.visible[0, behind].all()
    assert hidden.visible[0, 0]


def test_what_leaves_the_image_is_not_visible():
    model = spinning.model()
    cameras = spinning.cameras()
    cameras[6] = Camera(cameras[6].viewmat + np.pad([[5.0]], ((0, 3), (3, 0))), cameras[6].K, 96, 72)
    paths = follow_points(model, cameras, spinning.timestamps(), np.array([[48.0, 36.0, 5]]))
    assert paths.visible[0].tolist() == [i != 6 for i in range(spinning.FRAMES)]
    assert np.isfinite(paths.points).all()


def test_where_nothing_takes_over_the_path_ends():
    """The plate's Gaussians are gone in the last third, and the wall behind them does not take over."""
    paths = follow(spinning.model(until=0.5), [(48.5, 36.5, 2)])
    known = np.isfinite(paths.points[0]).all(1)
    assert known[:7].all()
    assert not known[10:].any()
    assert not paths.visible[0, 10:].any()
    assert np.abs(paths.points[0, :7] - truth_of(48.5, 36.5, 2)[:7]).max() < 0.02


def test_an_empty_pixel_has_no_path():
    model = spinning.model()
    away = [Camera(np.diag([1.0, -1, -1, 1]), c.K, c.width, c.height) for c in spinning.cameras()]
    paths = follow_points(model, away, spinning.timestamps(), np.array([[48.0, 36.0, 0]]))
    assert np.isnan(paths.points).all()
    assert not paths.visible.any()


def test_the_linear_4d_gaussian_is_followed_too():
    """One that goes to the right by 0.4 over the clip."""
    config = ModelConfig(move_means=False, move_quats=False)
    moments = LinearMotion.from_moments(0.05**2 * torch.eye(3)[None], torch.tensor([[0.4, 0, 0]]), torch.tensor([0.0]))
    params = {name: torch.zeros(1, *shape) for name, shape in parameter_shapes(config).items()} | moments
    params["means"], params["times"] = torch.tensor([[0.0, 0, 2]]), torch.tensor([0.5])
    params["logit_opacities"][:] = 4.0
    gaussians = Gaussians4D(params, torch.ones(1, dtype=torch.bool), config)
    cameras = [spinning.camera_at(0)] * 5
    paths = follow_points(SceneModel(gaussians, Similarity(), 0.0, 1.0), cameras, np.linspace(0, 1, 5), np.array([[48.5, 36.5, 2]]))
    np.testing.assert_allclose(paths.points[0, :, 0] - paths.points[0, 2, 0], [-0.2, -0.1, 0, 0.1, 0.2], atol=1e-5)


def test_shapes_that_do_not_fit():
    with pytest.raises(ValueError, match="must be"):
        follow_points(spinning.model(), spinning.cameras(), spinning.timestamps(), np.zeros((2, 2)))
