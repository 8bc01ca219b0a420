"""Depth without learned weights: from matches over many frames where the scene rests, from what is hidden where it moves."""

from flowsplat.priors.depth.stage import depth_stage

__all__ = ["depth_stage"]
