"""A real browser without a screen, where one is installed. It draws with SwiftShader, in software."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from flowsplat.output.player import write_player
from tests.output.small import small_cameras, small_model, small_times

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
FLAGS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api", reason="the player's tests need playwright (extra dev)")
    program = next(filter(None, map(shutil.which, NAMES)), None)
    if program is None:
        pytest.skip("no chromium or chrome is installed: the player was not tested in a browser")
    with playwright.sync_playwright() as running:
        started = running.chromium.launch(executable_path=program, args=list(FLAGS))
        yield started
        started.close()


@pytest.fixture(scope="session")
def player_file(tmp_path_factory) -> Path:
    """The player of the small scene."""
    model = small_model()
    path = tmp_path_factory.mktemp("player") / "Ünïcode and spaces.html"
    return write_player(path, model, small_times(), small_cameras(model), "small </script> scene")


class Page:
    """A page of the player, and everything it complained about or asked the network for."""

    def __init__(self, page: Any):
        self.page = page
        self.complaints: list[str] = []
        self.requests: list[str] = []
        page.on("console", lambda message: self.complaints.append(message.text) if message.type in ("error", "warning") else None)
        page.on("pageerror", lambda error: self.complaints.append(str(error)))
        page.on("request", lambda request: self.requests.append(request.url))

    def load(self, path: Path) -> Page:
        self.page.goto(path.as_uri())
        self.page.wait_for_selector("body.shown, body.failed", timeout=60_000)
        return self

    def pause(self) -> None:
        self.page.evaluate("flowsplat.state.setPlaying(false)")
        self.settle()

    def settle(self) -> None:
        """Wait until the last picture that was asked for is there."""
        self.page.wait_for_timeout(100)
        self.page.evaluate("() => new Promise((done) => requestAnimationFrame(() => setTimeout(done, 150)))")


@pytest.fixture
def open_page(browser) -> Iterator[Callable[..., Page]]:
    """A new page without network; ``init`` is JavaScript that runs before the page's own."""
    contexts = []

    def open_it(path: Path | None = None, init: str | None = None, **options: Any) -> Page:
        context = browser.new_context(offline=True, viewport={"width": 480, "height": 400}, **options)
        contexts.append(context)
        page = context.new_page()
        if init:
            page.add_init_script(init)
        return Page(page) if path is None else Page(page).load(path)

    yield open_it
    for context in contexts:
        context.close()
