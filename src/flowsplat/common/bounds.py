"""Bound numeric settings: said where the setting is, checked by one function, shown by the help.

A number of a dataclass of settings is ``Annotated[float, Meta(ge=0, le=1)]``, or one of the types here; where it says nothing it
may be anything. Beyond its bounds a value makes no sense, or is a slip that would overflow or fill the memory.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from functools import partial
from typing import Annotated, Any, TypeVar, get_type_hints

import tyro
from msgspec import Meta

from flowsplat.common.errors import InputError

Amount = Annotated[float, Meta(ge=0, le=1000)]
"""A rate, a weight, a length in median depths or pixels."""
Positive = Annotated[float, Meta(gt=0, le=1000)]
Share = Annotated[float, Meta(ge=0, le=1)]
Fraction = Annotated[float, Meta(gt=0, lt=1)]
Count = Annotated[int, Meta(ge=0, le=10_000_000)]
"""Of steps or Gaussians."""
AtLeastOne = Annotated[int, Meta(ge=1, le=10_000_000)]

Kind = TypeVar("Kind", bound=type)


def bounds_of(kind: type) -> dict[str, Meta]:
    """Return the bounds of the settings of a dataclass, those within it left out, by name."""
    found = {}
    for name, hint in get_type_hints(kind, include_extras=True).items():
        for extra in getattr(hint, "__metadata__", ()):
            if isinstance(extra, Meta):
                found[name] = extra
    return found


def problem(value: float, bounds: Meta) -> str | None:
    """Return what a number must be and is not."""
    low, high = bounds.ge if bounds.ge is not None else bounds.gt, bounds.le if bounds.le is not None else bounds.lt
    if bounds.gt is not None and bounds.lt is not None:
        return None if bounds.gt < value < bounds.lt else f"must be between {bounds.gt:g} and {bounds.lt:g}"
    if low is not None and not (value >= low if bounds.ge is not None else value > low):  # not for NaN
        return f"must be {low:g} or more" if bounds.ge is not None else f"must be more than {low:g}"
    if not math.isfinite(value):
        return "must be finite"
    if high is not None and not (value <= high if bounds.le is not None else value < high):
        return f"must be at most {high:g}" if bounds.le is not None else f"must be less than {high:g}"
    return None


def check_bounds(config: Any, prefix: str) -> None:
    """Refuse numbers that are not within their bounds, also those of dataclasses within this one.

    Args:
        prefix: before the dotted name of a setting, as in ``--train.``.

    Raises:
        InputError: names the first one.
    """
    for name, value, bounds in numbers(config):
        if wrong := problem(value, bounds):
            raise InputError(f"{prefix}{name.replace('_', '-')} {value:g} {wrong}.")


def numbers(config: Any, prefix: str = "") -> Iterator[tuple[str, float, Meta]]:
    """Yield the dotted name, value and bounds of every setting that has some and is a number, also of dataclasses within this
    one."""
    bounds = bounds_of(type(config))
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from numbers(value, f"{prefix}{field.name}.")
        elif field.name in bounds and value is not None:
            yield f"{prefix}{field.name}", value, bounds[field.name]


def format_bounds(bounds: Meta) -> str:
    """``"0 to 1"``, ``"1 or more"``, ``"above 0, below 1"``; what is beyond any use is not said."""
    low = f"{bounds.ge:g}" if bounds.ge is not None else f"above {bounds.gt:g}"
    if bounds.lt is not None:
        return f"{low}, below {bounds.lt:g}"
    if bounds.le is None or bounds.le >= 1000:
        return f"{low} or more" if bounds.ge is not None else low
    return f"{low} to {bounds.le:g}"


def _hint(bounds: str, default: str) -> str:
    return f"({bounds}; default: {default})"


def bounds_in_help(kind: Kind) -> Kind:
    """Let the command line's help say the bounds of a dataclass's settings, beside their defaults."""
    hints = get_type_hints(kind, include_extras=True)
    for name, bounds in bounds_of(kind).items():
        hint = tyro.conf.arg(help_behavior_hint=partial(_hint, format_bounds(bounds)))
        if not any(getattr(extra, "help_behavior_hint", None) for extra in hints[name].__metadata__):
            hints[name] = Annotated[hints[name], hint]
        kind.__annotations__[name] = hints[name]
    return kind
