"""What needs a real GPU. The kernels themselves are tested everywhere, on a GPU where there is one: see the other folders."""

from __future__ import annotations

from pathlib import Path

import pytest

from flowsplat.common.devices import gpu_problem

HERE = Path(__file__).parent


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip this folder where no GPU works, and say why."""
    problem = gpu_problem()
    for item in items:
        if problem is not None and HERE in item.path.parents:
            item.add_marker(pytest.mark.skip(reason=f"needs a GPU: {problem}"))
