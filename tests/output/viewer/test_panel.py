"""The controls of time, image, objects and overlays, as a browser sees them."""

from __future__ import annotations

import time

import numpy as np
import pytest

from flowsplat.scenes.layers import read_image
from tests.output.tiny import FPS, FRAMES, red, tiny_run

pytest.importorskip("viser", reason="viser is not installed: pip install 'flowsplat[view]'")

from tests.output.viewer.browser import place, viewed


def test_time_moves(browser):
    start = place(browser.settled())
    browser.set("Seconds", 1.0)
    browser.wait(lambda: place(browser.images[-1]) > start + 0.1)
    browser.set("Speed", "1/4")
    browser.set("Seconds", 0.0)
    browser.settled()
    seen = len(browser.images)
    browser.click("Play")
    browser.wait(lambda: browser.value("Seconds") > 0.2)
    assert len(browser.images) > seen + 1
    browser.click("Play")
    browser.settled()
    stopped = browser.value("Seconds")
    time.sleep(0.5)
    assert 0.2 < browser.value("Seconds") == stopped


def test_playing_once_ends_at_the_end(browser):
    browser.set("Loop", False)
    browser.set("Speed", "2")
    browser.click("Play")
    browser.wait(lambda: browser.value("Seconds") == pytest.approx((FRAMES - 1) / FPS))
    browser.wait(lambda: "Play" in [control.get("label") for control in browser.controls.values()])


def test_every_drawing_is_different_and_what_it_should_be(browser):
    browser.set("Mode", "orbit")
    seen = {"color": browser.settled()}
    for show in ("flow", "depth", "alpha", "Gaussians"):
        browser.set("Show", show)
        seen[show] = browser.settled()
    assert seen["alpha"][20:50, 30:60].mean() > 240
    assert len(np.unique(seen["Gaussians"].reshape(-1, 3), axis=0)) > 20
    # A free camera stands still, so only the object flows, to the right: red on white.
    y, x = np.argwhere(red(seen["color"])).mean(0).astype(int)
    assert seen["flow"][y, x, 0] > seen["flow"][y, x, 2] + 50
    assert seen["flow"][5, 5].min() > 230
    names = list(seen)
    for k, a in enumerate(names):
        for b in names[k + 1 :]:
            assert np.abs(seen[a].astype(int) - seen[b]).mean() > 5, (a, b)


def test_parts(browser):
    browser.set("Part", "background")
    assert not red(browser.settled()).any()
    browser.set("Part", "objects")
    objects = browser.settled()
    assert red(objects).any()
    assert np.median(objects) < 10
    browser.set("Part", "objects:2")
    np.testing.assert_array_equal(browser.settled(), objects)


def test_objects_can_be_pushed_away(browser):
    """Behind the wall, from where the clip sees them; and back."""
    home = browser.settled()
    browser.set("Object 2", 1.5)
    assert np.abs(browser.settled().astype(int) - home).mean() < 1
    browser.set("Object 2", 2.0)
    assert not red(browser.settled()).any()
    browser.set("Paths of Gaussians", True)
    browser.wait(lambda: "/trails" in browser.nodes)
    browser.click("As trained")
    np.testing.assert_array_equal(browser.settled(), home)
    assert browser.value("Object 2") == 1


def test_cameras_and_ways_are_drawn_by_the_browser(browser):
    browser.set("Cameras", True)
    browser.wait(lambda: "/cameras/0" in browser.nodes and "/cameras/8" in browser.nodes)
    browser.set("Paths of Gaussians", True)
    browser.wait(lambda: "/trails" in browser.nodes)
    browser.settled()
    assert browser.depths[-1] is not None, "so that the scene hides what is behind it"


def test_the_wipe_looks_through_the_input_camera(run_folder, browser):
    browser.set("Seconds", 0.5)
    browser.set("Show", "alpha")
    browser.set("Input frame", "wipe")
    browser.wait(lambda: browser.value("Mode") == "input camera")
    image = browser.settled()
    frame = read_image(run_folder / "scene" / "heldout" / "frames" / "00004.png")
    left = image[:72, :40].astype(int)
    assert left.std() > 20, "the input frame"
    assert image[20:50, 60:90].mean() > 240, "the alpha of the rendering"
    assert abs(left.mean() - frame[:, :26].mean()) < 10
    browser.set("Mode", "orbit")
    browser.wait(lambda: browser.value("Input frame") == "off")


def test_the_input_frame_beside_the_rendering(browser):
    browser.set("Mode", "input camera")
    browser.set("Input frame", "beside")
    image = browser.settled().astype(int)
    # Two images of 48 x 36 in the middle, bars above and below.
    assert image[:15].max() < 40
    assert image[60:].max() < 40
    assert np.abs(image[20:52, 2:46] - image[20:52, 50:94]).mean() < 12


@pytest.mark.parametrize(("objects", "size"), [(0, (64, 48)), (1, (64, 48)), (1, (36, 64))])
def test_unusual_scenes(tmp_path, objects, size):
    """No object at all, a single one, and a portrait clip."""
    with viewed(tiny_run(tmp_path / "out", objects, size)) as browser:
        assert red(browser.settled()).any() == bool(objects)
        for part in ("background", "objects"):
            browser.set("Part", part)
            browser.set("Show", "Gaussians")
            browser.settled(0.4)
            browser.set("Show", "flow")
            browser.settled(0.4)
        browser.set("Show", "color")
        browser.set("Part", "all")
        browser.set("Paths of Gaussians", True)
        browser.wait(lambda: "/trails" in browser.nodes or any("No Gaussian" in note for note in browser.notes))
        browser.set("Mode", "input camera")
        image = browser.settled()
        assert image.shape[0] / image.shape[1] == pytest.approx(72 / 96, abs=0.02)
        bars = (np.abs(image[:, : image.shape[1] // 8].astype(int) - 20) < 6).all()
        assert bars == (size[0] < size[1]), "a portrait clip has bars beside it"
