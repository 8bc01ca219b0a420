"""Measure how far flow and color of an image are off where single Gaussians are seen."""

from flowsplat.training.dynamic_evidence.api import add_residuals

__all__ = ["add_residuals"]
