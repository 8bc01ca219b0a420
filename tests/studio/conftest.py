"""One clip for all tests."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("tornado", reason="tornado is not installed: pip install 'flowsplat[studio]'")

from tests.shared import OUT, SCENE, made_before, make_finished, make_scene
from tests.studio.serving import Page, serve, write_clip


@pytest.fixture(scope="session")
def clip(tmp_path_factory) -> Path:
    return write_clip(tmp_path_factory.mktemp("clip") / "walk.mp4")


@pytest.fixture(scope="session")
def finished(tmp_path_factory) -> Path:
    """A whole run that is only looked at."""
    scene = made_before(SCENE) or make_scene(tmp_path_factory.mktemp("tiny"))
    return made_before(OUT) or make_finished(tmp_path_factory.mktemp("finished"), scene)


@pytest.fixture
def page(tmp_path) -> Iterator[Page]:
    with serve(tmp_path / "studio") as opened:
        yield opened
