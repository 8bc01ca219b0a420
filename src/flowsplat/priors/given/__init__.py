"""Priors that need no computing: the truth of a rendered scene, and files that the user brings, of our own or of others."""

from flowsplat.priors.given.truth import consecutive_pairs, true_layers, use_truth
from flowsplat.priors.given.use import GivenPriors, use_given

__all__ = ["GivenPriors", "consecutive_pairs", "true_layers", "use_given", "use_truth"]
