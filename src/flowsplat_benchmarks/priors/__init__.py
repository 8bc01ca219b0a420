"""The priors of many scenes against the truth: flow, cameras, depth, masks, tracks, time and memory."""

from flowsplat_benchmarks.priors.benchmark import run_priors_benchmark

__all__ = ["run_priors_benchmark"]
