"""Whole benchmarks over many scenes: they prepare, measure, and write tables with targets beside figures."""
