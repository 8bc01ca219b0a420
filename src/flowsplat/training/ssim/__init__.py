"""The colour loss: L1 and SSIM in one operation, with its gradient."""

from flowsplat.training.ssim.api import colour_loss

__all__ = ["colour_loss"]
