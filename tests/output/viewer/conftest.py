"""One run for all tests that only look."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.output.tiny import tiny_run


@pytest.fixture(scope="session")
def run_folder(tmp_path_factory) -> Path:
    return tiny_run(tmp_path_factory.mktemp("tiny") / "out")
