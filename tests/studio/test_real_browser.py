"""The studio in a real browser, with real runs: from an empty page to a scene that plays, and that was downloaded."""

from __future__ import annotations

import contextlib
import json
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from flowsplat.common.process_control import read_start_time
from tests.browser import Complaints
from tests.output.viewer.browser import free_port, heed_ctrl_c
from tests.studio.serving import SIZE, serve, write_clip_with_cut
from tests.studio.test_shots import write_shots

OPTIONS = "--train.iterations 20 --render.paths input --no-refine-poses --render.width 64"
"""A scene of a minute: that it is good is no matter here."""
PATIENCE = 420_000
"""Milliseconds for a whole run: kernels may have to be compiled."""
COOKIE = "(() => { try { return document.cookie; } catch (error) { return error.name; } })()"
DESKTOP, PHONE = {"width": 1100, "height": 900}, {"width": 390, "height": 844}


class Command:
    """``flowsplat studio`` as one types it, and again."""

    def __init__(self, folder: Path):
        self._words = [
            sys.executable, "-m", "flowsplat.cli", "studio", str(folder), "--port", str(free_port()), "--no-open-browser",
            f"--run-options={OPTIONS}",
        ]  # fmt: skip
        self._process: subprocess.Popen[str] | None = None

    def start(self) -> str:
        """The address that it prints."""
        self._process = subprocess.Popen(self._words, stderr=subprocess.PIPE, text=True, preexec_fn=heed_ctrl_c)
        assert self._process.stderr is not None
        for line in self._process.stderr:
            if found := re.search(r"http://\S+", line):
                return found[0]
        raise AssertionError("it printed no address")

    def stop(self) -> None:
        """As Ctrl-C."""
        if self._process is not None:
            self._process.send_signal(signal.SIGINT)
            assert self._process.wait(30) == 130 or self._process.returncode == 0
            self._process = None


@contextlib.contextmanager
def opened(command: Command, chromium: Any, size: dict[str, int], touch: bool = False) -> Iterator[Any]:
    address = command.start()
    context = chromium.new_context(viewport=size, accept_downloads=True, has_touch=touch)
    try:
        page = context.new_page()
        page.goto(address)
        yield page
    finally:
        context.close()
        command.stop()


def wait(page: Any, what: Callable[[], Any], milliseconds: int = 60_000) -> Any:
    for _ in range(milliseconds // 250):
        if found := what():
            return found
        page.wait_for_timeout(250)
    raise AssertionError(f"waited in vain; the page says: {page.locator('main:visible').inner_text()}")


def is_lit(place: Any) -> bool:
    """Whether an element shows more than one color."""
    image = cv2.imdecode(np.frombuffer(place.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    return float(image.std()) > 10


def plays(page: Any, frame: Any) -> bool:
    """Whether the scene of a frame is drawn and moves on."""
    wait(page, lambda: frame.evaluate("document.body.className") == "shown")
    before = frame.evaluate("flowsplat.state.time")
    wait(page, lambda: frame.evaluate("flowsplat.state.time") != before)
    return is_lit(frame.locator("canvas"))


def click(page: Any, x: float, y: float) -> None:
    """On the frame, at shares of its width and height."""
    box = page.locator("#frame").bounding_box()
    page.locator("#frame").click(position={"x": x * box["width"], "y": y * box["height"]})


def offer(page: Any, clip: Path) -> None:
    """Choose a clip, and wait until its frames can be clicked on."""
    page.set_input_files("#file", clip)
    page.wait_for_selector("#presets input")
    wait(page, lambda: page.evaluate("document.getElementById('frame').naturalWidth > 0"))


@pytest.mark.slow
@pytest.mark.parametrize("is_interrupted", [False, True], ids=["at once", "with a server that is started anew"])
def test_from_an_empty_page_to_a_scene(chromium, tmp_path, clip, is_interrupted):
    studio, command = tmp_path / "studio", Command(tmp_path / "studio")
    with opened(command, chromium, DESKTOP) as page:
        complaints = Complaints(page, ("error",))
        assert page.locator("#drop").is_visible()
        assert not page.locator("#earlier").is_visible()
        offer(page, clip)
        click(page, 32 / SIZE[0], 52 / SIZE[1])
        page.wait_for_selector("#mask:not([hidden])")
        shown = page.locator("#command").text_content()
        place = re.search(r"--mask-click ([\d.]+),([\d.]+)@0$", shown)
        assert [float(value) for value in place.groups()] == pytest.approx([32 / SIZE[0], 52 / SIZE[1]], abs=0.005)
        page.click("#run")
        page.wait_for_selector("#progress:not([hidden])")
        (project,) = (path.parent for path in studio.glob("*/studio.json"))
        if is_interrupted:
            wait(page, lambda: "Following points" in (project / "run.log").read_text())
            task = json.loads((project / "studio.json").read_text())["task"]
            command.stop()
            page.wait_for_selector("#offline:not([hidden])")
            assert read_start_time(task["process"]) == task["begun"], "it goes on"
            command.start()
            wait(page, lambda: not page.locator("#offline").is_visible())
            complaints.clear()  # of the time without a server
        page.wait_for_selector("#player-place iframe", timeout=PATIENCE)
        assert (project / "run.log").read_text().splitlines()[0] == f"$ {shown}"
        frame = wait(page, lambda: next((each for each in page.frames if "/export/" in each.url), None))
        assert plays(page, frame)
        assert frame.evaluate("origin") == "null", "it reaches nothing of the studio"
        assert frame.evaluate(COOKIE) == "SecurityError"
        with page.expect_download() as download:
            page.click("text=Download it")
        saved = tmp_path / "mine.html"
        download.value.save_as(saved)
        assert saved.read_bytes() == (project / "run" / "export" / "player.html").read_bytes()
        assert complaints == []
        alone = page.context.new_page()
        alone.goto(saved.as_uri())
        assert plays(alone, alone.main_frame)
        alone.goto(f"{page.url.partition('/?')[0]}{page.locator('text=How good is it?').get_attribute('href')}")
        assert alone.locator("h1").text_content() == "walk"
        alone.close()
        page.click("#videos-box summary")
        video = page.locator("#videos video").first
        wait(page, lambda: video.evaluate("each => each.readyState >= 2"))
        page.click("text=All scenes")
        page.wait_for_selector("#list a")
        assert wait(page, lambda: page.locator("#list img").first.evaluate("each => each.naturalWidth")) > 0
        page.click("#list a")
        page.wait_for_selector("#player-place iframe")
        page.click("#delete")
        page.click("#really")
        wait(page, lambda: not page.locator("#list a").count())
        assert not project.exists()
        assert complaints == []


@pytest.mark.slow
def test_clicks_are_merged_split_moved_and_taken_away(chromium, tmp_path, clip):
    """On a phone, too; and a reload shows the same again."""
    with opened(Command(tmp_path / "studio"), chromium, PHONE, touch=True) as page:
        complaints = Complaints(page, ("error",))
        offer(page, clip)
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), "nothing sticks out"
        click(page, 0.25, 0.5)
        page.click("[data-tool=new]")
        click(page, 0.3, 0.6)
        page.wait_for_selector("text=Object 2: 1 click")
        page.click("text=Same as object 1")
        page.wait_for_selector("text=Object 1: 2 clicks")
        page.locator("#marks button").nth(1).click()
        page.click("text=Make it an object of its own")
        page.wait_for_selector("text=Object 2: 1 click")
        page.locator("#marks button").nth(1).click()
        page.click("#selected >> text=Give it to object 1")
        page.wait_for_selector("text=Object 1: 2 clicks")
        page.click("[data-tool=away]")
        click(page, 0.8, 0.2)
        page.click("[data-tool=ground]")
        click(page, 0.25, 0.66)
        page.wait_for_selector("text=Touches the ground at 0.00 s")
        command = wait(page, lambda: (text := page.locator("#command").text_content()) and "--contact" in text and text)
        places = re.findall(r"--(mask-click|mask-negative|contact) ([\d.]+),([\d.]+)@0(=1)?(?= |$)", command)
        assert [(kind, number) for kind, _, _, number in places] == [
            ("mask-click", ""), ("mask-click", "=1"), ("mask-negative", "=1"), ("contact", ""),
        ]  # fmt: skip
        assert [float(x) for _, x, _, _ in places] == pytest.approx([0.25, 0.3, 0.8, 0.25], abs=0.01)
        page.reload()
        page.wait_for_selector("text=Object 1: 2 clicks")
        assert page.locator("#marks button").count() == 4
        page.locator("#objects button.danger").first.click()
        page.wait_for_selector("text=Object 1", state="detached")
        page.evaluate("document.getElementById('cut-start').value = 0.5")
        page.locator("#cut-start").dispatch_event("input")
        page.locator("#cut-start").dispatch_event("change")
        page.wait_for_selector("text=1 of your clicks were on frames that the cut leaves out now")
        wait(page, lambda: "--contact" not in page.locator("#command").text_content())
        assert "--start 0.5" in page.locator("#command").text_content()
        assert complaints == []


@pytest.mark.slow
def test_what_cannot_be_taken_is_said_beside_it(chromium, tmp_path):
    (tmp_path / "notes.mp4").write_text("no video")
    with opened(Command(tmp_path / "studio"), chromium, PHONE) as page:
        page.set_input_files("#file", tmp_path / "notes.mp4")
        page.wait_for_selector("#start-error:not([hidden])")
        assert page.locator("#start-error").text_content().startswith("notes.mp4 is not a video file")
        assert page.locator("#drop").is_visible()
        page.route("**/api/projects", lambda route: route.fulfill(json={"projects": [], "max_bytes": 5}))
        with page.expect_response("**/api/projects"):
            page.reload()
        page.wait_for_function("import('/state.js').then(({ now }) => now.maxBytes === 5)")
        page.set_input_files("#file", tmp_path / "notes.mp4")
        page.wait_for_selector("text=Cut it first.")
        page.goto(f"{page.url.partition('#')[0]}#nothing-here")
        page.wait_for_selector("text=There is no such scene")


@pytest.mark.slow
def test_a_scene_that_is_deleted_in_another_page_is_said_to_be_gone(chromium, tmp_path, clip):
    with opened(Command(tmp_path / "studio"), chromium, DESKTOP) as page:
        offer(page, clip)
        other = page.context.new_page()
        other.goto(page.url)
        other.click("#delete")
        other.click("#really")
        page.wait_for_selector("#scene-error:not([hidden])")
        assert page.locator("#scene-error").text_content() == "There is no such scene (any more)."


@pytest.mark.slow
def test_a_video_with_cuts_is_clicked_on_and_looked_at_shot_by_shot(chromium, tmp_path, finished):
    """What is shown of shots, with runs that are there already."""
    with serve(tmp_path / "studio") as served:
        context = chromium.new_context(viewport=PHONE, accept_downloads=True)
        context.add_cookies([{"name": served.cookie.partition("=")[0], "value": served.cookie.partition("=")[2],
                              "url": f"http://127.0.0.1:{served.port}"}])  # fmt: skip
        page = context.new_page()
        page.goto(f"http://127.0.0.1:{served.port}/")
        complaints = Complaints(page, ("error",))
        offer(page, write_clip_with_cut(tmp_path / "cut.mp4"))
        assert page.locator("#shots label").all_inner_texts()[0].startswith("Each shot a scene")
        assert "2 scenes, and one page that plays them in turn." in page.locator("#shots").inner_text()
        page.locator("#frame-number").evaluate("each => { each.value = each.max; each.dispatchEvent(new Event('input')); }")
        wait(page, lambda: page.locator("#frame-at").text_content().endswith(", shot 2"))
        wait(page, lambda: page.evaluate("document.getElementById('frame').complete"))
        click(page, 0.5, 0.5)
        wait(page, lambda: page.locator("#command").text_content().endswith("@2/11"))
        page.locator("#shots input").nth(1).check()
        wait(page, lambda: page.locator("#command").text_content().endswith("@23"))
        assert "--shots off" in page.locator("#command").text_content()
        page.locator("#shots input").first.check()
        wait(page, lambda: page.locator("#command").text_content().endswith("@2/11"))
        page.locator("#presets input[value=high]").check()
        wait(page, lambda: "--preset high" in page.locator("#command").text_content())
        (project,) = (path.parent for path in (tmp_path / "studio").glob("*/studio.json"))
        write_shots(project / "run", finished)
        page.reload()
        page.wait_for_selector("#scenes button >> nth=1")
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), "nothing sticks out"
        wait(page, lambda: page.locator("#scenes img").nth(1).evaluate("each => each.naturalWidth") > 0)
        page.locator("#scenes button").nth(1).click()
        assert page.locator("#scenes button").nth(1).get_attribute("aria-pressed") == "true"
        page.click("#videos-box summary")
        assert "/shots/02/" in page.locator("#videos video").first.get_attribute("src")
        page.click("#exports-box summary")
        assert page.locator("#exports code").first.inner_text().endswith("run/shots/02 --to ply")
        assert complaints == []
        context.close()
