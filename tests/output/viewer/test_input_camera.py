"""Where a browser looks from: through the clip's camera, past it, and away from it."""

from __future__ import annotations

import time

import numpy as np
import pytest

from flowsplat.output.camera_files import read_camera_file
from flowsplat.scenes.layers import read_image
from tests.output.tiny import tiny_run

pytest.importorskip("viser", reason="viser is not installed: pip install 'flowsplat[view]'")

from flowsplat.output.videos.amplitudes import SWING_ANGLES
from flowsplat.output.viewer.browser_frame import SCENE_DEPTH
from tests.output.viewer.browser import place, viewed


def test_the_camera_can_be_moved(browser):
    browser.set("Mode", "orbit")
    before = browser.settled()
    browser.look(position=browser.position + [0.8, 0, 0], look_at=np.array([0.8, 0, SCENE_DEPTH]))
    after = browser.settled()
    assert place(after) < place(before) - 0.05


def test_orbit_turns_round_the_scene_and_fly_in_place(browser):
    browser.set("Mode", "orbit")
    assert browser.reach == pytest.approx(SCENE_DEPTH, rel=1e-3)
    where = browser.position
    browser.set("Mode", "fly")
    browser.wait(lambda: browser.reach < 0.1)
    browser.set("Mode", "orbit")
    browser.wait(lambda: browser.reach > 3)
    np.testing.assert_allclose(browser.position, where, atol=1e-6)
    browser.look(position=where + [2.0, 1.0, 0.0])
    browser.settled(0.4)
    browser.click("To the input camera")
    browser.wait(lambda: np.abs(browser.position - where).max() < 1e-3)


def test_the_input_camera_follows_the_clip(browser):
    browser.set("Mode", "input camera")
    browser.settled()
    start = browser.position
    browser.set("Seconds", 1.0)
    browser.wait(lambda: browser.position[0] > start[0] + 0.2)
    there = browser.position
    home = browser.settled()
    browser.look(position=there + [2.0, 0, 0])
    reach = np.radians(min(SWING_ANGLES)) * SCENE_DEPTH
    browser.wait(lambda: 0.5 * reach < np.linalg.norm(browser.position - there) < 1.01 * reach)
    assert (browser.settled() != home).any(), "it can be looked past, as far as every loop goes"
    browser.double_click(0.5, 0.5)
    browser.wait(lambda: np.abs(browser.position - there).max() < 1e-3)
    browser.look(position=there + [2.0, 0, 0])
    browser.wait(lambda: np.linalg.norm(browser.position - there) > 0.5 * reach)
    browser.click("To the input camera")
    browser.wait(lambda: np.abs(browser.position - there).max() < 1e-3)
    np.testing.assert_array_equal(browser.settled(), home)


@pytest.mark.parametrize("back_by", ["Look farther", "Mode"])
def test_who_looks_farther_has_no_guesses_until_they_are_back(browser, back_by):
    home, there = browser.settled(), browser.position
    browser.set("Look farther", True)
    browser.wait(lambda: browser.value("Mode") == "orbit" and browser.value("Only what the clip tells"))
    browser.look(position=there + [2.0, 0, 0])
    browser.settled()
    np.testing.assert_allclose(browser.position, there + [2.0, 0, 0], atol=1e-6)
    browser.set(back_by, {"Look farther": False, "Mode": "input camera"}[back_by])
    browser.wait(lambda: browser.value("Mode") == "input camera" and not browser.value("Look farther"))
    browser.wait(lambda: not browser.value("Only what the clip tells"))
    browser.wait(lambda: np.abs(browser.position - there).max() < 1e-3)
    np.testing.assert_array_equal(browser.settled(), home)


def test_another_mode_looks_farther_with_all_that_was_shown(browser):
    there = browser.position
    for mode in ("fly", "orbit"):
        browser.set("Mode", mode)
        browser.wait(lambda: browser.value("Look farther"))
    assert not browser.value("Only what the clip tells")
    browser.set("Only what the clip tells", True)
    browser.set("Look farther", False)
    browser.wait(lambda: browser.value("Mode") == "input camera" and np.abs(browser.position - there).max() < 1e-3)
    assert browser.value("Only what the clip tells"), "as it was set"


def test_a_pull_beyond_the_reach_is_resisted_and_springs_back(browser):
    """Nothing moves the browser's camera while a hand does; then it stands where the image is seen from."""
    home, there = browser.settled(), browser.position
    reach = np.radians(min(SWING_ANGLES)) * SCENE_DEPTH
    count = len(browser.images)
    pulled = there + [2.0, 0, 0]
    for _ in range(20):
        browser.look(position=pulled)
        time.sleep(0.05)
        np.testing.assert_array_equal(browser.position, pulled)
    assert len(browser.images) > count
    beyond = browser.images[-1]
    browser.wait(lambda: np.linalg.norm(browser.position - there) < 1.001 * reach)
    back = browser.settled()
    assert np.linalg.norm(browser.position - there) == pytest.approx(reach, rel=0.01)
    assert browser.position[0] > there[0]
    assert place(home) - place(beyond) > 1.1 * (place(home) - place(back)) > 0.01, "it was seen from farther aside"


def test_what_is_taken_away_is_seen_from_where_it_was_pulled_aside(tmp_path):
    folder = tiny_run(tmp_path / "out")
    with viewed(folder) as browser:
        home, there = browser.settled(), browser.position
        browser.look(position=there + [0.2, 0, 0])
        aside = browser.settled()
        assert place(home) - place(aside) > 0.02
        browser.click("Screenshot")
        image = folder / "viewer" / "screenshot_001.png"
        browser.wait(lambda: browser.downloads.get(image.name))
        assert place(read_image(image)) == pytest.approx(place(aside), abs=0.005)
        browser.click("Add a key here")
        browser.click("Save the path")
        path = folder / "viewer" / "path_001.json"
        browser.wait(lambda: browser.downloads.get(path.name))
        camera = read_camera_file(path, (64, 48), (0.0, 1.0)).shots[0][0]
        assert camera.center[0] == pytest.approx(0.2, rel=0.05)
