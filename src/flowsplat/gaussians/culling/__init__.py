"""Which Gaussians can be seen at a time by a camera: the cull that comes before anything else."""

from flowsplat.gaussians.culling.api import active_rows, border

__all__ = ["active_rows", "border"]
