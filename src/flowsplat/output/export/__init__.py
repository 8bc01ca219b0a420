"""A trained scene in the formats of other programs."""

from typing import Any

from flowsplat.output.export.options import ExportOptions

__all__ = ["ExportOptions", "export_scene"]


def __getattr__(name: str) -> Any:
    if name != "export_scene":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from flowsplat.output.export.api import export_scene

    return export_scene
