"""Settings as plain values, and those that came when there were runs already."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from flowsplat.common.settings import from_plain, keyed_as, later, to_plain


@dataclass(frozen=True)
class Inner:
    old: int = 1
    new: str = later("as before")


@dataclass(frozen=True)
class Changed:
    old: int = 1
    new: bool = later(False, default=True)


@dataclass(frozen=True)
class Outer:
    inner: Inner = Inner()
    names: tuple[str, ...] = ("a", "b")
    file: Path = Path("x/y")


def test_settings_become_what_json_holds():
    assert to_plain(Outer(Inner(2, "else"))) == {"inner": {"old": 2, "new": "else"}, "names": ["a", "b"], "file": "x/y"}


def test_what_came_later_is_left_out_at_its_default():
    assert to_plain(Outer())["inner"] == {"old": 1}
    assert Inner().new == "as before"
    assert to_plain(replace(Inner(), new="else"))["new"] == "else"


def test_what_came_later_may_have_another_default_now():
    assert Changed().new
    assert to_plain(Changed()) == {"old": 1, "new": True}
    assert to_plain(Changed(new=False)) == {"old": 1}, "as those from before"
    assert not from_plain(Changed, {"old": 1}).new
    assert all(from_plain(Changed, to_plain(value)) == value for value in (Changed(), Changed(new=False)))


def test_keys_keep_an_earlier_default_that_changes_no_result():
    @dataclass(frozen=True)
    class Settings:
        every: int | None = keyed_as(250, default=None)

    assert to_plain(Settings()) == {"every": None}
    assert to_plain(Settings(), first_names=True) == {"every": 250}
    assert to_plain(Settings(10), first_names=True) == {"every": 10}
