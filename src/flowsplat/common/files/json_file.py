"""The one reader of JSON files.

msgspec reads them (https://jcristharif.com/msgspec): it refuses NaN and numbers beyond float64, which Python's own reader lets
pass, and checks types as they are written in Python: ``TypedDict`` for objects, ``Annotated[int, Meta(ge=1)]`` for ranges. What is
read stays plain dicts and lists, with whatever else a newer version has put there.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta
from typing_extensions import TypedDict

from flowsplat.common.errors import InputError
from flowsplat.common.files.opening import read_bytes

MAX_JSON_BYTES = 16 * 2**20
"""Of a file. ``[[],[],...]`` takes twenty times as much in memory. Chosen by eye."""
MAX_JSON_DEPTH = 64
"""Lists and objects within each other; Python recurses where such values are walked through. Chosen by eye."""
MAX_EXACT_INTEGER = 2**53
"""Whole numbers up to which float64 is exact."""

_NOT_FINITE = re.compile(rb"[\[:,]\s*-?(NaN|Infinity)\b")
"""As many programs write it, although JSON has no such numbers."""

Count = Annotated[int, Meta(ge=0, le=10_000_000)]
Pixels = Annotated[int, Meta(ge=1, le=65_536)]
Positive = Annotated[float, Meta(gt=0, le=1e12)]
Number = Annotated[float, Meta(ge=-1e12, le=1e12)]
Text = Annotated[str, Meta(max_length=10_000)]
Row3 = tuple[Number, Number, Number]
Row4 = tuple[Number, Number, Number, Number]


class SimilarityFile(TypedDict):
    """A scale, a rotation and a translation."""

    scale: Positive
    rotation: tuple[Row3, Row3, Row3]
    translation: Row3


class Versioned(TypedDict):
    """What is asked first of a file: a newer version may hold anything else."""

    version: Count


def read_json(path: Path, schema: Any = None, most: int = MAX_JSON_BYTES) -> Any:
    """Return what a JSON file holds.

    Args:
        schema: the type that it must have; None = any JSON.
        most: bytes of the file.

    Raises:
        InputError: missing, too large, not JSON, too deep, with numbers that are none, or not as ``schema`` says.
    """
    return decode_json(path, read_bytes(path, most).removeprefix(b"\xef\xbb\xbf"), schema)


def decode_json(path: Path | str, data: bytes, schema: Any = None) -> Any:
    """Return what some JSON says, once it is certain that it is as ``schema`` says; ``path`` names it in errors.

    Raises:
        InputError: as ``read_json``.
    """
    try:
        value = msgspec.json.decode(data)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        if _NOT_FINITE.search(data):
            raise InputError(f"{path} is damaged: it holds a number that is not finite (NaN or Infinity).") from error
        raise InputError(f"{path} is not readable JSON (damaged or truncated): {error}.") from error
    _check_plain(path, value)
    if schema is not None:
        check_json(path, value, schema)
    return value


def read_json_lines(path: Path, schema: Any = None, most: int = MAX_JSON_BYTES) -> list[tuple[int, Any]]:
    """Return the values of a file with one JSON on every line, each with the number of its line, from 1 on; empty ones are left
    out.

    Args:
        schema: the type that each must have; None = any JSON.
        most: bytes of the file.

    Raises:
        InputError: as ``read_json``; it names the line.
    """
    found = []
    for number, line in enumerate(read_bytes(path, most).removeprefix(b"\xef\xbb\xbf").split(b"\n"), 1):
        if line.strip():
            found.append((number, decode_json(f"{path}, line {number},", line, schema)))
    return found


def check_json(path: Path | str, value: Any, schema: Any) -> None:
    """Refuse what was read from a JSON file and is not as ``schema`` says.

    Raises:
        InputError: names the file, and where in it what is wrong.
    """
    try:
        msgspec.convert(value, schema)
    except (msgspec.ValidationError, RecursionError) as error:
        raise InputError(f"{path} is damaged: {error}.") from error
    except UnicodeEncodeError as error:
        # Not where this module has read it: Python's own reader lets half a character pass ("\\ud800").
        raise InputError(f"{path} is damaged: it holds half a character (a lone surrogate), which is no text.") from error


def _check_plain(path: Path | str, value: Any) -> None:
    """Refuse what would only fail later: depth at which Python stops, and numbers that no float64 holds."""
    level = [value]
    for _ in range(MAX_JSON_DEPTH):
        deeper: list[Any] = []
        for item in level:
            if isinstance(item, dict):
                deeper.extend(item.values())
            elif isinstance(item, list):
                deeper.extend(item)
            elif isinstance(item, int) and not -MAX_EXACT_INTEGER <= item <= MAX_EXACT_INTEGER:
                raise InputError(f"{path} is damaged: it holds a whole number of {len(str(abs(item)))} digits.")
            elif isinstance(item, float) and not math.isfinite(item):
                raise InputError(f"{path} is damaged: it holds a number that is not finite.")
        level = deeper
        if not level:
            return
    raise InputError(f"{path} is damaged: it nests deeper than {MAX_JSON_DEPTH} levels.")
