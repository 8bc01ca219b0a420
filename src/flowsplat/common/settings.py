"""Dataclasses of settings as JSON holds them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar, cast, get_args, get_type_hints

import msgspec

from flowsplat.common.errors import InputError, first_line

Config = TypeVar("Config")

LEFT_OUT_BY_DEFAULT = {"left_out_by_default": True}
"""Metadata of a field that is written only where it is not the default: then who does not know it can read all the rest."""


def to_plain(config: Any) -> Any:
    """Return a configuration as JSON holds it."""
    if dataclasses.is_dataclass(config) and not isinstance(config, type):
        return {
            field.name: to_plain(value)
            for field in dataclasses.fields(config)
            if (value := getattr(config, field.name)) != field.default or not field.metadata.get("left_out_by_default")
        }
    if isinstance(config, list | tuple):
        return [to_plain(item) for item in config]
    return str(config) if isinstance(config, Path) else config


def flat(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings (``to_plain``) by dotted name."""
    found: dict[str, Any] = {}
    for name, value in config.items():
        found |= flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return found


def from_plain(kind: type[Config], value: Mapping[str, Any]) -> Config:
    """Return the inverse of ``to_plain``. Settings that are missing keep their defaults.

    Raises:
        InputError: there is a setting that does not exist, or whose value is of another type.
    """
    hints, arguments = get_type_hints(kind), {}  # type: dict[str, Any], dict[str, Any]
    for name, item in value.items():
        if name not in hints:
            raise InputError(
                f"Unknown setting {name!r} in {kind.__name__}: it is of another version, or of a package that is missing."
            )
        hint = hints[name]
        _check_type(kind, name, item, hint)
        if dataclasses.is_dataclass(hint) and isinstance(item, dict):
            item = from_plain(cast("type[Any]", hint), item)
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


def list_setting_types(kind: type, prefix: str = "") -> dict[str, Any]:
    """Return the type of every setting of a dataclass and of those within it, by dotted name."""
    found: dict[str, Any] = {}
    for name, hint in get_type_hints(kind).items():
        found |= (
            list_setting_types(cast("type", hint), f"{prefix}{name}.") if dataclasses.is_dataclass(hint) else {prefix + name: hint}
        )
    return found


def with_settings(config: Config, changes: Mapping[str, Any]) -> Config:
    """Return a configuration with some settings changed.

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
