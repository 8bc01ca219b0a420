"""A real browser without a screen, where one is installed. It draws with SwiftShader, in software."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
FLAGS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


@pytest.fixture(scope="session")
def chromium() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api", reason="tests in a real browser need playwright (extra dev)")
    program = next(filter(None, map(shutil.which, NAMES)), None)
    if program is None:
        pytest.skip("no chromium or chrome is installed: this was not tested in a real browser")
    with playwright.sync_playwright() as running:
        started = running.chromium.launch(executable_path=program, args=list(FLAGS))
        yield started
        started.close()


class Complaints(list[str]):
    """What a page says on its console, of some kinds, and errors that were not caught."""

    def __init__(self, page: Any, kinds: Sequence[str] = ("error", "warning")):
        super().__init__()
        page.on("console", lambda message: self.append(message.text) if message.type in kinds else None)
        page.on("pageerror", lambda error: self.append(str(error)))
