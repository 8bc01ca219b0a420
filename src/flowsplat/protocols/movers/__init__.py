"""How far away moving objects are estimated to be, in random worlds with exact truth."""

from flowsplat.protocols.movers.benchmark import run_movers_benchmark

__all__ = ["run_movers_benchmark"]
