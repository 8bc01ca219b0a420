"""Make, read and replace each kind of prior: one file a kind. ``priors/graph.py`` says how they follow from each other."""
