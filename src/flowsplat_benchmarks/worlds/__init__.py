"""Random worlds: moving things of many kinds before one camera, drawn from a seed, with exact truth.

Seeds below 900 are for tuning. Seeds 900 to 999 decide between versions and are never looked at one by one. Seeds 1000 to
1199 are only reported.
"""

from flowsplat_benchmarks.worlds.drawing import draw_world
from flowsplat_benchmarks.worlds.plan import draw_plan
from flowsplat_benchmarks.worlds.writing import read_objects, write_world

__all__ = ["draw_plan", "draw_world", "read_objects", "write_world"]
