"""Priors by networks (the extra ``learned``): an adapter per model. Nothing heavy is imported before a model is asked for."""
