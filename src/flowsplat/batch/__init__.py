"""Many clips: each an ordinary run in ``OUT/<id>``, any number of processes and machines at work on them at a time."""

from flowsplat.batch.command import run_batch
from flowsplat.batch.options import BatchOptions

__all__ = ["BatchOptions", "run_batch"]
