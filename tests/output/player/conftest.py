"""Pages of the player in a real browser."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.browser import Complaints
from tests.output.small import small_model, small_player


@pytest.fixture(scope="session")
def player_file(tmp_path_factory) -> Path:
    """The player of the small scene."""
    path = tmp_path_factory.mktemp("player") / "Ünïcode and spaces.html"
    return small_player(path, small_model(), "small </script> scene")


class Page:
    """A page of the player, and everything it complained about or asked the network for."""

    def __init__(self, page: Any):
        self.page = page
        self.complaints = Complaints(page)
        self.requests: list[str] = []
        page.on("request", lambda request: self.requests.append(request.url))

    def load(self, path: Path) -> Page:
        self.page.goto(path.as_uri())
        self.page.wait_for_selector("body.shown, body.failed", timeout=60_000)
        return self

    def pause(self) -> None:
        self.page.evaluate("flowsplat.state.setPlaying(false)")
        self.settle()

    def settle(self) -> None:
        """Wait until the last image that was asked for is there."""
        self.page.wait_for_timeout(100)
        self.page.evaluate("() => new Promise((done) => requestAnimationFrame(() => setTimeout(done, 150)))")


@pytest.fixture
def open_page(chromium) -> Iterator[Callable[..., Page]]:
    """A new page without network; ``init`` is JavaScript that runs before the page's own."""
    contexts = []

    def open_it(path: Path | None = None, init: str | None = None, **options: Any) -> Page:
        context = chromium.new_context(offline=True, viewport={"width": 480, "height": 400}, **options)
        contexts.append(context)
        page = context.new_page()
        if init:
            page.add_init_script(init)
        return Page(page) if path is None else Page(page).load(path)

    yield open_it
    for context in contexts:
        context.close()
