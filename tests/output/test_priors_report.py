"""The page about a prepared clip: what it says, that it needs nothing else, and that every kind of clip can be drawn."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np
import pytest

from flowsplat.geometry import Camera
from flowsplat.output.camera_path import path_at_an_angle, path_from_above
from flowsplat.output.priors_report import PANEL_SIDE, _Shown, verdict, write_priors_report
from flowsplat.pipeline import prepare
from flowsplat.pipeline.config import RunConfig
from flowsplat.priors.objects import SceneObjects
from flowsplat.priors.objects.distance import Cue
from flowsplat.priors.objects.shape_offset import ShapePoints
from flowsplat.priors.objects.solving import DynamicObject
from flowsplat.priors.objects.storage import save_objects
from flowsplat.priors.prepare import use_truth
from flowsplat.scenes import Scene
from flowsplat.scenes.synthetic import SyntheticScene, write_synthetic
from tests.scene_files import edited

from .test_report import NASTY, Balance, words

FREE = {
    "method": "tracks", "motion": "free", "static": False, "focal": 50.0, "focal_given": False, "focal_sigma": 0.01,
    "parallax_degrees": 7.5, "reprojection_px": 0.08, "unplaced": [], "breaks": [], "blank": [], "verdict": "The camera moves.",
}  # fmt: skip
MULTI_VIEW = {"method": "multi-view", "trusted": 0.9, "verdict": "90% of the still scene trusted"}
GUESS = {"method": "guess", "trusted": 1.0, "verdict": "a guess"}
OBJECTS = {"method": "motion", "objects": 2, "share": 0.1, "verdict": "2 moving objects"}


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    folder = tmp_path_factory.mktemp("priors") / "scene"
    write_synthetic(folder, SyntheticScene(width=64, height=48, frames=8, fps=8.0), holdout=None)
    scene = Scene(folder)
    use_truth(scene)
    return scene


@pytest.fixture
def as_found(scene: Scene) -> Iterator[Scene]:
    """The scene as if its priors had been computed; what a test changes is undone."""
    path = scene.folder / "scene.json"
    before = path.read_bytes()
    yield edited(scene, {"cameras": FREE, "depth": MULTI_VIEW, "masks": OBJECTS}, name=NASTY)
    path.write_bytes(before)


def page_of(folder: Path, scene: Scene) -> str:
    path = write_priors_report(folder, scene, {"cameras": 12.4})
    assert path == folder / "priors.html"
    return path.read_text(encoding="utf-8")


def test_the_page_tells_what_was_found_and_needs_nothing_else(as_found, tmp_path):
    page = page_of(tmp_path, as_found)
    text = words(page)
    for part in (
        "Camera path: good; depth from the camera&#39;s motion; 2 moving objects. Training can work.", "0.08 px",
        "camera error", "field of view", "points followed", "The camera moves.", "12 s", "Frame 7", "objects", "true tracks",
        "flow matched to the next frame", "of the still scene", "still scene, depth with confidence",
        "Points followed, over the clip", "times the median depth",
    ):  # fmt: skip
        assert part in text, part
    balance = Balance()
    balance.feed(page)
    assert all(source.startswith("data:") for source in balance.sources)
    assert "<script" not in page
    assert "{{ 7 * 7 }}" in page
    assert page.count('class="chart cameras"') == 2
    assert not re.search(r"[\"\s](nan|inf)\b", page)
    assert len(page) < 1e6


def test_the_page_shows_what_moves_and_how_sure_its_distance_is(as_found, tmp_path):
    frames = len(as_found.train_frames)
    depth, middles = np.full(frames, np.log(2.0)), np.full((frames, 2), [32.0, 24.0])
    number = int(next(n for i in as_found.train_frames for n in np.unique(as_found.mask(i)) if n))
    tied = DynamicObject(number, depth, middles, 0.05, True, {"pivot": Cue(0.0, 0.02, 0.05)}, ShapePoints.none(), 0.0)
    save_objects(as_found, SceneObjects([tied], np.array([0.0, -1.0, 0.0])))
    as_found.finish_prior("objects", method="motion", objects=1, rigid=1, tied=1, verdict="1 object")
    try:
        page = page_of(tmp_path, as_found)
        text = words(page)
        told = ("swings about a fixed point", "sure to 5%", "Largest step aside", "5 % distance of objects")
        for part in ("1 moving object. Training", f"Object {number}", *told):
            assert part in text, part
        assert page.count('class="object"') == 1
        as_found.amend_prior("objects", objects=3, tied=1)
        assert "3 moving objects, how far away 2 of them are is a guess." in verdict(as_found)
        as_found.amend_prior("objects", tied=0)
        assert "3 moving objects, how far away is a guess." in verdict(as_found)
    finally:
        for name in ("objects.json", "objects.npz"):
            (as_found.folder / name).unlink()


def test_the_strip_shows_every_training_frame(as_found, tmp_path):
    address = re.search(r'src="data:video/mp4;base64,([^"]+)"', page_of(tmp_path, as_found))
    assert address
    (tmp_path / "strip.mp4").write_bytes(base64.b64decode(address.group(1)))
    with av.open(str(tmp_path / "strip.mp4")) as video:
        frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
        assert float(video.streams.video[0].average_rate) == pytest.approx(8, rel=0.01)
    assert len(frames) == 8
    height, width = frames[0].shape[:2]
    assert abs(height - 2 * 48) <= 6
    assert abs(width - 2 * 64) <= 6
    objects = frames[3][-48:, :64].astype(int)
    tinted = np.ptp(objects, axis=-1) > 60
    mask = as_found.mask(3) > 0
    assert tinted[mask].mean() > 0.7
    assert tinted[~mask].mean() < 0.1


def test_images_are_reduced(tmp_path):
    write_synthetic(tmp_path / "scene", SyntheticScene(width=500, height=60, frames=2), holdout=None)
    scene = Scene(tmp_path / "scene")
    use_truth(scene)
    page = page_of(tmp_path, scene)
    assert f'width="{PANEL_SIDE}" height="48"' in page
    assert 'width="600"' not in page


@pytest.mark.parametrize(
    ("cameras", "depth", "expected"),
    [
        ({}, MULTI_VIEW, "Camera path: good; depth from the camera's motion; 2 moving objects. Training can work."),
        ({"motion": "static"}, GUESS, "Camera: stands still; no parallax: depth is a guess; 2 moving objects."),
        ({"motion": "rotation"}, GUESS, "Camera: only turns; no parallax: depth is a guess"),
        ({"parallax_degrees": 0.1}, GUESS, "little parallax: depth is a guess; 2 moving objects. Training can work along"),
        ({"parallax_degrees": 0.2}, MULTI_VIEW, "little parallax: depth is rough"),
        ({}, {**MULTI_VIEW, "trusted": 0.3}, "depth from motion on 30% of the still scene, the rest is filled in"),
        ({"reprojection_px": 0.9}, MULTI_VIEW, "Camera path: poor; "),
        ({"reprojection_px": 0.9}, MULTI_VIEW, "consider cameras from another tool"),
        ({"breaks": [4]}, MULTI_VIEW, "Camera path: good, with a cut before frame 4;"),
        ({"breaks": [2, 4]}, MULTI_VIEW, "with 2 cuts; "),
        ({"breaks": [4]}, MULTI_VIEW, "Train on one piece at a time: choose it with --start and --end."),
        ({"blank": [0, 1]}, MULTI_VIEW, "2 blank frames; "),
        ({"flat": True}, MULTI_VIEW, "Camera path: one plane, so the focal length is a guess;"),
        ({"flat": True}, MULTI_VIEW, "give --cameras.focal if you know it."),
        ({"surrounds": True}, MULTI_VIEW, "Camera path: good; something that moves fills most of the image;"),
        ({"motion": "unknown"}, GUESS, "Camera path: none, nothing could be followed"),
        ({"motion": "unknown"}, GUESS, "Training will hardly work"),
    ],
)
def test_the_verdict_in_plain_words(as_found, cameras, depth, expected):
    as_found.amend_prior("cameras", **cameras)
    as_found.finish_prior("depth", **depth)
    assert expected in verdict(as_found)


def test_priors_that_were_brought_along_are_named(scene):
    assert verdict(scene) == "Camera path: true; depth: true; 3 moving objects (true masks). Training can work."


def test_a_guessed_depth_is_called_one_in_the_images(as_found, tmp_path):
    as_found.finish_prior("depth", **GUESS)
    assert "depth (a guess)" in page_of(tmp_path, as_found)


def test_every_piece_of_a_cut_clip_has_its_own_drawings(as_found, tmp_path):
    as_found.amend_prior("cameras", breaks=[3])
    page = page_of(tmp_path, as_found)
    assert page.count('class="chart cameras"') == 4
    assert "Frames 0 to 2." in words(page)
    assert "Frames 3 to 7." in words(page)


# -- the drawings


def cameras_on(centers: np.ndarray, turned: float = 0.0) -> list[Camera]:
    K = np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]])
    cameras = []
    for center in centers:
        viewmat = np.eye(4)
        c, s = np.cos(turned), np.sin(turned)
        viewmat[:3, :3] = [[c, 0, -s], [0, 1, 0], [s, 0, c]]
        viewmat[:3, 3] = -viewmat[:3, :3] @ center
        cameras.append(Camera(viewmat, K, 64, 48))
    return cameras


def places(drawing: str, kind: str) -> list[np.ndarray]:
    lines = re.findall(rf'<path class="{kind}" d="M([^"]+)"', drawing)
    return [np.array([[float(v) for v in place.split()] for place in line.split("L")]) for line in lines]


@pytest.mark.parametrize("turned", [0.0, 1.2])
def test_from_above_right_is_right_and_ahead_is_up(turned):
    c, s = np.cos(turned), np.sin(turned)
    right, forward = np.array([c, 0, -s]), np.array([s, 0, c])
    centers = np.array([0 * right, right, right + forward])
    drawing = path_from_above(cameras_on(centers, turned), np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    (path,) = places(drawing, "line path")
    (x0, y0), (x1, y1), (x2, y2) = path
    assert x1 - x0 > 50
    assert abs(y1 - y0) < 1
    assert abs(x2 - x1) < 1
    assert y2 - y1 == pytest.approx(x0 - x1, abs=1)
    for wedge in places(drawing, "frustum"):
        assert wedge[1, 1] > wedge[0, 1]
        assert wedge[0, 0] < wedge[1, 0] < wedge[2, 0]


def test_scene_points_are_drawn_in_their_colors_and_stray_ones_left_out():
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform([-1, -1, 3], [1, 1, 4], (100, 3)), [[900.0, 0, 900]]])
    drawing = path_from_above(cameras_on(np.zeros((4, 3))), points, np.full((101, 3), (255, 0, 16), np.uint8))
    assert drawing.count('fill="#ff0010"') in range(80, 101)
    assert "line path" in drawing


def test_cameras_in_one_place_and_cameras_that_look_every_way_can_be_drawn():
    opposite = [cameras_on(np.zeros((1, 3)), turned)[0] for turned in (0.0, np.pi)]
    for cameras in (cameras_on(np.zeros((3, 3))), cameras_on(np.zeros((1, 3))), opposite):
        for drawing in (path_from_above(cameras, np.zeros((0, 3)), np.zeros((0, 3), np.uint8)), path_at_an_angle(cameras)):
            numbers = np.concatenate([line.ravel() for line in places(drawing, "frustum")])
            assert np.isfinite(numbers).all()
            assert 0 <= numbers.min() <= numbers.max() <= 640


# -- the run


def test_preparing_writes_the_page_and_says_so(scene, tmp_path, capsys):
    config = RunConfig()
    folder = prepare(scene.folder, tmp_path / "out", config)
    assert (folder.path / "priors.html").stat().st_size > 10_000
    assert "Training can work" in capsys.readouterr().err


def test_the_last_frame_shows_its_flow_as_it_came(as_found):
    shown = _Shown(as_found)
    last, before = (shown.panels(k)["flow"] for k in (-1, -2))
    assert (last > 0).mean() > 0.5, "it is not black"
    assert np.abs(last.astype(float) - before).mean() < 40, "nor the other way round"
    assert len(shown.matched) == len(shown.trusted) - 1
