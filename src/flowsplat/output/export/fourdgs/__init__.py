"""What the format ``.4dgs`` holds of a 4D scene (``formats/fourdgs.py`` writes it): straight pieces of motion and their colors, on
the grids of the format, in its records."""
