"""Adam that steps only the rows with a gradient."""

from flowsplat.training.adam.api import RowAdam

__all__ = ["RowAdam"]
