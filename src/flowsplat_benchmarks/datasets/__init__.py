"""Whole runs over many scenes under a fixed protocol (docs/method/evaluation.md): DAVIS, rendered rig scenes, NVIDIA
Dynamic Scenes, DyCheck."""

from flowsplat_benchmarks.datasets.benchmark import run_benchmark
from flowsplat_benchmarks.datasets.cases import davis_cases, dycheck_cases, nvidia_cases, rig_cases

__all__ = ["davis_cases", "dycheck_cases", "nvidia_cases", "rig_cases", "run_benchmark"]
