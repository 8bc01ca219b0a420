"""Masks of moving objects without learned weights: what many matches show to move, cut out along the image."""

from flowsplat.priors.masks.stage import mask_stage

__all__ = ["mask_stage"]
