"""Which Gaussians can be seen at a time by a camera: the cull that comes before anything else."""

from flowsplat.gaussians.culling.api import active_rows, border, pad_active_rows
from flowsplat.gaussians.culling.capacity import RowCapacity

__all__ = ["RowCapacity", "active_rows", "border", "pad_active_rows"]
