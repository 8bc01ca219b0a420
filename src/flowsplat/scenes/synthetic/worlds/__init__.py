"""Worlds of moving things on a ground before one camera, cast ray by ray, with exact truth: that of the demo is the street.

``flowsplat_benchmarks.worlds`` draws random ones.
"""
