"""The single-file player: a trained scene in one HTML page, sliced and drawn by the browser."""

from flowsplat.output.player.page import write_player

__all__ = ["write_player"]
