"""Settings as plain values: what files hold of them, and what a stage is known by."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, TypeVar

Value = TypeVar("Value")

_LATER = "later"


def later(default: Value) -> Value:
    """A field for a setting that came when there were runs already, with the default that does what those did.

    ``to_plain`` leaves it out where it has its default, so that the runs from before keep their keys.
    """
    value: Value = dataclasses.field(default=default, metadata={_LATER: True})
    return value


def to_plain(config: Any) -> Any:
    """A configuration as JSON holds it; without what came ``later`` and has its default."""
    if dataclasses.is_dataclass(config) and not isinstance(config, type):
        kept = [f for f in dataclasses.fields(config) if not (_LATER in f.metadata and getattr(config, f.name) == f.default)]
        return {f.name: to_plain(getattr(config, f.name)) for f in kept}
    if isinstance(config, list | tuple):
        return [to_plain(item) for item in config]
    return str(config) if isinstance(config, Path) else config
