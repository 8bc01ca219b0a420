"""A tiny clip with truth and a finished run of it, for tests that only look; what changes one of them works on a copy."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.shared import OUT, SCENE, made_before, make_finished, make_scene


@pytest.fixture(scope="session")
def tiny_scene(tmp_path_factory) -> Path:
    return made_before(SCENE) or make_scene(tmp_path_factory.mktemp("tiny"))


@pytest.fixture(scope="session")
def finished(tiny_scene, tmp_path_factory) -> Path:
    """The folder of a whole run of ``small_config``."""
    return made_before(OUT) or make_finished(tmp_path_factory.mktemp("finished"), tiny_scene)
