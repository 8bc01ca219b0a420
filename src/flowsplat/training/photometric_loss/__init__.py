"""Compute the photometric loss of a rendered image: color (L1 and SSIM), flow and depth in one operation, with its gradient."""

from flowsplat.training.photometric_loss.api import PhotometricTargets, PhotometricWeights, photometric_loss

__all__ = ["PhotometricTargets", "PhotometricWeights", "photometric_loss"]
