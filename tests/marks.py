"""One of many cases of a test."""

from __future__ import annotations

from typing import Any

import pytest


def slow(*values: Any, **how: Any) -> Any:
    """A case that ``make test-all`` tries and ``make test`` does not, which tries others of the same."""
    return pytest.param(*values, marks=pytest.mark.slow, **how)
