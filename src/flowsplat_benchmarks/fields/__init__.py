"""Benchmark ``fields``: T-NeRF and HyperNeRF, the first two rows of the paper's table, in the time that ``default`` takes.

``networks`` has both fields, on the ``encoding`` of their inputs and the ``deformation`` of HyperNeRF; ``volume`` renders them
along ``rays`` of a prepared scene. ``training`` trains one for a number of seconds, ``measure`` renders and scores held-out
images, ``benchmark`` does all of it, and ``report`` writes the table.
"""
