"""The tiny data root of the runs."""

from tests.flowsplat_benchmarks.datasets.conftest import runs_root

__all__ = ["runs_root"]
