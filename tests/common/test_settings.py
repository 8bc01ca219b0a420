"""Settings as plain values."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest

from flowsplat.common.errors import InputError
from flowsplat.common.settings import from_plain, to_plain


@dataclass(frozen=True)
class Inner:
    old: int = 1
    new: str = "as before"


@dataclass(frozen=True)
class Outer:
    inner: Inner = Inner()
    names: tuple[str, ...] = ("a", "b")
    file: Path = Path("x/y")


def test_settings_become_what_json_holds():
    value = {"inner": {"old": 2, "new": "else"}, "names": ["a", "b"], "file": "x/y"}
    assert to_plain(Outer(Inner(2, "else"))) == value
    assert from_plain(Outer, value) == Outer(Inner(2, "else"))


def test_what_is_missing_has_its_default():
    assert from_plain(Outer, {"inner": {"old": 3}}) == Outer(Inner(3))


@pytest.mark.parametrize("value", [{"nothing": 1}, {"inner": {"nothing": 1}}, {"inner": {"old": "x"}}, {"inner": 3}, {"names": 3}])
def test_what_is_no_setting_is_refused(value):
    with pytest.raises(InputError):
        from_plain(Outer, value)
