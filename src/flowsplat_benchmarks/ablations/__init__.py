"""Run many short trainings that differ in one thing each: what every part is worth, and what more Gaussians and more steps
bring."""

from flowsplat_benchmarks.ablations.benchmark import run_ablations
from flowsplat_benchmarks.ablations.caps import run_caps

__all__ = ["run_ablations", "run_caps"]
