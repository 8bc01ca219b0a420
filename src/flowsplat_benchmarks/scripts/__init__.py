"""Measurements that are commands of their own: ``python -m flowsplat_benchmarks.scripts.gpu --everything``."""
