"""Neighbours move alike: the rigid loss, and who neighbours whom."""

from flowsplat.training.rigidity.api import rigid_loss
from flowsplat.training.rigidity.neighbours import Neighbours, find_neighbours

__all__ = ["Neighbours", "find_neighbours", "rigid_loss"]
