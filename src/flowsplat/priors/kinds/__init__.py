"""How each kind of prior is made, read and replaced: one file a kind. ``priors/graph.py`` says how they follow from each other."""
