"""How far away moving objects are estimated to be, in random worlds with exact truth."""

from flowsplat_benchmarks.movers.benchmark import run_movers_benchmark

__all__ = ["run_movers_benchmark"]
