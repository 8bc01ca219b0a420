"""One run for all tests that only look, and one viewer of it for each file of them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.output.tiny import tiny_run

if TYPE_CHECKING:
    from tests.output.viewer.browser import Browser


@pytest.fixture(scope="session")
def run_folder(tmp_path_factory) -> Path:
    return tiny_run(tmp_path_factory.mktemp("tiny") / "out")


@pytest.fixture(scope="module")
def port(run_folder) -> Iterator[int]:
    """Of a viewer of it."""
    from flowsplat.output.viewer.options import ViewOptions
    from flowsplat.output.viewer.server import Viewer
    from tests.output.viewer.browser import free_port

    port = free_port()
    viewer = Viewer(run_folder, ViewOptions(port=port))
    yield port
    viewer.stop()


@pytest.fixture
def browser(port) -> Iterator[Browser]:
    """One that has just come."""
    from tests.output.viewer.browser import Browser

    with Browser(port) as browser:
        browser.settled()
        yield browser
