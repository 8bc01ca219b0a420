"""Tables of figures, as data and as Markdown."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flowsplat.evaluation.scores import mean_of
from flowsplat.pictures.html import NOTHING

TUNED_MARK = "*tuned*"
"""Behind the name of a scene on which settings were chosen."""


@dataclass(frozen=True)
class Table:
    """A title, a note below it, a header, rows of texts, and the indices of the rows that stand out."""

    title: str
    note: str
    header: tuple[str, ...]
    rows: list[tuple[str, ...]]
    strong: tuple[int, ...] = ()


def label(result: Mapping[str, Any]) -> str:
    """Name of a result's scene, with a mark where settings were chosen on it."""
    return f"{result['scene']}, {TUNED_MARK}" if result["tuned"] else str(result["scene"])


def made_by(results: Iterable[Mapping[str, Any]]) -> str:
    """Which state of flowsplat made some results, in a sentence; several are told, because figures may differ for that alone.

    >>> made_by([{"flowsplat": "1.0+a"}, {"flowsplat": "1.0+b"}, {"flowsplat": "1.0+b"}])
    'Made by 2 different states of flowsplat, of which figures may differ for that alone: 1.0+a (1 run), 1.0+b (2 runs).'
    """
    states = Counter(str(result.get("flowsplat", "of unknown version")) for result in results)
    if len(states) == 1:
        return f"Made by flowsplat {next(iter(states))}."
    told = ", ".join(f"{state} ({count} run{'' if count == 1 else 's'})" for state, count in sorted(states.items()))
    return f"Made by {len(states)} different states of flowsplat, of which figures may differ for that alone: {told}."


def text(value: float | None, digits: int, sign: bool = False) -> str:
    """A number, with its sign where that is asked for (zero has none but +); a dash for None.

    >>> text(1234.5, 1), text(0.25, 2, sign=True), text(None, 2)
    ('1,234.5', '+0.25', '–')
    """
    if value is None:
        return NOTHING
    return f"{round(value, digits) + 0.0:{'+' if sign else ''},.{digits}f}"


def scaled_mean(values: Iterable[float | None], factor: float = 1.0) -> float | None:
    """The mean of the values that are there times ``factor``, None if none is."""
    mean = mean_of(values)
    return None if mean is None else factor * mean


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]], strong: Sequence[int] = ()) -> list[str]:
    """The lines of a table; rows with the indices ``strong`` are bold."""
    lines = ["| " + " | ".join(header) + " |", "|" + " --- |" * len(header)]
    for k, row in enumerate(rows):
        lines.append("| " + " | ".join(f"**{cell}**" if k in strong else cell for cell in row) + " |")
    return lines


def markdown(title: str, remarks: Sequence[str], found: Sequence[Table], pictures: dict[str, Path] | None = None) -> str:
    """A page with all tables.

    Args:
        pictures: by the title of a table, the name of the picture that stands under it.
    """
    lines = [f"# {title}", "", *(f"- {remark}" for remark in remarks)]
    for each in found:
        lines += ["", f"## {each.title}", "", *markdown_table(each.header, each.rows, each.strong), "", each.note]
        if pictures and each.title in pictures:
            lines += ["", f"![{each.title}]({pictures[each.title].name})"]
    return "\n".join(lines) + "\n"
