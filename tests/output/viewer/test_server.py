"""The viewer as a server: its page, its clients, its scene's changes, its command and how it ends."""

from __future__ import annotations

import shutil
import signal
import socket
import subprocess
import sys
import urllib.request
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flowsplat.cli import main
from flowsplat.common.errors import InputError
from flowsplat.output.viewer.options import ViewOptions
from flowsplat.training.checkpoint import load_model, save_model
from tests.output.tiny import red, tiny_run

pytest.importorskip("viser", reason="viser is not installed: pip install 'flowsplat[view]'")

from flowsplat.output.viewer.server import Viewer
from tests.output.viewer.browser import Browser, free_port, heed_ctrl_c, place, viewed


def test_it_serves_a_page_and_an_image(port, browser):
    page = urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=20).read()
    assert b"<html" in page
    image = browser.settled()
    assert image.shape == (72, 96, 3)
    assert 20 < red(image).sum() < 500
    assert image[..., 2].mean() > image[..., 0].mean()
    assert any("tiny" in str(control.get("_markdown")) for control in browser.controls.values())


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


def test_a_newer_model_is_shown(tmp_path):
    folder = tiny_run(tmp_path / "out")
    with viewed(folder) as browser:
        assert red(browser.settled()).any()
        model = load_model(folder / "model")
        save_model(folder / "model", replace(model.part("background"), fill=True))
        browser.wait(lambda: not red(browser.images[-1]).any())
        browser.wait(lambda: any("441 Gaussians" in str(c.get("_markdown")) or "1,681" in str(c.get("_markdown"))
                                 for c in browser.controls.values()))  # fmt: skip


def test_the_first_scene_makes_room_for_the_trained_one(tmp_path):
    """What was set in the controls belonged to the first one; the new ones work."""
    folder = tmp_path / "out"
    tiny_run(folder / "coarse", size=(32, 24))
    (folder / "coarse" / "run.json").rename(folder / "run.json")
    other = tiny_run(tmp_path / "other")
    with viewed(folder) as browser:
        assert red(browser.settled()).any()
        assert any("a coarse scene" in str(c.get("_markdown")) for c in browser.controls.values())
        before = browser.controls["Seconds"]["uuid"]
        for name in ("scene", "model"):
            (other / name).rename(folder / name)
        browser.wait(lambda: browser.controls["Seconds"]["uuid"] != before)
        start = place(browser.settled())
        browser.set("Seconds", 1.0)
        browser.wait(lambda: place(browser.images[-1]) > start + 0.1)


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
