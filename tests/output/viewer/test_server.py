"""The viewer as browsers see it."""

from __future__ import annotations

import shlex
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flowsplat.cli import main
from flowsplat.common.errors import InputError
from flowsplat.geometry import Camera
from flowsplat.output.camera_files import read_camera_file, write_camera_file
from flowsplat.output.viewer.options import ViewOptions
from flowsplat.scenes.layers import read_image
from flowsplat.training.checkpoint import load_model, save_model
from tests.output.tiny import FPS, FRAMES, frames_of, red, tiny_run

pytest.importorskip("viser", reason="viser is not installed: pip install 'flowsplat[view]'")

from flowsplat.output.videos.amplitudes import SWING_ANGLES
from flowsplat.output.videos.plans import plan_videos
from flowsplat.output.viewer import export_panel
from flowsplat.output.viewer.browser_frame import SCENE_DEPTH
from flowsplat.output.viewer.server import Viewer
from tests.output.viewer.browser import Browser, free_port, heed_ctrl_c


@pytest.fixture(scope="module")
def port(run_folder) -> Iterator[int]:
    port = free_port()
    viewer = Viewer(run_folder, ViewOptions(port=port))
    yield port
    viewer.stop()


@pytest.fixture
def browser(port) -> Iterator[Browser]:
    with Browser(port) as browser:
        browser.settled()
        yield browser


def place(image: np.ndarray) -> float:
    """Column of the object, over the width."""
    return float(np.argwhere(red(image))[:, 1].mean() / image.shape[1])


def test_it_serves_a_page_and_an_image(port, browser):
    page = urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=20).read()
    assert b"<html" in page
    image = browser.settled()
    assert image.shape == (72, 96, 3)
    assert 20 < red(image).sum() < 500
    assert image[..., 2].mean() > image[..., 0].mean()
    assert any("tiny" in str(control.get("_markdown")) for control in browser.controls.values())


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


def test_two_clients_have_their_own_camera_and_time(port, browser):
    with Browser(port, (48, 72)) as other:
        other.set("Mode", "orbit")  # without the bars beside the clip's frame
        mine, theirs = browser.settled(), other.settled()
        assert mine.shape != theirs.shape
        other.set("Seconds", 1.0)
        other.set("Show", "alpha")
        changed = other.settled()
        assert changed.std() < 30
        assert changed.shape == theirs.shape
        np.testing.assert_array_equal(browser.settled(), mine)
        browser.click("Play")
        other.click("Play")
        counts = len(browser.images), len(other.images)
        browser.wait(lambda: len(browser.images) > counts[0] + 3 and len(other.images) > counts[1] + 3)
    count = len(browser.images)
    browser.wait(lambda: len(browser.images) > count + 3)
    browser.click("Play")


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


def told(browser: Browser, text: str) -> str | None:
    """What stands beside the controls and holds a text."""
    return next((c["_markdown"] for c in list(browser.controls.values()) if text in str(c.get("_markdown"))), None)


def test_a_box_crops_what_is_seen_and_taken_away(tmp_path, capsys):
    """Images, screenshots and recordings alike, and the command that is shown exports the same."""
    port, folder = free_port(), tiny_run(tmp_path / "out")
    viewer = Viewer(folder, ViewOptions(port=port))
    try:
        with Browser(port) as browser:
            home = browser.settled()
            ends = [browser.value(f"{axis} {end}") for end in ("from", "to") for axis in "xyz"]
            browser.set("x from", 0.5)
            np.testing.assert_array_equal(browser.settled(), home)
            assert "/crop" not in browser.nodes, "it is off until it is asked for"
            browser.set("Crop to a box", True)
            browser.wait(lambda: browser.images[-1][:, :40].max() < 10)
            cropped = browser.settled()
            assert "/crop" in browser.nodes
            assert browser.depths[-1] is not None, "so that the scene hides what of the box is behind it"
            assert cropped[:, 70:].mean() > 50
            line = browser.wait(lambda: told(browser, "flowsplat export"))
            command = shlex.split(line.split("`")[1])
            box = command[-1].removeprefix("--crop=")
            assert box.startswith("0.5,")

            browser.click("Screenshot")
            image = folder / "viewer" / "screenshot_001.png"
            browser.wait(image.exists)
            np.testing.assert_array_equal(read_image(image)[:, :40], 0)
            browser.click("Add a key here")
            browser.click("Record it")
            film = folder / "viewer" / "recording_001.mp4"
            browser.wait(lambda: browser.downloads.get(film.name))
            assert frames_of(film)[0][:, :24].max() < 16
            browser.click("Save the path")
            browser.wait(lambda: any("draws all of the scene" in note for note in browser.notes))

            main([*command[1:4], "npz", "-o", str(tmp_path / "scene.npz"), command[-1]])
            with np.load(tmp_path / "scene.npz") as exported:
                assert f"{len(exported['dynamic']):,} of " in line

            browser.set("z from", float(ends[5]))
            browser.wait(lambda: not browser.settled()[:, 70:].any())
            assert told(browser, "0 of "), "a box of one step at the far end holds nothing"
            browser.click("Reset the box")
            browser.wait(lambda: [browser.value(f"{axis} {end}") for end in ("from", "to") for axis in "xyz"] == ends)
            browser.set("Crop to a box", False)
            browser.wait(lambda: np.array_equal(browser.settled(), home))
            assert told(browser, "flowsplat export") is None

            # A slider may be drawn past the other one.
            browser.set("x from", 1.0)
            browser.set("x to", 0.5)
            browser.set("Crop to a box", True)
            browser.wait(lambda: (shown := told(browser, "--crop=")) and "--crop=0.5," in shown and ",1," in shown)
            browser.set("x to", 1e6)
            browser.wait(lambda: any("x to cannot be" in note for note in browser.notes))
            browser.set("x to", "nan")
            browser.wait(lambda: any("x to cannot be nan" in note for note in browser.notes))
            assert browser.settled().shape == home.shape
    finally:
        viewer.stop()
    capsys.readouterr()


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
    browser.set("Look farther", True)
    browser.wait(lambda: browser.value("Mode") == "orbit" and browser.value("Only what the clip tells"))
    browser.look(position=there + [2.0, 0, 0])
    browser.settled()
    np.testing.assert_allclose(browser.position, there + [2.0, 0, 0], atol=1e-6)
    browser.set("Look farther", False)
    browser.wait(lambda: browser.value("Mode") == "input camera" and not browser.value("Only what the clip tells"))
    browser.wait(lambda: np.abs(browser.position - there).max() < 1e-3)
    np.testing.assert_array_equal(browser.settled(), home)
    browser.set("Mode", "fly")
    browser.wait(lambda: browser.value("Look farther"))


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
    port, folder = free_port(), tiny_run(tmp_path / "out")
    viewer = Viewer(folder, ViewOptions(port=port))
    try:
        with Browser(port) as browser:
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
    finally:
        viewer.stop()


def test_cameras_and_ways_are_drawn_by_the_browser(browser):
    browser.set("Cameras", True)
    browser.wait(lambda: "/cameras/0" in browser.nodes and "/cameras/8" in browser.nodes)
    browser.set("Paths of Gaussians", True)
    browser.wait(lambda: "/trails" in browser.nodes)
    browser.settled()
    assert browser.depths[-1] is not None, "so that the scene hides what is behind it"


def test_paths_are_made_saved_loaded_and_recorded(run_folder, browser, tmp_path):
    browser.set("Mode", "orbit")
    browser.click("Save the path")
    browser.wait(lambda: any("no keys" in note for note in browser.notes))
    browser.click("Add a key here")
    browser.wait(lambda: any("1 key," in str(control.get("_markdown")) for control in browser.controls.values()))
    browser.set("Seconds", 1.0)
    browser.look(position=browser.position + [0.4, 0, 0], look_at=np.array([0.4, 0, SCENE_DEPTH]))
    browser.settled()
    browser.click("Add a key here")
    browser.wait(lambda: any("2 keys" in str(control.get("_markdown")) for control in browser.controls.values()))
    browser.click("Save the path")
    path = run_folder / "viewer" / "path_001.json"
    browser.wait(path.exists)
    saved = read_camera_file(path, (1, 1), (0.0, 1.0))
    assert saved.fps == FPS
    assert [t for _, t in saved.shots] == pytest.approx(np.linspace(0, 1, 9))
    assert saved.shots[-1][0].center[0] - saved.shots[0][0].center[0] == pytest.approx(0.4, abs=0.02)
    browser.wait(lambda: len(browser.downloads.get("path_001.json", b"")) == path.stat().st_size)

    browser.click("Record it")
    film = run_folder / "viewer" / "recording_001.mp4"
    browser.wait(film.exists)
    frames = frames_of(film)
    assert (len(frames), frames[0].shape) == (9, (48, 64, 3))
    assert red(frames[0]).any()
    browser.wait(lambda: browser.downloads.get(film.name) == film.read_bytes())

    browser.click("Screenshot")
    image = run_folder / "viewer" / "screenshot_001.png"
    browser.wait(image.exists)
    assert read_image(image).shape == (72, 96, 3)

    camera = Camera(np.eye(4), np.array([[64.0, 0, 32], [0, 64, 24], [0, 0, 1]]), 64, 48)
    write_camera_file(tmp_path / "mine.json", [(camera, 0.25)] * 3, fps=4)
    browser.upload("Load a path", "mine.json", (tmp_path / "mine.json").read_bytes())
    browser.wait(lambda: any("3 keys, 0.5 s" in str(control.get("_markdown")) for control in browser.controls.values()))
    count = len(browser.images)
    browser.click("Play the path")
    browser.wait(lambda: len(browser.images) > count)
    browser.upload("Load a path", "bad.json", b"{}")
    browser.wait(lambda: any("no list" in note for note in browser.notes))
    browser.settled()


def test_ready_made_paths_are_taken_and_recorded(tmp_path):
    port, folder = free_port(), tiny_run(tmp_path / "out", objects=3)
    viewer = Viewer(folder, ViewOptions(port=port))
    try:
        with Browser(port) as browser:
            browser.settled()
            for name, says in (
                ("stabilized", "9 keys, 1.0 s"), ("bullet", "120 keys"), ("dolly", "120 keys"), ("wiggle", "16 keys, 1.2 s"),
            ):  # fmt: skip
                browser.set("Ready-made path", name)
                browser.click("Take this path")
                browser.wait(lambda says=says: any(says in str(c.get("_markdown")) for c in browser.controls.values()))
            browser.set("Record as", ".gif")
            browser.click("Record it")
            gif = folder / "viewer" / "recording_001.gif"
            browser.wait(gif.exists)
            places = [np.argwhere(red(frame))[:, 1].mean() for frame in frames_of(gif)]
            assert len(places) == 16
            assert np.ptp(places) < 1.0, "it swings round the object"

            browser.set("Speed", "1/2")
            browser.set("Ready-made path", "input")
            browser.click("Take this path")
            browser.wait(lambda: any("17 keys, 2.0 s" in str(c.get("_markdown")) for c in browser.controls.values()))
            browser.set("Record as", ".webm")
            browser.click("Record it")
            browser.wait((folder / "viewer" / "recording_001.webm").exists)

            browser.set("Stereo pair", True)
            browser.set("Record as", ".mp4")
            browser.click("Record it")
            browser.wait((folder / "viewer" / "recording_001.mp4").exists)
            frame, *_ = frames_of(folder / "viewer" / "recording_001.mp4")
            assert frame.shape == (48, 2 * 64, 3)
            left, right = (np.argwhere(red(eye))[:, 1].mean() for eye in (frame[:, :64], frame[:, 64:]))
            assert 0.2 < left - right < 4, "near things lie further right for the left eye"
    finally:
        viewer.stop()


def test_a_recording_waits_for_the_path_and_has_the_size_and_rate_that_were_chosen(tmp_path, monkeypatch):
    port, folder = free_port(), tiny_run(tmp_path / "out", objects=3)
    asked = threading.Event()

    def plan_when_all_was_asked(*arguments):
        assert asked.wait(20)
        return plan_videos(*arguments)

    monkeypatch.setattr(export_panel, "plan_videos", plan_when_all_was_asked)
    viewer = Viewer(folder, ViewOptions(port=port))
    try:
        with Browser(port) as browser:
            browser.settled()
            browser.click("Add a key here")
            browser.set("Ready-made path", "wiggle")
            browser.set("Size", "480p")
            browser.set("Frames a second", "25")
            browser.click("Take this path")
            browser.wait(lambda: any("Working it out" in str(c.get("_markdown")) for c in browser.controls.values()))
            browser.click("Record it")
            browser.click("Save the path")
            time.sleep(0.3)
            assert not (folder / "viewer").exists()
            asked.set()
            film, path = folder / "viewer" / "recording_001.mp4", folder / "viewer" / "path_001.json"
            browser.wait(film.exists)
            browser.wait(path.exists)
            frames = frames_of(film)
            assert (len(frames), frames[0].shape) == (31, (480, 640, 3)), "the wiggle's 1.2 s, not the one key of before"
            browser.wait(lambda: browser.downloads.get(film.name) == film.read_bytes())
    finally:
        asked.set()
        viewer.stop()


def test_objects_of_a_scene_without_any_are_not_recorded(tmp_path):
    port, folder = free_port(), tiny_run(tmp_path / "out", objects=0)
    viewer = Viewer(folder, ViewOptions(port=port))
    try:
        with Browser(port) as browser:
            browser.click("Add a key here")
            browser.set("Record as", ".webm")
            browser.click("Record it")
            browser.wait(lambda: any("Nothing moves" in note for note in browser.notes))
    finally:
        viewer.stop()
    assert not (folder / "viewer").exists()


@pytest.mark.parametrize(("objects", "size"), [(0, (64, 48)), (1, (64, 48)), (1, (36, 64))])
def test_unusual_scenes(tmp_path, objects, size):
    """No object at all, a single one, and a portrait clip."""
    port = free_port()
    viewer = Viewer(tiny_run(tmp_path / "out", objects, size), ViewOptions(port=port))
    try:
        with Browser(port) as browser:
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
    finally:
        viewer.stop()


def test_a_newer_model_is_shown(tmp_path):
    folder, port = tiny_run(tmp_path / "out"), free_port()
    viewer = Viewer(folder, ViewOptions(port=port))
    try:
        with Browser(port) as browser:
            assert red(browser.settled()).any()
            model = load_model(folder / "model")
            save_model(folder / "model", replace(model.part("background"), fill=True))
            browser.wait(lambda: not red(browser.images[-1]).any())
            browser.wait(lambda: any("441 Gaussians" in str(c.get("_markdown")) or "1,681" in str(c.get("_markdown"))
                                     for c in browser.controls.values()))  # fmt: skip
    finally:
        viewer.stop()


def test_the_first_scene_makes_room_for_the_trained_one(tmp_path):
    """What was set in the controls belonged to the first one; the new ones work."""
    folder, port = tmp_path / "out", free_port()
    tiny_run(folder / "coarse", size=(32, 24))
    (folder / "coarse" / "run.json").rename(folder / "run.json")
    other = tiny_run(tmp_path / "other")
    viewer = Viewer(folder, ViewOptions(port=port))
    try:
        with Browser(port) as browser:
            assert red(browser.settled()).any()
            assert any("a coarse scene" in str(c.get("_markdown")) for c in browser.controls.values())
            before = browser.controls["Seconds"]["uuid"]
            for name in ("scene", "model"):
                (other / name).rename(folder / name)
            browser.wait(lambda: browser.controls["Seconds"]["uuid"] != before)
            start = place(browser.settled())
            browser.set("Seconds", 1.0)
            browser.wait(lambda: place(browser.images[-1]) > start + 0.1)
    finally:
        viewer.stop()


def test_ctrl_c_stops_it_and_the_port_is_free_again(run_folder):
    port = free_port()
    command = [sys.executable, "-m", "flowsplat.cli", "view", str(run_folder), "--port", str(port), "--device", "cpu"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, preexec_fn=heed_ctrl_c)
    try:
        assert process.stderr is not None
        line = process.stderr.readline()
        assert f"http://localhost:{port}" in line
        with Browser(port) as browser:
            browser.wait(lambda: browser.images)
            process.send_signal(signal.SIGINT)
            out, error = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 0, error
    assert "Traceback" not in error + out
    assert out == ""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind(("127.0.0.1", port))


def failing(capsys, *arguments: object) -> str:
    """The one line with which a command ends that cannot work."""
    with pytest.raises(SystemExit) as end:
        main(["view", *map(str, arguments), "--device", "cpu"])
    assert end.value.code == 2
    message = capsys.readouterr().err.strip()
    assert message.startswith("Error: ")
    assert "\n" not in message
    return message


def test_a_port_in_use_is_told(run_folder, capsys):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert f"Port {port} is in use" in failing(capsys, run_folder, "--port", port)


def test_a_run_that_cannot_be_written_to_can_be_looked_at(tmp_path):
    port, folder = free_port(), tiny_run(tmp_path / "out")
    (folder / "viewer").write_text("a file where the folder should be")
    viewer = Viewer(folder, ViewOptions(port=port))
    try:
        with Browser(port) as browser:
            browser.settled()
            browser.click("Add a key here")
            for label in ("Screenshot", "Save the path", "Record it"):
                told = len(browser.notes)
                browser.click(label)
                browser.wait(lambda told=told: "viewer" in "".join(browser.notes[told:]))
                assert "did not work" in browser.notes[-1]
            count = len(browser.images)
            browser.set("Seconds", 1.0)
            browser.wait(lambda: len(browser.images) > count)
    finally:
        viewer.stop()


@pytest.mark.parametrize(
    ("options", "says"),
    [({"port": 0}, "port 0"), ({"host": "203.0.113.9", "port": 8099}, "Cannot listen"), ({"largest": 2}, "2 pixels")],
)
def test_bad_options(run_folder, options, says):
    with pytest.raises(InputError, match=says):
        Viewer(run_folder, ViewOptions(**options))


def test_a_missing_viser_is_told(run_folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match=r"pip install -e '\.\[view\]'"):
        Viewer(run_folder, ViewOptions(port=free_port()))


def test_the_command_ends_with_one_line_and_exit_code_2(tmp_path, capsys):
    assert "neither a trained scene" in failing(capsys, tiny_run(tmp_path / "out", trained=False))


def test_runs_with_nothing_to_show_are_told(tmp_path):
    with pytest.raises(InputError, match="not the folder of a run"):
        Viewer(tmp_path, ViewOptions(port=free_port()))
    folder: Path = tiny_run(tmp_path / "out", trained=False)
    with pytest.raises(InputError, match="neither a trained scene nor a checkpoint"):
        Viewer(folder, ViewOptions(port=free_port()))
    shutil.rmtree(folder / "scene")
    with pytest.raises(InputError, match="not prepared"):
        Viewer(folder, ViewOptions(port=free_port()))
