"""Who moves, how, and how far away: motion, relief and distance of every mover."""

from flowsplat.priors.objects.stage import objects_stage
from flowsplat.priors.objects.storage import SceneMovers, load_movers

__all__ = ["SceneMovers", "load_movers", "objects_stage"]
