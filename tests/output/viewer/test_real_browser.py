"""The viewer in a real browser: it starts, serves two at once, moves in time and stops, without errors or warnings."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numpy as np
import pytest

from tests.browser import Complaints
from tests.output.tiny import red
from tests.output.viewer.browser import free_port, heed_ctrl_c

pytest.importorskip("viser", reason="viser is not installed: pip install 'flowsplat[view]'")

SIZE = {"width": 640, "height": 400}
PATIENCE = 60_000
"""Milliseconds: kernels may have to be compiled."""


def shown(page: Any) -> np.ndarray:
    """[H, W, 3] what stands in the window left of the controls."""
    image = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    return image[:, : SIZE["width"] // 2]


def place(page: Any) -> float:
    """Column of the object, in pixels; NaN while it is not seen."""
    found = np.argwhere(red(shown(page)))
    return float(found[:, 1].mean()) if len(found) > 10 else float("nan")


def wait(page: Any, what: Callable[[], bool]) -> None:
    for _ in range(PATIENCE // 250):
        if what():
            return
        page.wait_for_timeout(250)
    raise AssertionError("waited in vain")


def place_at_rest(page: Any) -> float:
    """Where the object is once it is seen and stays: the first images are drawn before the browser knows its camera."""
    last = [float("nan")] * 12  # under load a browser may be without its camera for long

    def rests() -> bool:
        last[:] = [*last[1:], place(page)]
        return bool(np.ptp(last) < 1)  # not for NaN

    wait(page, rests)
    return last[-1]


@pytest.fixture
def served(run_folder) -> Iterator[tuple[int, subprocess.Popen[str]]]:
    """The port that the command serves the run on, and its process."""
    port = free_port()
    command = [sys.executable, "-m", "flowsplat.cli", "view", str(run_folder), "--port", str(port), "--device", "cpu"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, preexec_fn=heed_ctrl_c)
    try:
        assert process.stderr is not None
        assert str(port) in process.stderr.readline()
        yield port, process
    finally:
        process.kill()


@pytest.mark.slow
def test_a_view_holds_near_the_input_camera_and_a_box_crops_it(chromium, served):
    port, _ = served
    context = chromium.new_context(viewport=SIZE)
    page = context.new_page()
    errors = Complaints(page, ("error",))
    try:
        page.goto(f"http://localhost:{port}", timeout=PATIENCE)
        start = place_at_rest(page)
        page.mouse.move(60, 330)
        page.mouse.down()
        for k in range(20):
            page.mouse.move(60 + 10 * k, 330)
            page.wait_for_timeout(50)
        wait(page, lambda: abs(place(page) - start) > 4)
        page.mouse.up()
        aside = place_at_rest(page)
        assert 4 < abs(aside - start) < 25, "three degrees, however far it is dragged"
        page.mouse.dblclick(60, 330)
        wait(page, lambda: abs(place(page) - start) < 1)
        assert place_at_rest(page) == pytest.approx(start, abs=1), "where it began"

        page.get_by_text("Crop", exact=True).click()
        page.get_by_text("Crop to a box").click()
        wait(page, lambda: page.get_by_text("--crop=").count() > 0)
        assert red(shown(page)).any()
        behind_the_object = page.locator("input.mantine-NumberInput-input").nth(-3)
        behind_the_object.fill("3")
        behind_the_object.press("Enter")
        wait(page, lambda: not red(shown(page)[160:]).any())
        assert shown(page)[200:300, 100:200].mean() > 50, "the wall is there"
        assert errors == []
    finally:
        context.close()


@pytest.mark.slow
def test_two_browsers_move_in_time_and_it_stops(chromium, served):
    port, process = served
    contexts = [chromium.new_context(viewport=SIZE) for _ in range(2)]
    first, second = pages = [context.new_page() for context in contexts]
    errors = [Complaints(page, ("error",)) for page in pages]
    try:
        for page in pages:
            page.goto(f"http://localhost:{port}", timeout=PATIENCE)
        starts = [place_at_rest(page) for page in pages]

        seconds = first.locator("input.mantine-NumberInput-input").first
        seconds.fill("1")
        seconds.press("Enter")
        wait(first, lambda: place(first) > starts[0] + 20)
        assert place(second) == pytest.approx(starts[1], abs=1), "the other one has a time of its own"

        first.get_by_text("Distance of objects").click()
        distance = first.locator("input.mantine-NumberInput-input").nth(-8)  # the last is of the export, six are of the crop box
        distance.fill("2")
        distance.press("Enter")
        below_notes = slice(160, None)
        assert red(shown(second)[below_notes]).any()
        wait(first, lambda: not red(shown(first)[below_notes]).any())  # behind the wall
        assert place(second) == pytest.approx(starts[1], abs=1), "and distances of its own"

        second.get_by_role("button", name="Play", exact=True).click()
        wait(second, lambda: place(second) > starts[1] + 20)
        second.get_by_role("button", name="Pause", exact=True).click()
        assert errors == [[], []]
    finally:
        for context in contexts:
            context.close()
    process.send_signal(signal.SIGINT)
    out, error = process.communicate(timeout=60)
    assert process.returncode == 0, error
    assert out == ""
    assert error.strip() == "The viewer is stopped."
