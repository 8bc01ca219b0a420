"""Loss terms: each a function of what a step rendered, with a weight in ``LossConfig`` and a curve in the history.

A module here, or one of another package with an entry point ``flowsplat.losses``, registers one. It is imported by
``training.config``, which it can import for types alone. Terms whose weight is 0 are not computed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

import tyro
from torch import Tensor

from flowsplat.common.bounds import Amount
from flowsplat.common.registry import Entry, Registry

Compute = Callable[[Any], Tensor | None]
"""From a ``training.step.StepOutput`` to a term before its weight, a scalar that is differentiable; None = nothing there says
anything. Settings have the terms' weights, and a step has settings, so this cannot name its type."""
Kind = TypeVar("Kind", bound=type)


@dataclass(frozen=True)
class LossTerm:
    """A term of the loss.

    Attributes:
        compute: gives it.
        weight: by default; None = ``LossConfig`` has a field of its name or, where it has none, the weight is always 1.
        has_curve: the history shows it; otherwise it adds figures of its own to ``StepOutput.figures``.
    """

    compute: Compute
    weight: float | None = None
    has_curve: bool = True


LOSSES: Registry[LossTerm] = Registry("loss term", "flowsplat.training.losses", "flowsplat.losses")


def register_loss(
    name: str, title: str, sentence: str, weight: float | None = None, has_curve: bool = True, place: int = 1000
) -> Callable[[Compute], Compute]:
    """Decorate a loss term: ``--train.loss.<name>`` is its weight from then on, and ``weight`` its default.

    Raises:
        ValueError: as ``Registry.add``.
    """

    def keep(compute: Compute) -> Compute:
        LOSSES.add(Entry(name, title, sentence, LossTerm(compute, weight, has_curve), place))
        return compute

    return keep


def add_weights(kind: Kind) -> Kind:
    """Give a dataclass of settings, before it is made one, a field for the weight of every term that brings a default.

    Raises:
        ValueError: a setting has the name of a term already.
    """
    for entry in LOSSES.entries():
        if entry.value.weight is not None:
            if entry.name in kind.__annotations__:
                raise ValueError(f"the loss term {entry.name!r} would take the place of the setting of that name.")
            kind.__annotations__[entry.name] = Annotated[Amount, tyro.conf.arg(help=f"Weight of the loss term: {entry.sentence}")]
            setattr(kind, entry.name, entry.value.weight)
    return kind
