"""Measure what every prior costs: a rendered scene trained with one prior after the other replaced by the truth."""

from flowsplat_benchmarks.oracles.benchmark import run_oracles
from flowsplat_benchmarks.oracles.objects import object_depth_errors
from flowsplat_benchmarks.oracles.quick import run_quick_oracles
from flowsplat_benchmarks.oracles.scenes import make_oracle

__all__ = ["make_oracle", "object_depth_errors", "run_oracles", "run_quick_oracles"]
