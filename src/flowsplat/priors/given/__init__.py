"""Priors that need no computing: the truth of a rendered scene, and files that the user brings, of our own or of others."""

from flowsplat.priors.given.options import GivenPriors
from flowsplat.priors.given.truth import consecutive_pairs, true_flow, true_layers

__all__ = ["GivenPriors", "consecutive_pairs", "true_flow", "true_layers"]
