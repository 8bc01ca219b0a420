"""A page that wishes the viewer ill, in a real browser: of another port, another site, and a name that leads to this machine."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest

from flowsplat.output.viewer.options import ViewOptions
from tests.browser import FLAGS, NAMES, Complaints
from tests.output.tiny import tiny_run

pytest.importorskip("viser", reason="viser is not installed: pip install 'flowsplat[view]'")

import viser

from flowsplat.output.viewer.server import Viewer
from tests.output.viewer.browser import Browser, free_port

ATTACK = """async ([host, protocol]) => {
    const found = {};
    found.socket = await new Promise((done) => {
        let socket;
        try { socket = new WebSocket(`ws://${host}/`, [protocol]); } catch (error) { return done(`refused: ${error}`); }
        socket.onopen = () => done('open');
        socket.onmessage = () => done('message');
        socket.onerror = () => done('refused');
        setTimeout(() => done('silent'), 8000);
    });
    for (const mode of ['cors', 'no-cors']) {
        try {
            const answer = await fetch(`http://${host}/`, { mode, credentials: 'include' });
            found[mode] = `${answer.type} ${(await answer.text()).length}`;
        } catch (error) { found[mode] = 'refused'; }
    }
    found.script = await new Promise((done) => {
        const script = document.createElement('script');
        script.onload = () => done('loaded');
        script.onerror = () => done('refused');
        script.src = `http://${host}/`;
        document.head.append(script);
    });
    const frame = document.createElement('iframe');
    frame.src = `http://${host}/`;
    document.body.append(frame);
    await new Promise((done) => { frame.onload = done; setTimeout(done, 4000); });
    found.frame = frame.contentWindow.length === 0 ? 'empty' : 'filled';
    return found;
}"""


class _Page(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        body = b"<!doctype html><title>foreign</title><body>A page of somebody else."
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: Any) -> None:
        pass


@pytest.fixture(scope="module")
def foreign() -> Iterator[int]:
    """The port of a server that is not ours."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), _Page)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield server.server_address[1]
    server.shutdown()


@pytest.fixture
def rebound(chromium) -> Iterator[Any]:
    """A browser for which a name of the attacker's leads to this machine, as after DNS rebinding."""
    program = next(filter(None, map(shutil.which, NAMES)))
    rules = "--host-resolver-rules=MAP evil.example 127.0.0.1"
    started = chromium.browser_type.launch(executable_path=program, args=[*FLAGS, rules])
    yield started
    started.close()


@pytest.fixture
def served(tmp_path) -> Iterator[tuple[Viewer, int]]:
    port = free_port()
    viewer = Viewer(tiny_run(tmp_path / "out"), ViewOptions(port=port))
    yield viewer, port
    viewer.stop()


def attacked(page: Any, host: str) -> dict[str, str]:
    return page.evaluate(ATTACK, [host, f"viser-v{viser.__version__}"])


def nothing_came_of_it(found: dict[str, str]) -> bool:
    # Without CORS a page reads nothing of an answer: its length is 0 for it.
    assert found["socket"].startswith("refused"), found
    assert found["cors"] == "refused"
    assert found["no-cors"] in ("refused", "opaque 0")
    assert found["script"] == "refused"
    assert found["frame"] == "empty"
    return True


@pytest.mark.slow
def test_a_foreign_page_reaches_nothing(chromium, foreign, served):
    viewer, port = served
    context = chromium.new_context()
    try:
        page = context.new_page()
        for own in ("localhost", "127.0.0.1"):
            page.goto(f"http://{own}:{foreign}/")
            for other in ("localhost", "127.0.0.1"):
                assert nothing_came_of_it(attacked(page, f"{other}:{port}"))
        assert not viewer._panels
        frame = page.frames[-1]
        assert "flowsplat" not in frame.content()
    finally:
        context.close()
    assert not (viewer.source.folder / "viewer").exists()


@pytest.mark.slow
def test_a_rebound_name_reaches_nothing(rebound, foreign, served):
    viewer, port = served
    page = rebound.new_page()
    answer = page.goto(f"http://evil.example:{port}/")
    assert answer.status == 403
    assert "not served under that name" in page.content()
    # From here it is the same origin: only the name tells it.
    found = page.evaluate(ATTACK, [f"evil.example:{port}", f"viser-v{viser.__version__}"])
    assert found["socket"].startswith("refused")
    assert "<html" not in page.evaluate("fetch('/').then((answer) => answer.text())")
    page.goto(f"http://evil.example:{foreign}/")
    assert nothing_came_of_it(attacked(page, f"evil.example:{port}"))
    assert nothing_came_of_it(attacked(page, f"localhost:{port}"))
    assert not viewer._panels


@pytest.mark.slow
def test_the_page_itself_works_and_fetches_nothing_elsewhere(chromium, tmp_path):
    """Neither for an image in the name of a scene, nor because the address asks for it; with the token, where others reach it."""
    folder = tiny_run(tmp_path / "out")
    text = (folder / "scene" / "scene.json").read_text()
    hostile = "![x](http://evil.example/x.png) <img src=http://evil.example/y.png> {process} **bold** \\\\n # A"
    (folder / "scene" / "scene.json").write_text(text.replace('"name": "tiny"', f'"name": "{hostile}"'))
    port = free_port()
    viewer = Viewer(folder, ViewOptions(host="0.0.0.0", port=port))
    context = chromium.new_context(viewport={"width": 640, "height": 400})
    try:
        assert context.new_page().goto(f"http://127.0.0.1:{port}/").status == 403
        page = context.new_page()
        asked: list[str] = []
        page.on("request", lambda request: asked.append(request.url))
        complaints = Complaints(page, ("error",))
        assert page.goto(f"http://127.0.0.1:{port}{viewer.guard.query}").status == 200
        page.get_by_text("![x](http://evil.example/x.png) <img").first.wait_for(timeout=60_000)
        end = time.monotonic() + 60
        while not viewer._panels and time.monotonic() < end:
            page.wait_for_timeout(100)
        page.wait_for_timeout(1500)
        assert page.evaluate("fetch('http://evil.example/').then(() => 'fetched', () => 'refused')") == "refused"
        assert len(viewer._panels) == 1
        assert [url for url in asked if not url.startswith((f"http://127.0.0.1:{port}", "data:", "blob:"))] == []
        assert [text for text in complaints if "evil.example" not in text] == []  # the fetch that we asked for complains
    finally:
        context.close()
        viewer.stop()


def test_values_that_a_control_cannot_have_change_nothing(tmp_path):
    """What a page that had got in might send: each gets a sentence, and nothing is written beside OUT."""
    port, folder = free_port(), tiny_run(tmp_path / "out")
    viewer = Viewer(folder, ViewOptions(port=port))
    before = sorted(path for path in tmp_path.rglob("*"))
    try:
        with Browser(port) as browser:
            browser.settled()
            browser.click("Add a key here")
            for label, value, says in (
                ("Record as", "/../../x.gif", "Record as cannot be"),
                ("Ready-made path", "../x", "Ready-made path cannot be"),
                ("Seconds", 1e6, "Seconds cannot be"),
                ("Seconds", -1.0, "Seconds cannot be"),
                ("Speed", "1/0", "Speed cannot be"),
                ("Show", "x" * 500, "Show cannot be"),
                ("Part", "objects:../1", "Part cannot be"),
                ("Mode", "", "Mode cannot be"),
                ("Object 2", 1e8, "Object 2 cannot be"),
                ("Seconds a key", -5.0, "Seconds a key cannot be"),
            ):
                told = len(browser.notes)
                browser.set(label, value)
                if label in ("Record as", "Ready-made path"):
                    browser.click("Record it" if label == "Record as" else "Take this path")
                browser.wait(lambda told=told, says=says: says in "".join(browser.notes[told:]))
                assert "\n" not in browser.notes[-1]
            for name in ("..", "", "a\0b", "x" * 300 + ".json", "../../evil.json", "/etc/passwd", "a\nb.json", ".hidden"):
                told = len(browser.notes)
                browser.upload("Load a path", name, b"[]")
                browser.wait(lambda told=told: "cannot name a file" in "".join(browser.notes[told:]))
            for content in (b"[" * 100_000, b"{", b"\xff", b"[NaN]", b'{"camera_path": ' + b"9" * 5000 + b"}", b""):
                told = len(browser.notes)
                browser.upload("Load a path", "path.json", content)
                browser.wait(lambda told=told: "did not work" in "".join(browser.notes[told:]))
                assert "Error" not in browser.notes[-1], "a sentence, and no name of an exception"
            assert browser.settled().shape == (72, 96, 3)
    finally:
        viewer.stop()
    assert sorted(path for path in tmp_path.rglob("*")) == before
