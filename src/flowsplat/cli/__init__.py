"""The command line: which commands there are, their options, and how they end."""

from flowsplat.cli.entry import main

__all__ = ["main"]
