"""The parts of the comparison with gsplat, one module a subject; ``gsplat_parity.py`` beside this folder is the command."""
