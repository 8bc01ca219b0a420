"""Scenes that several measurements of a benchmark share: prepared once, by whoever needs them first."""

from __future__ import annotations

import time
from pathlib import Path

from flowsplat.common.errors import InUseError
from flowsplat.common.processes import in_own_process
from flowsplat.pipeline import prepare
from flowsplat.pipeline.preparing import find_prepared
from flowsplat_benchmarks.datasets.cases import Case

POLL_INTERVAL = 2.0
"""Seconds between two looks whether another process has prepared a scene. Chosen by eye."""


def prepare_scene(case: Case, folder: Path) -> Path:
    """Return the prepared scene of a case in ``folder``, a run; what is missing of it is computed, in a process of its own.

    Raises:
        InputError: the input cannot be used.
    """
    if (found := find_prepared(case.source, folder, case.config)) is not None:
        return found
    while True:
        try:
            return in_own_process(_prepare, case, folder)
        except InUseError:
            time.sleep(POLL_INTERVAL)


def _prepare(case: Case, folder: Path) -> Path:
    return prepare(case.source, folder, case.config).scene_path
