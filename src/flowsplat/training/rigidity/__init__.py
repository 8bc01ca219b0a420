"""Neighbors move alike: the rigid loss, and who neighbors whom."""

from flowsplat.training.rigidity.api import rigid_loss
from flowsplat.training.rigidity.neighbors import Neighbors, find_neighbors

__all__ = ["Neighbors", "find_neighbors", "rigid_loss"]
