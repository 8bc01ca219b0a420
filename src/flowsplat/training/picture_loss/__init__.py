"""What a rendered picture is trained by: color (L1 and SSIM), flow and depth in one operation, with its gradient."""

from flowsplat.training.picture_loss.api import PictureTargets, PictureWeights, picture_loss

__all__ = ["PictureTargets", "PictureWeights", "picture_loss"]
