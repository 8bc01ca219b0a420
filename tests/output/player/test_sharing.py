"""The page in another page, on the whole screen, and what it shows as a video."""

from __future__ import annotations

import re
from html import unescape

from flowsplat.output.player.page import make_iframe
from tests.output.small import HEIGHT, WIDTH, small_model, small_player


def test_the_line_that_embeds_it_shows_it_playing_without_its_controls(open_page, tmp_path):
    path = small_player(tmp_path / 'a "clip" & more.html', small_model())
    line = make_iframe(path, 'a "clip" <b>', WIDTH, HEIGHT)
    assert unescape(re.findall('title="(.*?)"', line)[0]) == 'a "clip" <b>'
    (tmp_path / "blog.html").write_text(f"<!doctype html><p>{line}</p>", encoding="utf-8")
    page = open_page(None)
    page.page.goto((tmp_path / "blog.html").as_uri())
    inner = page.page.frame_locator("iframe")
    inner.locator("body.shown").wait_for(timeout=60_000)
    assert inner.locator("#bar").is_hidden()
    frame = page.page.frames[1]
    assert frame.evaluate("flowsplat.state.isPlaying")
    box, canvas = page.page.locator("iframe").bounding_box(), inner.locator("#canvas").bounding_box()
    assert abs(box["width"] - canvas["width"]) <= 2
    assert abs(box["height"] - canvas["height"]) <= 2, "no bars"
    page.page.mouse.move(box["x"] + 20, box["y"] + 20)
    page.page.mouse.wheel(0, -300)
    page.settle()
    assert frame.evaluate("flowsplat.state.elastic.zoom") == 1, "the wheel is for the page round it"
    assert page.complaints == []


def test_what_is_seen_becomes_a_video(open_page, player_file):
    page = open_page(player_file)
    button = page.page.locator("#record")
    button.click()
    assert button.inner_text() == "Stop and save"
    page.page.wait_for_timeout(1000)
    with page.page.expect_download() as saved:
        button.click()
    assert saved.value.suggested_filename.endswith("scene.webm")
    assert saved.value.path().read_bytes()[:4] == bytes.fromhex("1a45dfa3"), "Matroska, and so WebM, begins like that"
    assert button.inner_text() == "Record"
    assert page.complaints == []


def test_it_fills_the_screen_and_leaves_it(open_page, player_file):
    page = open_page(player_file)
    assert page.page.locator("#share").is_hidden(), "of a page on a disk there is no address to pass on"
    page.page.locator("#fullscreen").click()
    page.settle()
    assert page.page.evaluate("Boolean(document.fullscreenElement)")
    page.page.locator("#fullscreen").click()
    page.settle()
    assert not page.page.evaluate("Boolean(document.fullscreenElement)")
    assert page.complaints == []
