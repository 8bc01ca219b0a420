"""What only a 4D scene can do: parts, slow motion, stabilized paths, dolly zooms, stereo pairs and wiggles, on a made scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from flowsplat.common.errors import InputError
from flowsplat.common.files import write_json
from flowsplat.gaussians.visibility import with_seen
from flowsplat.geometry import Camera
from flowsplat.geometry.paths import CameraPath, dolly_zoom, shift_camera
from flowsplat.output.videos import RenderOptions, list_rendered, render_videos
from flowsplat.output.videos.plans import plan_videos
from flowsplat.output.videos.shots import subject_distance
from flowsplat.output.videos.stabilized import compute_covered_share, stabilize
from flowsplat.scenes import Scene
from flowsplat.training.checkpoint import load_model
from tests.output.tiny import FPS, FRAMES, OBJECT, WALL, frames_of, red, tiny_cameras, tiny_model, tiny_run

SIZE = (64, 48)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tiny_run(tmp_path_factory.mktemp("parts") / "out", objects=3)
    return load_model(folder / "model"), Scene(folder / "scene")


def test_background_alone_has_no_objects(run, tmp_path):
    render_videos(*run, tmp_path, RenderOptions(paths=("input",), parts=("all", "background")))
    assert set(list_rendered(tmp_path)) == {
        "input_path",
        "input_path_color",
        "input_path_background",
        "input_path_background_color",
    }
    whole = [red(frame).sum() for frame in frames_of(tmp_path / "input_path_color.mp4")]
    without = [red(frame).sum() for frame in frames_of(tmp_path / "input_path_background_color.mp4")]
    assert min(whole) > 10
    assert max(without) == 0


def test_objects_alone_are_on_transparent(run, tmp_path):
    render_videos(*run, tmp_path, RenderOptions(paths=("input",), parts=("objects",)))
    assert list_rendered(tmp_path) == {"input_path_objects": "input_path_objects.webm"}
    frames = frames_of(tmp_path / "input_path_objects.webm", "libvpx-vp9", "rgba")
    assert len(frames) == FRAMES
    for frame in frames:
        alpha = frame[..., 3]
        assert alpha.max() > 230
        assert (alpha < 10).mean() > 0.5
        assert red(frame[alpha > 200][None]).all(), "full color where it is opaque"
    places = [np.argwhere(frame[..., 3] > 128)[:, 1].mean() for frame in frames]
    assert places[-1] > places[0] + 5, "it moves to the right"


def test_one_object_alone(run, tmp_path):
    """Named by its number it has what of it rests as well."""
    model, scene = run
    two = replace(model, gaussians=model.gaussians.select(torch.arange(len(model.gaussians))))
    two.gaussians.object_ids[-1] = 5
    two.gaussians.dynamic[-2] = False
    assert two.gaussians.object_counts == {2: 2, 5: 1}
    assert [len(two.part(part).gaussians) for part in ("objects", "objects:2", "objects:5", "objects:5,2")] == [2, 2, 1, 3]
    assert not two.part("objects:2").fill
    render_videos(two, scene, tmp_path, RenderOptions(paths=("input",), parts=("objects:5", "objects:5,2"), max_frames=2))
    assert list_rendered(tmp_path) == {
        "input_path_objects_5": "input_path_objects_5.webm", "input_path_objects_5_2": "input_path_objects_5_2.webm"
    }  # fmt: skip
    one, both = (frames_of(tmp_path / file, "libvpx-vp9", "rgba")[4][..., 3] for file in list_rendered(tmp_path).values())
    np.testing.assert_allclose(one / 255, two.part("objects:5").render(scene.cameras[4], 0.5).alpha, atol=0.1)
    assert both.sum() > 1.2 * one.sum()


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ("objects:1", "no object 1: there are 2"), ("objects:2,9", "no object 9: there are 2"), ("objects:300", "no object 300"),
        ("objects:", "Unknown part 'objects:'"), ("objects:x", "objects:1,3"), ("objects:-1", "Unknown part"), ("car:1",
        "Unknown part"),
        ("objects:1,,2", "Unknown part"), ("objects:²", "Unknown part"),
    ],
)  # fmt: skip
def test_objects_that_are_not_there_are_named(run, tmp_path, part, message):
    with pytest.raises(InputError, match=message):
        render_videos(*run, tmp_path, RenderOptions(paths=("input",), parts=("all", part)))
    assert list_rendered(tmp_path) == {}


def test_objects_farther_away(run, tmp_path):
    """Along the clip's own path the same images, from an orbit others; each lies beside what was rendered before."""
    model, scene = run
    options = RenderOptions(paths=("input", "orbit"), max_frames=8)
    render_videos(model, scene, tmp_path, options)
    render_videos(model, scene, tmp_path, replace(options, object_depth=("2=1.5",)))
    names = {"input_path", "orbit", "input_path_distance_2x1.5", "orbit_distance_2x1.5"}
    assert set(list_rendered(tmp_path)) == names | {f"{name}_color" for name in names}

    def places(name: str) -> np.ndarray:
        frames = frames_of(tmp_path / f"{name}_color.mp4")
        return np.array([np.argwhere(red(frame))[:, 1].mean() for frame in frames])

    np.testing.assert_allclose(places("input_path_distance_2x1.5"), places("input_path"), atol=0.7)
    plan = next(plan for plan in plan_videos(model, scene, options) if plan.name == "orbit")
    t = np.array([t for _, t in plan.shots])
    centers = np.array([CameraPath(scene.timestamps.tolist(), scene.cameras).at(s).center for s in t])
    obj = np.stack([-0.5 + t / model.last, np.zeros_like(t), np.full_like(t, OBJECT)], 1)
    expected = [
        camera.project(x)[0][0] - camera.project(y)[0][0]
        for (camera, _), x, y in zip(plan.shots, centers + 1.5 * (obj - centers), obj, strict=True)
    ]
    assert np.ptp(expected) > 4
    np.testing.assert_allclose(places("orbit_distance_2x1.5") - places("orbit"), expected, atol=1)


def test_guesses_fade_where_that_is_asked_for(run, tmp_path):
    model, scene = run
    options = RenderOptions(paths=("orbit",), max_frames=8, confidence_fade=True, orbit_angle=20.0)
    with pytest.raises(InputError, match="earlier flowsplat"):
        render_videos(model, scene, tmp_path, options)
    known = with_seen(model, scene.cameras, scene.timestamps.tolist())
    known.gaussians.seen[:, 1] = 0
    render_videos(known, scene, tmp_path, options)
    render_videos(known, scene, tmp_path, replace(options, confidence_fade=False))
    assert set(list_rendered(tmp_path)) == {"orbit", "orbit_color", "orbit_confidence_fade", "orbit_confidence_fade_color"}
    confidence_fade, whole = (frames_of(tmp_path / f"{name}_color.mp4") for name in ("orbit_confidence_fade", "orbit"))
    assert confidence_fade[2].mean() < 0.7 * whole[2].mean(), "to one side"


@pytest.mark.parametrize(
    ("distances", "message"),
    [
        (("3=1.2",), "no object 3: there are 2"), (("2",), "object=factor as in 2=1.2"), (("2=far",), "'2=far' is none"),
        (("x=1",), "'x=1' is none"), (("2=0",), "0.1 to 10"), (("2=nan",), "cannot be nan"), (("2=1.1", "2=1.2"), "object 2 twice"),
    ],
)  # fmt: skip
def test_distances_that_make_no_sense_are_refused(run, tmp_path, distances, message):
    with pytest.raises(InputError, match=message):
        render_videos(*run, tmp_path, RenderOptions(paths=("input",), object_depth=distances))
    assert list_rendered(tmp_path) == {}


def test_objects_of_a_scene_without_any_are_refused(tmp_path):
    folder = tiny_run(tmp_path / "out", objects=0)
    arguments = load_model(folder / "model"), Scene(folder / "scene"), tmp_path / "r"
    with pytest.raises(InputError, match="Nothing moves"):
        render_videos(*arguments, RenderOptions(paths=("input",), parts=("objects",)))
    with pytest.raises(InputError, match="no object 1: none of its Gaussians belongs"):
        render_videos(*arguments, RenderOptions(paths=("input",), parts=("objects:1",)))
    render_videos(*arguments, RenderOptions(paths=("dolly",), parts=("background",), max_frames=2))
    assert list_rendered(tmp_path / "r")


def test_slow_motion_has_more_frames_at_the_same_rate(run):
    options = RenderOptions(paths=("input",))
    (normal,), (slow,) = plan_videos(*run, options), plan_videos(*run, replace(options, slow_motion=4.0))
    assert len(normal.shots) == FRAMES
    assert len(slow.shots) == 4 * (FRAMES - 1) + 1
    assert slow.fps == normal.fps == FPS
    np.testing.assert_allclose([t for _, t in slow.shots][::4], [t for _, t in normal.shots])
    assert slow.audio_from is None
    assert (normal.name, slow.name) == ("input_path", "input_path_slow4"), "it lies beside the one at full speed"


def test_slow_motion_moves_between_the_frames(run):
    (slow,) = plan_videos(*run, RenderOptions(paths=("input",), slow_motion=4.0))
    places = [np.argwhere(run[0].part("objects").render(*shot).alpha > 0.5)[:, 1].mean() for shot in slow.shots]
    assert (np.diff(places) > 0.1).all(), "every frame is a step further"


def shakiness(cameras) -> float:
    return float(np.abs(np.diff([camera.center for camera in cameras], n=2, axis=0)).mean())


def test_the_stabilized_path_is_smoother_and_shows_no_uncovered_border():
    """A wall that ends where the shaking cameras still just see it: without the crop its end would be seen."""
    cameras = tiny_cameras(SIZE, shake=0.1)
    model = tiny_model(1, half_width=1.8)
    shots = [(camera, i / FPS) for i, camera in enumerate(cameras)]
    # At the end of its way the camera sees past the right end of the wall.
    assert compute_covered_share(model, shots) < 1
    smooth, share = stabilize(model, shots, 2.0)
    assert shakiness(camera for camera, _ in smooth) < 0.2 * shakiness(cameras)
    assert 0.7 <= share < 1
    assert smooth[0][0].K[0, 0] == pytest.approx(cameras[0].K[0, 0] / share)
    assert [t for _, t in smooth] == [t for _, t in shots]
    for camera, t in smooth:
        assert (camera.width, camera.height) == SIZE
        assert (model.render(camera, t).alpha > 0.5).all()


def test_less_is_smoothed_where_too_much_would_be_cropped():
    """One look far to the side: smoothed away, the other frames would see past the wall."""
    cameras = tiny_cameras((64, 48))
    turned = cameras[4].viewmat.copy()
    turned[0, 3] -= 3.0
    cameras[4] = Camera(turned, cameras[4].K, 64, 48)
    shots = [(camera, i / FPS) for i, camera in enumerate(cameras)]
    model = tiny_model(1, half_width=5.5)
    assert compute_covered_share(model, shots) == 1
    smooth, share = stabilize(model, shots, 1.0)
    assert share >= 0.7
    assert all((model.render(*shot).alpha > 0.5).all() for shot in smooth)


def test_holes_in_the_middle_are_not_cropped_away(run):
    model = tiny_model(1)
    inside = (model.gaussians.params["means"][:, :2].norm(dim=1) > 0.15) | model.gaussians.dynamic
    model.gaussians = model.gaussians.select(inside.nonzero().squeeze(1))
    shots = [(camera, i / FPS) for i, camera in enumerate(tiny_cameras(SIZE))]
    assert (model.render(*shots[0]).alpha < 0.5).any()
    assert compute_covered_share(model, shots) == 1


def test_dolly_zoom_keeps_the_size_of_the_subject(run):
    model, scene = run
    (plan,) = plan_videos(model, scene, RenderOptions(paths=("dolly",), max_frames=8, dolly=1.6))
    near, far = plan.shots[0][0], plan.shots[4][0]
    assert far.K[0, 0] == pytest.approx(1.6 * near.K[0, 0])
    objects, wall = model.part("objects"), model.part("background")
    areas = [objects.render(camera, t).alpha.sum() for camera, t in plan.shots]
    np.testing.assert_allclose(areas, areas[0], rtol=0.02)
    assert np.median(wall.render(far, plan.shots[4][1]).depth) > np.median(wall.render(*plan.shots[0]).depth) + 1
    # The pattern of the wall grows: it is further behind the subject than the subject from the camera.
    a, b = (camera.project(np.array([[0.0, 0, WALL], [1.0, 0, WALL]]))[0] for camera in (near, far))
    assert abs(b[1, 0] - b[0, 0]) > 1.15 * abs(a[1, 0] - a[0, 0])


def test_the_subject_is_what_moves(run):
    model, scene = run
    assert subject_distance(model, scene.cameras[4], 0.5, 99.0) == pytest.approx(OBJECT, rel=0.05)
    assert subject_distance(tiny_model(0), scene.cameras[4], 0.5, 99.0) == 99.0


def test_dolly_zoom_of_a_camera_keeps_its_plane():
    camera = tiny_cameras(SIZE)[3]
    points = camera.unproject(np.array([[3.0, 5.0], [60.0, 40.0]]), np.array([2.5, 2.5]))
    uv, depth = dolly_zoom(camera, 2.5, 0.6).project(points)
    np.testing.assert_allclose(uv, [[3, 5], [60, 40]], atol=1e-9)
    np.testing.assert_allclose(depth, 1.5)


def test_stereo_pairs_differ_by_the_sign_of_the_parallax(run, tmp_path):
    render_videos(*run, tmp_path, RenderOptions(paths=("input",), stereo=True, eye_distance=0.08))
    assert list_rendered(tmp_path)["input_path_stereo"] == "input_path_stereo.mp4"
    (frame, *_) = frames_of(tmp_path / "input_path_stereo.mp4")
    assert frame.shape == (SIZE[1], 2 * SIZE[0], 3)
    left, right = frame[:, : SIZE[0]], frame[:, SIZE[0] :]
    places = [np.argwhere(red(eye))[:, 1].mean() for eye in (left, right)]
    eyes, focal = 0.08 * WALL, 64
    expected = focal * eyes * (1 / OBJECT - 1 / WALL)
    assert places[0] - places[1] == pytest.approx(expected, abs=0.7), "near things lie further right for the left eye"
    # What is as far as the eyes converge stays where it is.
    camera = tiny_cameras(SIZE)[0]
    point = np.array([0.3, 0.2, WALL])
    for side in (-1, 1):
        np.testing.assert_allclose(shift_camera(camera, side * 0.1, WALL).project(point)[0], camera.project(point)[0], atol=1e-9)


def test_stereo_pairs_of_parts(run, tmp_path):
    render_videos(*run, tmp_path, RenderOptions(paths=("input",), parts=("background", "objects"), stereo=True))
    assert {file for file in list_rendered(tmp_path).values() if "stereo" in file} == {
        "input_path_background_stereo.mp4", "input_path_objects_stereo.mp4"
    }  # fmt: skip
    (objects, *_) = frames_of(tmp_path / "input_path_objects_stereo.mp4")
    for eye in (objects[:, : SIZE[0]], objects[:, SIZE[0] :]):
        assert red(eye).any()
        assert np.median(eye) < 20, "all else is black"


def test_the_wiggle_swings_round_the_subject(run, tmp_path):
    render_videos(*run, tmp_path, RenderOptions(paths=("wiggle",), eye_distance=0.1))
    assert list_rendered(tmp_path) == {"wiggle": "wiggle.gif"}
    frames = frames_of(tmp_path / "wiggle.gif")
    assert frames[0].shape == (SIZE[1], SIZE[0], 3)
    places = [np.argwhere(red(frame))[:, 1].mean() for frame in frames]
    assert np.ptp(places) < 1.0
    changes = [np.abs(frame.astype(int) - frames[0]).mean() for frame in frames]
    assert max(changes) > 3, "the wall moves behind it"
    assert np.argmax(changes) not in (0, len(frames) - 1)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"parts": ("sky",)}, "sky"),
        ({"slow_motion": 0.0}, "slower"),
        ({"stabilize": -1.0}, "smoothed"),
        ({"dolly": 9.0}, "dolly"),
        ({"eye_distance": 0.0}, "Eyes"),
    ],
)
def test_bad_options_are_told(run, tmp_path, options, says):
    with pytest.raises(InputError, match=says):
        render_videos(*run, tmp_path, RenderOptions(**options))


@pytest.mark.parametrize(
    "record", [3, [], {"orbit": 3}, {"orbit": {"files": ["orbit.mp4"]}}, {"orbit": [1]}, {"orbit": {"files": ["../../evil.mp4"]}}]
)
def test_a_damaged_record_of_videos_is_refused(tmp_path, record):
    if isinstance(record, dict) and isinstance(record["orbit"], dict) and "evil" in record["orbit"]["files"][0]:
        record["orbit"] |= {"key": "0", "fps": 24.0, "frames": 3}
    write_json(tmp_path / "renders.json", record)
    with pytest.raises(InputError, match=r"renders\.json"):
        list_rendered(tmp_path)


def test_what_is_burnt_in_is_laid_over_the_path_of_the_clip_alone(tmp_path):
    folder = tiny_run(tmp_path / "out", objects=3)
    model, scene = load_model(folder / "model"), Scene(folder / "scene")
    overlay = np.zeros((scene.height, scene.width), bool)
    overlay[4:12, 4:20] = True
    scene.write_overlay(overlay)
    for i in range(scene.num_frames):
        scene.write_overlay_frame(i, np.where(overlay[..., None], np.uint8([0, 20 * i, 255]), 0))
    render_videos(model, scene, tmp_path, RenderOptions(paths=("input", "stabilized"), parts=("all", "background")))
    for i, frame in enumerate(frames_of(tmp_path / "input_path_color.mp4")):
        assert np.abs(frame[6:10, 7:17].mean((0, 1)) - [0, 20 * i, 255]).max() < 25
        assert frame[20:, :, 2].min() < 200
    for name in ("stabilized_color", "input_path_background_color"):
        assert all(frame[6:10, 7:17, 2].mean() < 230 for frame in frames_of(tmp_path / f"{name}.mp4"))
