"""Pages that run no foreign script and fetch nothing, whatever gets into them, in a real browser."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flowsplat.images.video import write_mp4
from flowsplat.output.page import write_page
from flowsplat.output.report import write_report
from tests.browser import Complaints
from tests.output.small import small_model, small_player
from tests.output.test_report import made_up_run

FETCHES = """async (address) => {
    const tried = {};
    tried.fetch = await fetch(address + 'fetch', { mode: 'no-cors' }).then(() => 'done', () => 'refused');
    tried.beacon = navigator.sendBeacon(address + 'beacon', 'x');
    const wait = (element, name) => new Promise((done) => {
        element.onload = element.onloadeddata = () => done('done');
        element.onerror = () => done('refused');
        element[name] = address + element.tagName;
        document.body.append(element);
        setTimeout(() => done('silent'), 2000);
    });
    tried.image = await wait(document.createElement('img'), 'src');
    tried.video = await wait(document.createElement('video'), 'src');
    tried.script = await wait(document.createElement('script'), 'src');
    tried.frame = await wait(document.createElement('iframe'), 'src');
    const link = document.createElement('link');
    link.rel = 'stylesheet';
    tried.style = await wait(link, 'href');
    const inline = document.createElement('script');
    inline.textContent = 'window.ran = true';
    document.body.append(inline);
    tried.inline = window.ran ? 'done' : 'refused';
    const style = document.createElement('style');
    style.textContent = `@import url(${address}import); body { background: url(${address}background); }`;
    document.head.append(style);
    await new Promise((done) => setTimeout(done, 300));
    return tried;
}"""


class _Counting(BaseHTTPRequestHandler):
    asked: list[str]

    def do_GET(self) -> None:
        self.asked.append(self.path)
        self.send_response(200)
        self.end_headers()

    do_POST = do_GET

    def log_message(self, *_: Any) -> None:
        pass


@pytest.fixture
def outside() -> Iterator[tuple[str, list[str]]]:
    """The address of a server that no page has to do with, and what it was asked for."""
    handler = type("Counting", (_Counting,), {"asked": []})
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_address[1]}/", handler.asked
    server.shutdown()


def opened(chromium: Any, path: Path) -> tuple[Any, Complaints]:
    page = chromium.new_context().new_page()
    complaints = Complaints(page)
    page.goto(path.as_uri())
    return page, complaints


def nothing_is_fetched(page: Any, outside: tuple[str, list[str]]) -> bool:
    address, asked = outside
    tried = page.evaluate(FETCHES, address)
    assert {tried[name] for name in ("fetch", "image", "video", "script", "style", "inline")} == {"refused"}, tried
    assert asked == []
    return True


def test_a_report_shows_its_videos_and_fetches_nothing(chromium, outside, tmp_path):
    data = made_up_run()
    write_report(tmp_path, data)
    text = (tmp_path / "report.html").read_text()
    write_mp4(tmp_path / "renders" / "beside.mp4", [np.full((48, 64, 3), 90, np.uint8)] * 3, 24)
    at = text.index("<main>") + len("<main>")
    beside = '<video id="beside" muted src="renders/beside.mp4" preload="auto"></video><script>window.bad = true</script>'
    beside += f'<img onerror="window.worse = true" src="{outside[0]}x">'
    (tmp_path / "report.html").write_text(text[:at] + beside + text[at:])
    page, _ = opened(chromium, tmp_path / "report.html")
    for _ in range(100):  # playwright's own waiting needs what the policy forbids
        if page.evaluate("document.getElementById('beside').readyState >= 2 && document.images[1].complete"):
            break
        page.wait_for_timeout(100)
    assert page.evaluate("document.getElementById('beside').readyState") >= 2
    shown = "[...document.images].filter((i) => i.complete && i.src.startsWith('data:'))"
    images = page.evaluate(f"{shown}.map((i) => i.naturalWidth)")
    assert images
    assert min(images) > 0
    assert page.evaluate("window.bad === undefined && window.worse === undefined")
    assert nothing_is_fetched(page, outside)
    page.context.close()


def test_every_page_made_from_a_template_has_the_policy(tmp_path):
    folder = Path(write_page.__code__.co_filename).parent / "templates"
    for template in folder.glob("*.jinja"):
        text = template.read_text()
        assert "Content-Security-Policy" in text or "extends" in text or "<html" not in text, template


def test_the_player_plays_and_fetches_nothing(chromium, outside, tmp_path):
    path = small_player(tmp_path / "player.html", small_model(), "small")
    page, complaints = opened(chromium, path)
    page.wait_for_selector("body.shown", timeout=60_000)
    assert complaints == []
    assert nothing_is_fetched(page, outside)
    page.context.close()
