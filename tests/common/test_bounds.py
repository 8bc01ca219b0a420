"""Bounds of settings: said at the field, checked, shown."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated

import pytest
from msgspec import Meta

from flowsplat.common.bounds import (
    Amount,
    AtLeastOne,
    Fraction,
    Positive,
    Share,
    bounds_in_help,
    bounds_of,
    check_bounds,
    format_bounds,
    problem,
)
from flowsplat.common.errors import InputError


@bounds_in_help
@dataclass(frozen=True)
class Inner:
    share: Share = 0.5
    count: AtLeastOne = 3
    some: Annotated[int | None, Meta(ge=2, le=5)] = None


@bounds_in_help
@dataclass(frozen=True)
class Outer:
    rate: Amount = 0.1
    size: Positive = 1.0
    part: Fraction = 0.5
    name: str = "x"
    free: float = -1e9
    inner: Inner = field(default_factory=Inner)


def test_what_is_within_its_bounds_is_fine():
    check_bounds(Outer(), "--")
    check_bounds(Outer(rate=0, size=1e-9, inner=Inner(1, 1, 5)), "--")


@pytest.mark.parametrize(
    ("config", "text"),
    [
        (Outer(rate=-1), "--train.rate -1 must be 0 or more."), (Outer(rate=1001), "--train.rate 1001 must be at most 1000."),
        (Outer(rate=math.nan), "--train.rate nan must be 0 or more."), (Outer(size=0), "--train.size 0 must be more than 0."),
        (Outer(part=1), "--train.part 1 must be between 0 and 1."), (Outer(rate=math.inf), "--train.rate inf must be finite."),
        (Outer(inner=Inner(share=2)), "--train.inner.share 2 must be at most 1."),
        (Outer(inner=Inner(some=1)), "--train.inner.some 1 must be 2 or more."),
    ],
)  # fmt: skip
def test_what_is_not_is_named(config, text):
    with pytest.raises(InputError) as error:
        check_bounds(config, "--train.")
    assert str(error.value) == text


def test_strict_upper_bounds():
    assert problem(2, Meta(ge=0, lt=2)) == "must be less than 2"
    assert problem(1, Meta(ge=0, lt=2)) is None


def test_bounds_in_words():
    words = {name: format_bounds(bounds) for name, bounds in bounds_of(Outer).items()}
    assert words == {"rate": "0 or more", "size": "above 0", "part": "above 0, below 1"}
    assert format_bounds(Meta(ge=0, le=1)) == "0 to 1"


def test_every_number_of_training_has_bounds():
    from dataclasses import fields, is_dataclass

    from flowsplat.training.config import TrainConfig

    def without(config: object, prefix: str = "") -> list[str]:
        known, found = bounds_of(type(config)), []
        for each in fields(config):
            value = getattr(config, each.name)
            if is_dataclass(value):
                found += without(value, f"{prefix}{each.name}.")
            elif isinstance(value, int | float) and not isinstance(value, bool) and each.name not in known:
                found.append(prefix + each.name)
        return found

    assert without(TrainConfig()) == []
