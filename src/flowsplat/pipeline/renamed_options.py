"""Options of a run that had another name before: whoever uses one is told the new name."""

from __future__ import annotations

RENAMED = {
    "--touch": "--contact",
    "--distance": "--same-depth",
    "--mask-not": "--mask-negative",
    "--render.fading": "--render.confidence-fade",
    "--render.no-fading": "--render.no-confidence-fade",
    "--render.distances": "--render.object-depth",
    "--render.slow": "--render.slow-motion",
    "--first-scene": "--coarse-scene",
    "--no-first-scene": "--no-coarse-scene",
}
"""From 0.1 to 0.2, by the command line's names."""


def find_renamed_option(option: str) -> str | None:
    """The name that an option has now, None where it never had another one.

    Hyphens in front may be missing, those within may be underscores, and ``=value`` may follow.
    """
    return RENAMED.get("--" + option.split("=", 1)[0].lstrip("-").replace("_", "-"))
