"""Measure how far away moving objects are estimated to be, in random worlds with exact truth."""

from flowsplat_benchmarks.objects.benchmark import run_objects_benchmark

__all__ = ["run_objects_benchmark"]
