"""Estimate motion, shape offset and distance of every object."""

from flowsplat.priors.objects.stage import objects_stage
from flowsplat.priors.objects.storage import SceneObjects, load_objects

__all__ = ["SceneObjects", "load_objects", "objects_stage"]
