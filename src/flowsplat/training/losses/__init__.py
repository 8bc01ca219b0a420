"""Loss terms: each a function of what a step rendered, with a weight in ``LossConfig`` and a curve in the history.

A module here, or one of another package with an entry point ``flowsplat.losses``, registers one. It is imported by
``training.config``, which it can import for types alone. Terms whose weight is 0 are not computed.
"""

from __future__ import annotations

import dataclasses
import keyword
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

import tyro
from torch import Tensor

from flowsplat.common.bounds import Amount
from flowsplat.common.registry import Entry, Registry
from flowsplat.common.settings import LEFT_OUT_BY_DEFAULT

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


_taken = {"step", "loss", "psnr", "active", "gaussians", "color"}
"""Names that the history, or the settings (``add_weights``), have for something else."""

LOSSES: Registry[LossTerm] = Registry("loss term", "flowsplat.training.losses", "flowsplat.losses")


def register_loss(
    name: str, title: str, sentence: str, weight: float | None = None, has_curve: bool = True, place: int = 1000
) -> Callable[[Compute], Compute]:
    """Decorate a loss term: ``--train.loss.<name>`` is its weight from then on, and ``weight`` its default.

    Raises:
        ValueError: as ``Registry.add``; or the name cannot be that of a setting and of a curve, or the weight is negative.
    """
    if not name.isidentifier() or keyword.iskeyword(name) or name in _taken:
        raise ValueError(f"{name!r} cannot be the name of a loss term: it is no name of a setting, or that of another one.")
    if weight is not None and not weight >= 0:
        raise ValueError(f"the weight of the loss term {name!r} is {weight}: give 0 or more.")

    def keep(compute: Compute) -> Compute:
        LOSSES.add(Entry(name, title, sentence, LossTerm(compute, weight, has_curve), place))
        return compute

    return keep


def add_weights(kind: Kind) -> Kind:
    """Give a dataclass of settings, before it is made one, a field for the weight of every term that brings a default.

    Its own names are taken, but for those of terms of this folder, each of which is in a file of its name.
    """
    _taken.update({*kind.__annotations__, *dir(kind)} - {module.name for module in pkgutil.iter_modules(__path__)})
    for entry in LOSSES.entries():
        if entry.value.weight is not None:
            kind.__annotations__[entry.name] = Annotated[Amount, tyro.conf.arg(help=f"Weight of the loss term: {entry.sentence}")]
            setattr(kind, entry.name, dataclasses.field(default=entry.value.weight, metadata=LEFT_OUT_BY_DEFAULT))
    return kind
