"""Tables of figures, as data and as Markdown."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup

from flowsplat.evaluation.scores import mean_of, pick
from flowsplat.images.html import NOTHING

Result = Mapping[str, Any]
"""The JSON of what was measured: of a run, a scene or a world."""

TUNED_MARK = "*tuned*"
"""Behind the name of a scene on which settings were chosen."""


@dataclass(frozen=True)
class Chart:
    """A drawing that belongs to a table: the name of its file, the SVG, and what it shows where that is not all of the table."""

    file: str
    drawing: Markup
    title: str = ""


@dataclass(frozen=True)
class Table:
    """A title, a note below it, a header, rows of texts in Markdown, the indices of the rows that stand out, and drawings."""

    title: str
    note: str
    header: tuple[str, ...]
    rows: list[tuple[str, ...]]
    strong: tuple[int, ...] = ()
    charts: tuple[Chart, ...] = ()


@dataclass(frozen=True)
class Column:
    """A figure that a table has of its results.

    Attributes:
        header: what stands over it.
        path: its keys in a result.
        digits: behind the point.
        factor: by which it is multiplied before it is written.
        sign: whether it is written with one.
    """

    header: str
    path: tuple[str, ...]
    digits: int = 2
    factor: float = 1.0
    sign: bool = False

    def is_in(self, results: Iterable[Result]) -> bool:
        """Return whether any of the results has it."""
        return any(pick(result, *self.path) is not None for result in results)

    def cell(self, *results: Result) -> str:
        """Return the mean of the results that have it; a dash where none has."""
        return text(compute_scaled_mean((pick(result, *self.path) for result in results), self.factor), self.digits, self.sign)


def label(result: Result) -> str:
    """Name of a result's scene, with a mark where settings were chosen on it."""
    return f"{result['scene']}, {TUNED_MARK}" if result["tuned"] else str(result["scene"])


def describe_version(results: Iterable[Result]) -> str:
    """Return which state of flowsplat made some results, in a sentence; several are told, because figures may differ for that
    alone.

    >>> describe_version([{"flowsplat": "1.0+a"}, {"flowsplat": "1.0+b"}, {"flowsplat": "1.0+b"}])
    'Made by 2 different states of flowsplat, of which figures may differ for that alone: 1.0+a (1 run), 1.0+b (2 runs).'
    """
    states = Counter(str(result.get("flowsplat", "of unknown version")) for result in results)
    if len(states) == 1:
        return f"Made by flowsplat {next(iter(states))}."
    told = ", ".join(f"{state} ({count} run{'' if count == 1 else 's'})" for state, count in sorted(states.items()))
    return f"Made by {len(states)} different states of flowsplat, of which figures may differ for that alone: {told}."


def text(value: float | None, digits: int, sign: bool = False) -> str:
    """Return a number, with its sign where that is asked for (zero has none but +); a dash for None.

    >>> text(1234.5, 1), text(0.25, 2, sign=True), text(None, 2)
    ('1,234.5', '+0.25', '–')
    """
    if value is None:
        return NOTHING
    return f"{round(value, digits) + 0.0:{'+' if sign else ''},.{digits}f}"


def compute_scaled_mean(values: Iterable[float | None], factor: float = 1.0) -> float | None:
    """Return the mean of the values that are there times ``factor``, None if none is."""
    mean = mean_of(values)
    return None if mean is None else factor * mean


def format_table(header: Sequence[str], rows: Iterable[Sequence[str]], strong: Sequence[int] = ()) -> list[str]:
    """Return the lines of a table; rows with the indices ``strong`` are bold."""
    lines = ["| " + " | ".join(header) + " |", "|" + " --- |" * len(header)]
    for k, row in enumerate(rows):
        lines.append("| " + " | ".join(f"**{cell}**" if k in strong and cell else cell for cell in row) + " |")
    return lines


def plain(cell: str) -> str:
    """Return a cell without Markdown's emphasis.

    >>> plain("bear, *tuned*"), plain("2 * 3")
    ('bear, tuned', '2 * 3')
    """
    return re.sub(r"\*(\w[^*]*)\*", r"\1", cell)


def format_page(title: str, remarks: Sequence[str], found: Sequence[Table]) -> str:
    """Return a page with all tables; the charts of one stand under it, by the names of their files."""
    lines = [f"# {title}", "", *(f"- {remark}" for remark in remarks)]
    for each in found:
        lines += ["", f"## {each.title}", "", *format_table(each.header, each.rows, each.strong), "", each.note]
        for chart in each.charts:
            lines += ["", f"![{chart.title or each.title}]({chart.file})"]
    return "\n".join(lines) + "\n"
