"""Additions to flowsplat, one module each; ``pyproject.toml`` names them."""
