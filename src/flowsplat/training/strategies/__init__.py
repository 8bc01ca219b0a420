"""Strategies of density control: when Gaussians are added, removed and reset, and which of them move.

They have the two hooks of gsplat's strategies (https://docs.gsplat.studio/main/apis/strategy.html). A module here, or one of
another package with an entry point ``flowsplat.strategies``, registers one; ``--train.strategy`` takes its name.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from flowsplat.common.registry import Registry

STRATEGIES: Registry[Callable[..., Any]] = Registry("strategy", "flowsplat.training.strategies", "flowsplat.strategies")
"""What makes a ``protocol.Strategy`` from the settings (``TrainConfig``) and the training frames (``Observations``). Settings name
its members, so it knows neither."""
