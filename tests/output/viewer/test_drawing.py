"""Images of what a client wants to see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from flowsplat.gaussians.crop import CropBox, crop
from flowsplat.geometry import Camera
from flowsplat.images.colors import float_to_bytes
from flowsplat.output.videos.options import RenderOptions
from flowsplat.output.viewer.browser_frame import SCENE_DEPTH, BrowserFrame
from flowsplat.output.viewer.drawing import Look, Wish, draw, draw_points
from flowsplat.output.viewer.layout import BAR_GRAY
from flowsplat.output.viewer.source import Loaded, Source
from flowsplat.output.viewer.trails import trails
from flowsplat.scenes.layers import Tracks
from tests.output.tiny import FPS, FRAMES, OBJECT, WALL, red, tiny_cameras, tiny_model, tiny_run


@pytest.fixture(scope="module")
def source(run_folder) -> Source:
    return Source(run_folder)


def seen(source: Source, size=(128, 96), t=0.5, **look):
    return draw(source, BrowserFrame(source.scene.similarity), Wish(size, t, Look(**look), None))


def test_the_input_camera_sees_the_input_frame(source):
    drawing = seen(source, (64, 48))
    assert np.abs(drawing.image.astype(int) - source.frame(0.5)).mean() < 1.5


def test_depth_is_told_in_the_world_of_the_browser(source):
    drawing = seen(source, t=0.5)
    assert np.median(drawing.depth) == pytest.approx(SCENE_DEPTH, rel=0.02)
    assert drawing.depth.min() == pytest.approx(SCENE_DEPTH * OBJECT / WALL, rel=0.05)


@pytest.mark.parametrize("show", ["color", "alpha", "depth", "flow", "Gaussians"])
def test_what_lies_outside_of_the_box_is_not_drawn(source, show):
    """The right half of the wall, and the object at the time at which it is most there."""
    box = CropBox((0.0, -9.0, 0.0), (9.0, 9.0, 9.0))
    whole, half = (seen(source, (128, 96), 0.0, show=show, crop=crop).image.astype(int) for crop in (None, box))
    cropped = replace(source.loaded.part("all"), graphs=False)
    cropped = crop(cropped, box)
    assert 0 < len(cropped.gaussians) < len(source.loaded.part("all").gaussians)
    if show == "color":
        expected = cropped.render(source.path.at(0.0).resize(128, 96), 0.0).color
        np.testing.assert_array_equal(half, float_to_bytes(expected))
        assert red(whole).any()
        assert not red(half).any(), "at the left in the middle of the clip"
    nothing = seen(source, (128, 96), 0.0, show=show, crop=CropBox((0.0, 0.0, 90.0), (1.0, 1.0, 91.0))).image
    np.testing.assert_array_equal(half[:, :48], nothing[:, :48])
    edge = slice(70, None)
    assert np.abs(half[:, edge] - whole[:, edge]).mean() < 0.05 * np.abs(half[:, edge] - nothing[:, edge].astype(int)).mean()


def test_parts_objects_elsewhere_and_ways_are_cropped(source):
    around_object = CropBox((-1.0, -1.0, OBJECT - 0.5), (0.5, 1.0, OBJECT + 0.5))
    assert red(seen(source, part="objects", crop=around_object).image).any()
    assert not seen(source, part="background", crop=around_object).image.any()
    pushed = seen(source, part="objects", crop=around_object, distances=((2, 1.4),)).image
    assert red(pushed).any(), "by where it was trained"
    assert len(trails(source.model("all", crop=around_object))[0]) == len(trails(source.model("all"))[0]) > 0
    assert not len(trails(source.model("all", crop=CropBox((1.0, -1.0, 0.0), (2.0, 1.0, 9.0))))[0])


def test_cropped_scenes_are_kept_but_not_for_ever(run_folder):
    loaded = Source(run_folder).loaded
    boxes = [CropBox((-1.0, -1.0, 0.0), (1.0 + k, 1.0, 9.0)) for k in range(6)]
    first = [loaded.crop("all", box) for box in boxes]
    assert loaded.crop("all", boxes[-1]) is first[-1]
    assert loaded.crop("all", boxes[0]) is not first[0]
    assert loaded.crop("all", None) is loaded.part("all")


def test_bars_lie_where_the_clip_does_not(source):
    drawing = seen(source, (200, 96))
    assert (drawing.image[:, :36] == BAR_GRAY).all()
    assert (drawing.depth[:, :36] > 100).all()
    assert (drawing.image[:, 36:164] != BAR_GRAY).any((0, 2)).all()
    # The browser's camera fits to it: its focal length is that of the fitted image.
    assert 48 / np.tan(drawing.pose.fov / 2) == pytest.approx(128)


def test_a_free_camera_fills_the_canvas(source):
    frame = BrowserFrame(source.scene.similarity)
    pose = frame.pose(source.path.at(0.5))
    drawing = draw(source, frame, Wish((200, 96), 0.5, Look(), pose))
    assert drawing.pose is pose
    assert (drawing.image[:, :36] != BAR_GRAY).any()
    middle = drawing.image[:, 36:164].astype(int)
    assert np.abs(middle - seen(source, (128, 96)).image).mean() < 3, "the same image with more at its sides"


def test_flow_of_the_input_camera_has_the_camera_in_it(source):
    """To the right by 0.3 in 8 steps: the wall flows to the left, which is cyan."""
    red, green, blue = seen(source, show="flow").image[10, 10].astype(int)
    assert min(green, blue) > red + 40
    last = seen(source, show="flow", t=1.0).image[10, 10].astype(int)
    assert min(last[1], last[2]) > last[0] + 40, "at the end flow goes on as it came"


def test_a_stereo_pair_shows_near_things_further_right_to_the_left_eye(source):
    one, pair = seen(source, (128, 96)), seen(source, (256, 96), stereo=True)
    left, right = pair.image[:, :128], pair.image[:, 128:]
    places = [np.argwhere(red(image))[:, 1].mean() for image in (left, one.image, right)]
    expected = 128 * RenderOptions.eye_distance * WALL * (1 / OBJECT - 1 / WALL)
    assert places[0] - places[2] == pytest.approx(expected, abs=0.7)
    assert places[1] == pytest.approx((places[0] + places[2]) / 2, abs=0.5)
    assert np.abs(left[:, :30].astype(int) - right[:, :30]).mean() < 1, "the wall is where both eyes meet"
    assert pair.depth.max() == 0, "what the browser draws is not seen"


def test_the_eyes_of_a_stereo_pair_see_the_same_flow(source):
    """Their distance is no motion: the wall flows as one eye sees it."""
    pair = seen(source, (256, 96), show="flow", stereo=True).image.astype(int)
    one = seen(source, (128, 96), show="flow").image.astype(int)
    for half in (pair[:, :128], pair[:, 128:]):
        assert np.abs(half[:, :30] - one[:, :30]).mean() < 3


def test_points_lie_where_the_gaussians_are():
    model = tiny_model(1)
    camera = tiny_cameras((640, 480))[0]
    image = draw_points(model.part("objects"), camera, 0.0)
    (y, x) = np.argwhere(image[..., 0] > 150).mean(0)
    uv, _ = camera.project(np.array([-0.5, 0.0, OBJECT]))
    assert (x, y) == pytest.approx(uv, abs=2)
    both = draw_points(model, camera, 0.0)
    assert (both[int(y), int(x)] == image[int(y), int(x)]).all(), "near ones lie over far ones"
    assert draw_points(tiny_model(0).part("objects"), camera, 0.0).max() < 30


def test_tracks_are_drawn_where_they_are(source):
    points = np.zeros((2, 9, 2), np.float32)
    points[0], points[1] = (10, 20), (50, 30)
    points[0, :, 0] += np.arange(9)
    tracks = Tracks(points, np.ones((2, 9), bool), np.ones((2, 9), np.float32), np.array([True, False]))
    plain = seen(source)
    source.tracks = tracks
    try:
        changed = np.abs(seen(source, tracks=True).image.astype(int) - plain.image).max(-1) > 20
        free = BrowserFrame(source.scene.similarity).pose(source.path.at(0.5))
        wish = Wish((128, 96), 0.5, Look(tracks=True), free)
        other = draw(source, BrowserFrame(source.scene.similarity), wish)
        same = draw(source, BrowserFrame(source.scene.similarity), replace(wish, look=Look()))
    finally:
        source.tracks = None
    assert changed[38:43, 20:30].any()
    assert changed[58:63, 98:103].any()
    assert changed.mean() < 0.02
    np.testing.assert_array_equal(other.image, same.image)


def test_an_object_farther_away_looks_the_same_to_the_clips_camera_alone(source):
    """The object stands at 2.5 before a wall at 4: half as far again it is still before the wall, twice as far behind it."""
    plain, far, hidden = (seen(source, (64, 48), distances=((2, factor),)) for factor in (1.0, 1.5, 2.0))
    assert np.abs(far.image.astype(int) - plain.image).max() < 6
    assert far.depth.min() == pytest.approx(1.5 * plain.depth.min(), rel=0.03)
    assert not red(hidden.image).any()
    frame = BrowserFrame(source.scene.similarity)
    aside = source.path.at(0.5).viewmat.copy()
    aside[0, 3] -= 0.4
    camera = Camera(aside, source.path.at(0.5).K, 64, 48)
    places = []
    for distances in ((), ((2, 1.5), (7, 2.0))):
        drawing = draw(source, frame, Wish((64, 48), 0.5, Look(distances=distances), frame.pose(camera)))
        places.append(np.argwhere(red(drawing.image))[:, 1].mean())
    # 0.4 to the right of the clip's camera what is at depth z is seen 64 * 0.4 / z further left.
    assert places[1] - places[0] == pytest.approx(64 * 0.4 / OBJECT * (1 - 1 / 1.5), abs=0.5)
    dots = draw(source, frame, Wish((64, 48), 0.5, Look("Gaussians", distances=((2, 1.5),)), frame.pose(camera))).image
    assert np.argwhere(red(dots))[:, 1].mean() == pytest.approx(places[1], abs=1)


def test_guesses_fade_when_seen_from_aside(source):
    """A wall that no two frames saw from different places is gone from aside, and there from the clip's own camera."""
    before, whole = source.loaded, source.loaded.part("all")
    known = replace(whole.gaussians, seen=torch.zeros(len(whole.gaussians), 2))
    source.loaded = Loaded(replace(whole, gaussians=known), "trained", before.number)
    frame, own = BrowserFrame(source.scene.similarity), source.path.at(0.5).resize(64, 48)
    aside = Camera(own.viewmat - np.array([[0, 0, 0, 0.8], *np.zeros((3, 4))]), own.K, own.width, own.height)
    try:
        for camera, is_there in ((own, True), (aside, False)):
            for kind in ("color", "Gaussians"):
                wishes = [
                    Wish((64, 48), 0.5, Look(kind, confidence_fade=confidence_fade), frame.pose(camera))
                    for confidence_fade in (True, False)
                ]
                found, plain = (draw(source, frame, wish).image.astype(float) for wish in wishes)
                assert (np.abs(found - plain).mean() < 1) == is_there, (is_there, kind)
    finally:
        source.loaded = before


def test_trails_go_with_the_distance():
    model = tiny_model(1)
    times = [k / FPS for k in range(FRAMES)]
    ends, _ = trails(model.at_distances({2: 1.5}, times, tiny_cameras((64, 48))))
    np.testing.assert_allclose(ends[0, 0], [-0.75, 0, 1.5 * OBJECT], atol=1e-4)
    np.testing.assert_allclose(ends[-1, 1], [0.3 + 1.5 * 0.2, 0, 1.5 * OBJECT], atol=1e-4)


def test_trails_go_where_the_object_goes(tmp_path):
    ends, colors = trails(tiny_model(1))
    assert ends.shape == colors.shape == (39, 2, 3)
    np.testing.assert_allclose(ends[0, 0], [-0.5, 0, OBJECT], atol=1e-5)
    np.testing.assert_allclose(ends[-1, 1], [0.5, 0, OBJECT], atol=1e-5)
    np.testing.assert_allclose(ends[1:, 0], ends[:-1, 1])
    assert colors[0, 0, 2] > colors[0, 0, 0]
    assert colors[-1, 1, 0] > colors[-1, 1, 2]
    assert len(trails(tiny_model(0))[0]) == 0
    many, _ = trails(tiny_model(900))
    assert len(many) == 300 * 39
    np.testing.assert_array_equal(many, trails(tiny_model(900))[0])


def test_a_portrait_clip(tmp_path):
    source = Source(tiny_run(tmp_path / "out", size=(36, 64)))
    drawing = seen(source, (128, 64))
    assert (drawing.image[:, :46] == BAR_GRAY).all()
    assert np.abs(drawing.image[:, 46:82].astype(int) - source.frame(0.5)).mean() < 2
