"""What every prior costs: a rendered scene trained with one prior after the other replaced by the truth."""

from flowsplat.protocols.oracles.benchmark import run_oracles
from flowsplat.protocols.oracles.movers import mover_errors
from flowsplat.protocols.oracles.scenes import make_oracle

__all__ = ["make_oracle", "mover_errors", "run_oracles"]
