"""Benchmark ``all``: every benchmark whose figures the results pages show, as cells, and the pages that are written of them.

A cell is one benchmark on one clip with one seed. ``cells`` lists them, ``jobs`` says how each is done by the benchmark that it
belongs to, ``benchmark`` does those that are not done at this commit, ``records`` reads and writes what became of each, and
``pages`` writes ``docs/results``.
"""
