"""Benchmarks of flowsplat, beside it: it never imports them.

``commands`` are those behind ``flowsplat benchmark``: whole benchmarks over many scenes, which prepare, measure, and write tables
with targets beside figures. ``scripts`` measure speed, memory and what is unusual, each by ``python -m``. ``worlds`` draws random
scenes with exact truth.
"""
