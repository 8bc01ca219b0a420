"""Objects at other distances: nothing changes for the clip's own camera, and everything for others as geometry says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from flowsplat.common import devices
from flowsplat.common.errors import InputError
from flowsplat.gaussians.distances import slice_view
from flowsplat.gaussians.flow import FlowModel
from flowsplat.gaussians.model import SceneModel
from flowsplat.geometry import Camera
from flowsplat.geometry.paths import CameraPath
from tests.output.small import LINEAR, OURS, PAPER, five_pairs, small_cameras, small_model, small_times

ROTATION = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0], [0.48, 0.64, 0.6]])


def shaking_path(model: SceneModel) -> tuple[list[float], list[Camera]]:
    """The path of the small scene with a camera that also goes up and nearer, unevenly."""
    cameras = []
    for k, camera in enumerate(small_cameras(model)):
        viewmat = camera.viewmat.copy()
        viewmat[1:3, 3] += 0.1 * np.sin(2.0 * k), 0.02 * k**1.5
        cameras.append(Camera(viewmat, camera.K, camera.width, camera.height))
    return small_times(), cameras


def at(model: SceneModel, **factors: float) -> SceneModel:
    return model.at_distances({int(name[1:]): factor for name, factor in factors.items()}, *shaking_path(model))


def close(found: np.ndarray, expected: np.ndarray, atol: float = 1e-4) -> None:
    """But for single pixels where something ends at the smallest alpha that is drawn."""
    assert np.quantile(np.abs(found - expected), 0.999) < atol


@pytest.mark.parametrize("flow_model", ["displacement", "affine", "mean"])
@pytest.mark.parametrize(("config", "factor"), [(OURS, 1.7), (PAPER, 0.7), (LINEAR, 1.7)], ids=["ours", "paper", "linear"])
def test_the_clips_own_camera_sees_no_difference(config, factor, flow_model: FlowModel):
    """At frames and between them: only the depth is another."""
    model = replace(small_model(config, rotation=ROTATION), flow_model=flow_model).part("objects:1")
    path = CameraPath(*shaking_path(model))
    moved = at(model, m1=factor)
    for t in (small_times()[0], small_times()[3], 1.333, small_times()[-1] - 0.011):
        camera, other = path.at(t), (path.at(t + 0.01), t + 0.01)
        before, after = model.render(camera, t, other), moved.render(camera, t, other)
        assert before.alpha.max() > 0.5
        close(after.color, before.color)
        close(after.alpha, before.alpha)
        close(after.depth, factor * before.depth, 1e-3)
        assert before.flow is not None
        assert after.flow is not None
        seen = before.alpha > 0.1
        assert np.abs(before.flow[seen]).max() > 0.2
        # The paper's flow is of first order only: of a path about another place it leaves other things out.
        close(after.flow[seen], before.flow[seen], 0.05 if flow_model == "mean" else 2e-3)


@pytest.mark.parametrize("config", [OURS, PAPER, LINEAR], ids=["ours", "paper", "linear"])
def test_from_aside_objects_are_seen_as_one_who_stands_elsewhere_sees_them(config):
    """Where X' = C + k (X - C), a viewer at O sees what one at C + (O - C) / k saw before, k times as far away."""
    model = small_model(config).part("objects:2")
    moved, path = at(model, m2=1.4), CameraPath(*shaking_path(model))
    for camera, t in five_pairs(model):
        C, O = path.at(t).center, camera.center
        there = camera.viewmat.copy()
        there[:3, 3] = -there[:3, :3] @ (C + (O - C) / 1.4)
        expected = model.render(Camera(there, camera.K, camera.width, camera.height), t)
        found = moved.render(camera, t)
        close(found.color, expected.color)
        close(found.alpha, expected.alpha)
        close(found.depth, 1.4 * expected.depth, 1e-3)
    assert np.abs(model.render(*five_pairs(model)[3]).alpha - moved.render(*five_pairs(model)[3]).alpha).mean() > 0.02


def test_only_the_object_that_is_named_goes_and_what_of_it_rests_goes_with_it():
    model = small_model(OURS)
    gaussians = model.gaussians
    gaussians.object_ids[:3] = 1  # of the wall, at rest
    moved = at(model, m1=1.5, m2=1.0)
    assert moved.distances is not None
    assert set(moved.distances.factors) == {1}
    camera, t = five_pairs(model)[3]
    inner, clip_time = model.similarity.camera(camera), model.clip_time(t)
    plain = slice_view(gaussians, inner, clip_time)
    found = slice_view(gaussians, inner, clip_time, distances=moved.distances)
    C = torch.as_tensor(moved.distances.center(clip_time), dtype=torch.float32)
    active = gaussians.active(clip_time)
    own = gaussians.object_ids[active.rows] == 1
    kept = len(found.means) - int(own.sum())
    assert kept > 100
    state = gaussians.motion.state({name: value[active.rows[own]] for name, value in gaussians.params.items()}, clip_time)
    means = torch.where(gaussians.at_rest[active.rows[own], None], gaussians.params["means"][active.rows[own]], state.means)
    expected = C + 1.5 * (means - C)
    torch.testing.assert_close(found.means[kept:], expected)
    moved_means = moved.distances.move(means, gaussians.object_ids[active.rows[own]], clip_time)
    torch.testing.assert_close(moved_means, expected)
    others = torch.cdist(found.means[:kept], plain.means, compute_mode="donot_use_mm_for_euclid_dist").amin(1)
    assert float(others.max()) == 0, "all others are where they were"
    resting = found.velocities[len(found.velocities) - int(own.sum()) :][:3]
    expected = -0.5 * torch.as_tensor(moved.distances.compute_speed(clip_time), dtype=torch.float32)
    torch.testing.assert_close(resting, expected.expand(3, 3))
    assert float(expected.norm()) > 0.05


def test_the_slice_of_the_gpu_is_that_of_the_cpu(monkeypatch):
    """Triton's kernels, in its interpreter where there is no GPU."""
    pytest.importorskip("triton", reason="Triton is not installed")
    device = "cuda" if torch.cuda.is_available() else "cpu"
    model = small_model(OURS, resting=20, moving=30)
    model.gaussians.object_ids[:3] = 1
    moved, camera = at(model, m1=1.5, m2=0.8), model.similarity.camera(small_cameras(model)[2])
    expected = slice_view(model.gaussians, camera, 0.4, 0.5, moved.distances)
    assert len(expected.means) > 20
    monkeypatch.setattr(devices, "kernels_for", lambda value: "triton")
    found = slice_view(model.gaussians.to(device), camera, 0.4, 0.5, moved.distances)
    for name, value in vars(expected).items():
        if value is not None:
            torch.testing.assert_close(getattr(found, name).cpu(), value, rtol=1e-4, atol=1e-5, msg=name)


def test_velocities_are_those_of_the_moved_places():
    model = small_model(PAPER).part("objects:1")
    moved, camera = at(model, m1=1.6), model.similarity.camera(small_cameras(model)[4])
    assert moved.distances is not None
    before, now, after = (slice_view(model.gaussians, camera, 0.4, t, moved.distances) for t in (0.399, None, 0.401))
    assert before.next_means is not None
    assert after.next_means is not None
    difference = (after.next_means - before.next_means) / 0.002
    scale = difference.norm(dim=1).mean()
    assert float(scale) > 0.1
    assert float((now.velocities - difference).norm(dim=1).mean()) < 0.02 * float(scale)


def test_an_object_goes_behind_what_it_stood_before():
    model = small_model(OURS)
    t = small_times()[4]
    camera = CameraPath(*shaking_path(model)).at(t)
    near, far = model.render(camera, t), at(model, m1=2.5, m2=2.5).render(camera, t)
    wall = model.part("background").render(camera, t)
    opaque = (wall.alpha > 0.98) & (model.part("objects").render(camera, t).alpha > 0.5)
    assert opaque.sum() > 20
    assert np.abs(near.color - wall.color)[opaque].mean() > 0.1
    assert np.abs(far.color - wall.color)[opaque].mean() < 0.02


def test_a_factor_of_one_changes_no_bit():
    model = small_model(OURS)
    same = at(model, m1=1.0)
    assert same.distances is None
    camera, t = five_pairs(model)[0]
    np.testing.assert_array_equal(same.render(camera, t).color, model.render(camera, t).color)


def test_a_camera_that_stands_still_and_an_object_that_is_not_there_yet():
    model = small_model(OURS).part("objects:1")
    t = small_times()[2]
    still = model.at_distances({1: 2.0}, [t], [small_cameras(model)[2]])
    close(still.render(small_cameras(model)[2], t).color, model.render(small_cameras(model)[2], t).color)
    model.gaussians.params["times"][:] = 5.0
    gone = at(model, m1=2.0).render(small_cameras(model)[2], t)
    assert gone.alpha.max() == 0


@pytest.mark.parametrize(
    ("factors", "message"),
    [({3: 1.2}, "no object 3: there are 1, 2"), ({1: 0.0}, "Object 1 cannot be 0 times"), ({1: float("nan")}, "cannot be nan"),
     ({2: 11.0}, "0.1 to 10"), ({2: -1.0}, "0.1 to 10")],
)  # fmt: skip
def test_distances_that_make_no_sense_are_refused(factors, message):
    model = small_model(OURS)
    with pytest.raises(InputError, match=message):
        model.at_distances(factors, *shaking_path(model))
