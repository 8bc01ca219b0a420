"""Dataclasses of settings as JSON holds them, and the names that settings had in earlier versions."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar, cast, get_args, get_type_hints

import msgspec

from flowsplat.common.errors import InputError, first_line
from flowsplat.common.progress import say_once

Config = TypeVar("Config")
Value = TypeVar("Value")

_LATER, _KEYED = "later", "keyed"

RENAMED: Mapping[str, Mapping[str, str]] = {"LossConfig": {"opaque": "coverage"}}
"""By the name of their dataclass: settings that had another name in an earlier version, the oldest first, and their name now.

Files and options with the earlier name are still read. Keys of stages are made with the first name, so that a run of an
earlier version stays finished."""


def later(before: Value, default: Value | None = None) -> Value:
    """A field for a setting that came when there were runs already.

    Args:
        before: what those runs did. ``to_plain`` leaves it out and ``from_plain`` puts it where nothing is said, so that the runs
            from before keep their keys and stay as they are.
        default: of new configurations; None = ``before``.
    """
    chosen = before if default is None else default
    value: Value = dataclasses.field(default=chosen, metadata={_LATER: before})
    return value


def keyed_as(before: Value, default: Value) -> Value:
    """A field that changes no result and got another default: keys of stages are made with the earlier one, so that they stay."""
    value: Value = dataclasses.field(default=default, metadata={_KEYED: before})
    return value


def to_plain(config: Any, first_names: bool = False) -> Any:
    """A configuration as JSON holds it, without what came ``later`` and does what was done before.

    Args:
        first_names: as keys are made, with the names that its settings had first (``RENAMED``).
    """
    if dataclasses.is_dataclass(config) and not isinstance(config, type):
        renamed = RENAMED.get(type(config).__name__, {}) if first_names else {}
        names = {now: before for before, now in reversed(list(renamed.items()))}
        fields = dataclasses.fields(config)
        kept = [f for f in fields if not (_LATER in f.metadata and getattr(config, f.name) == f.metadata[_LATER])]
        values = {f.name: getattr(config, f.name) for f in kept}
        if first_names:
            values |= {f.name: f.metadata[_KEYED] for f in kept if _KEYED in f.metadata and values[f.name] == f.default}
        return {names.get(name, name): to_plain(value, first_names) for name, value in values.items()}
    if isinstance(config, list | tuple):
        return [to_plain(item, first_names) for item in config]
    return str(config) if isinstance(config, Path) else config


def flat(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings (``to_plain``) by dotted name."""
    found: dict[str, Any] = {}
    for name, value in config.items():
        found |= flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return found


def from_plain(kind: type[Config], value: Mapping[str, Any]) -> Config:
    """The inverse of ``to_plain``. Settings that are missing keep their defaults; earlier names are read, with a line.

    Raises:
        InputError: there is a setting that does not exist, or whose value is of another type.
    """
    return _built(kind, present_names(kind, value))


def _built(kind: type[Config], value: Mapping[str, Any]) -> Config:
    hints = get_type_hints(kind)
    fields = dataclasses.fields(cast("Any", kind))
    arguments: dict[str, Any] = {f.name: f.metadata[_LATER] for f in fields if _LATER in f.metadata}
    for name, item in value.items():
        if name not in hints:
            raise InputError(f"Unknown setting {name!r} in {kind.__name__}.")
        hint = hints[name]
        _check_type(kind, name, item, hint)
        if dataclasses.is_dataclass(hint) and isinstance(item, dict):
            item = _built(cast("type[Any]", hint), item)
        elif isinstance(item, list):
            item = tuple(item)
        elif isinstance(item, str) and (hint is Path or Path in get_args(hint)):
            item = Path(item)
        arguments[name] = item
    return kind(**arguments)


def _check_type(kind: type, name: str, item: Any, hint: Any) -> None:
    """Refuse a value that is not of the type of its setting.

    Raises:
        InputError: names the setting.
    """
    try:
        if not dataclasses.is_dataclass(hint):
            msgspec.convert(item, hint, dec_hook=lambda wanted, value: wanted(value))
        elif not isinstance(item, (Mapping, cast("type[Any]", hint))):
            raise TypeError(f"it must be an object of {cast('type[Any]', hint).__name__}")
    except (msgspec.ValidationError, TypeError, ValueError) as error:
        raise InputError(f"The setting {name} of {kind.__name__} cannot be {item!r:.60}: {first_line(error)}.") from error


def present_names(kind: type, value: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Settings of a dataclass as JSON holds them, with the names that they have now; a line says which had another one.

    Args:
        kind: the dataclass.
        value: its settings by name, also the names of an earlier version.
        prefix: before the names, in the line.
    """
    hints, renamed, found = get_type_hints(kind), RENAMED.get(kind.__name__, {}), {}
    for name, item in value.items():
        now = renamed.get(name, name)
        if now != name and now not in value:
            say_once(f"The setting {prefix}{name} is called {prefix}{now} now.")
            name = now
        if dataclasses.is_dataclass(hints.get(name)) and isinstance(item, Mapping):
            item = present_names(cast("type[Any]", hints[name]), item, f"{prefix}{name}.")
        found[name] = item
    return found


def setting_types(kind: type, prefix: str = "") -> dict[str, Any]:
    """The type of every setting of a dataclass and of those within it, by dotted name."""
    found: dict[str, Any] = {}
    for name, hint in get_type_hints(kind).items():
        found |= setting_types(cast("type", hint), f"{prefix}{name}.") if dataclasses.is_dataclass(hint) else {prefix + name: hint}
    return found


def with_settings(config: Config, changes: Mapping[str, Any]) -> Config:
    """A configuration with some settings changed.

    Args:
        changes: values as JSON holds them, by dotted name.

    Raises:
        InputError: as ``from_plain``.
    """
    plain = to_plain(config)
    for name, value in changes.items():
        *within, last = name.split(".")
        settings = plain
        for part in within:
            settings = settings[part]
        settings[last] = value
    return from_plain(cast("type[Config]", type(config)), plain)


def renamed_settings(kind: type, prefix: str = "") -> dict[str, str]:
    """The dotted names that settings of a dataclass had, and those that they have now."""
    found = {prefix + before: prefix + now for before, now in RENAMED.get(kind.__name__, {}).items()}
    for name, hint in get_type_hints(kind).items():
        if dataclasses.is_dataclass(hint):
            found |= renamed_settings(cast("type[Any]", hint), f"{prefix}{name}.")
    return found
