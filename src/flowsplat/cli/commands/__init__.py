"""The commands of ``flowsplat``, one file each, found by its name: see ``flowsplat.cli.command``."""

from flowsplat.cli.arguments import Preset

__all__ = ["Preset"]
