"""Paths, recordings, screenshots and cropped scenes that a browser takes away."""

from __future__ import annotations

import shlex
import threading
import time

import numpy as np
import pytest

from flowsplat.cli import main
from flowsplat.geometry import Camera
from flowsplat.output.camera_files import read_camera_file, write_camera_file
from flowsplat.scenes.layers import read_image
from tests.output.tiny import FPS, frames_of, red, tiny_run

pytest.importorskip("viser", reason="viser is not installed: pip install 'flowsplat[view]'")

from flowsplat.output.videos.plans import plan_videos
from flowsplat.output.viewer import export_panel
from flowsplat.output.viewer.browser_frame import SCENE_DEPTH
from tests.output.viewer.browser import Browser, viewed


def told(browser: Browser, text: str) -> str | None:
    """What stands beside the controls and holds a text."""
    return next((c["_markdown"] for c in list(browser.controls.values()) if text in str(c.get("_markdown"))), None)


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
    folder = tiny_run(tmp_path / "out", objects=3)
    with viewed(folder) as browser:
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


def test_a_recording_waits_for_the_path_and_has_the_size_and_rate_that_were_chosen(tmp_path, monkeypatch):
    folder = tiny_run(tmp_path / "out", objects=3)
    asked = threading.Event()

    def plan_when_all_was_asked(*arguments):
        assert asked.wait(20)
        return plan_videos(*arguments)

    monkeypatch.setattr(export_panel, "plan_videos", plan_when_all_was_asked)
    with viewed(folder) as browser:
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


def test_objects_of_a_scene_without_any_are_not_recorded(tmp_path):
    folder = tiny_run(tmp_path / "out", objects=0)
    with viewed(folder) as browser:
        browser.click("Add a key here")
        browser.set("Record as", ".webm")
        browser.click("Record it")
        browser.wait(lambda: any("Nothing moves" in note for note in browser.notes))
    assert not (folder / "viewer").exists()


def test_a_box_crops_what_is_seen_and_taken_away(tmp_path, capsys):
    """Images, screenshots and recordings alike, and the command that is shown exports the same."""
    folder = tiny_run(tmp_path / "out")
    with viewed(folder) as browser:
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
    capsys.readouterr()


def test_a_run_that_cannot_be_written_to_can_be_looked_at(tmp_path):
    folder = tiny_run(tmp_path / "out")
    (folder / "viewer").write_text("a file where the folder should be")
    with viewed(folder) as browser:
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
