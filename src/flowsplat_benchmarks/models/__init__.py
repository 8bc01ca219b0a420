"""Benchmark ``models``: motion models of several papers on the same clips, with the same start, priors, losses and steps.

``lineup`` says which there are and what each cannot do, ``times`` which frames are held out, ``measure`` what is measured beside
what ablations measure, and ``report`` writes the tables.
"""
