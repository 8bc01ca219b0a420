"""Charts as SVG, inside a page or as a file of their own.

Inside a page they are ``Markup``, with every text escaped, and take their colors from it (``--ink``, ``--soft``, ``--line``, and
``--series-1`` to ``--series-5`` for what is drawn), so they follow its light or dark mode.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from markupsafe import Markup

Points = tuple[Sequence[float | None], Sequence[float | None]]
"""(x, y) of a line; None or what is not finite leaves a gap."""

MAX_SERIES = 5
"""Of a chart: each has a color of its own. Chosen by eye."""

_WIDTH, _HEIGHT = 640, 260
"""Size of a chart in units of its SVG. Chosen by eye."""
_LEFT, _RIGHT, _TOP, _BOTTOM = 58, 20, 12, 44
"""Room around the axes for their labels, in units of the SVG. Chosen by eye."""
_LEGEND_HEIGHT = 22
"""Height of the row with the names of the lines. Chosen by eye."""
_LETTER_WIDTH = 7
"""About the width of a letter, to put names beside each other."""
_MAX_POINTS = 400
"""Points of a line, at most: more than a chart has room for. Chosen by eye."""
_DOT_RADIUS = 3.0
"""Radius of a marked point. Chosen by eye."""
_NAMES_WIDTH = 292
"""Width of the column with the names of the bars. Chosen by eye."""
_BAR_HEIGHT = 10
"""Height of a bar; a row has two, and a gap as high as one. Chosen by eye."""
_FILE_STYLE = (
    ".chart{font:12px system-ui,sans-serif;background:#fff}.chart text{fill:#666b73}.chart .right{text-anchor:end}"
    ".chart .middle{text-anchor:middle}.chart .name{fill:#1c1e21}.chart .grid{stroke:#e2e3e6}"
    ".chart .axis{fill:none;stroke:#666b73}.chart .line{fill:none;stroke-width:1.8;stroke-linejoin:round}"
    ":root{--series-1:#0b62c4;--series-2:#c4560b;--series-3:#1d8a4e;--series-4:#8a3fb5;--series-5:#9a7a00}"
)
"""The look of a chart that stands alone: that of a light page."""


def svg_file(chart: Markup) -> str:
    """Return a chart as the content of an ``.svg`` file, which needs no page round it.

    Raises:
        ValueError: it is not a chart.
    """
    if not chart.startswith("<svg "):
        raise ValueError("only a chart can be a file of its own")
    alone = str(chart).replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" ', 1)
    return alone.replace("<title>", f"<style>{_FILE_STYLE}</style><title>", 1) + "\n"


def line_chart(
    series: Mapping[str, Points], *, title: str, x_label: str, y_label: str, log: bool = False, dots: bool = False
) -> Markup:
    """Return an SVG chart with one line for every named series (at most ``MAX_SERIES``), axes, grid and a legend.

    ``log`` draws y on a logarithmic axis; values that are not positive are left out then. ``dots`` marks every point.
    """
    if len(series) > MAX_SERIES:
        raise ValueError(f"a chart shows at most {MAX_SERIES} lines, not {len(series)}")
    lines = {name: _clean(points, log) for name, points in series.items()}
    xs, ys = (np.concatenate([line[k][np.isfinite(line[1])] for line in lines.values()] or [[]]) for k in (0, 1))
    if not len(xs):
        return Markup('<p class="none">{}: nothing was recorded.</p>').format(title)
    legend = _legend(list(lines)) if len(lines) > 1 else Markup()
    top = _TOP + _LEGEND_HEIGHT if legend else _TOP
    x_axis, y_axis = _Axis(xs, _LEFT, _WIDTH - _RIGHT), _Axis(ys, _HEIGHT - _BOTTOM, top, log)
    return Markup(
        '<svg class="chart" viewBox="0 0 {} {}" role="img" aria-label="{}"><title>{}</title>{}{}{}</svg>'
    ).format(
        _WIDTH, _HEIGHT, title, title, _axes(x_axis, y_axis, x_label, y_label),
        Markup().join(_path(line, x_axis, y_axis, index, dots) for index, line in enumerate(lines.values())), legend,
    )  # fmt: skip


def _clean(points: Points, log: bool) -> tuple[np.ndarray, np.ndarray]:
    """At most ``_MAX_POINTS`` means of neighboring points; gaps are NaN, y is log10 for a logarithmic axis."""
    x, y = (np.array([np.nan if value is None else value for value in part], np.float64) for part in points)
    y[~np.isfinite(y) | (y <= 0 if log else False)] = np.nan
    keep = np.isfinite(x)
    x, y = x[keep], np.log10(y[keep]) if log else y[keep]
    if len(x) > _MAX_POINTS:
        chunks = np.array_split(np.arange(len(x)), _MAX_POINTS)
        x, y = (np.array([part[chunk].mean() for chunk in chunks]) for part in (x, y))
    return x, y


class _Axis:
    """Values to places on the page, and the round values to mark."""

    def __init__(self, values: np.ndarray, start: float, end: float, log: bool = False):
        low, high = float(values.min()), float(values.max())
        if high - low < 1e-9 * max(abs(high), 1e-3):
            low, high = low - 0.5 * max(abs(low), 1), high + 0.5 * max(abs(high), 1)
        self.low, self.high, self.start, self.end = low, high, start, end
        self.ticks = _log_ticks(low, high) if log else _round_ticks(low, high)
        self._log = log

    def place(self, value: np.ndarray | float) -> np.ndarray:
        """Convert values (log10 of them on a logarithmic axis) to pixels of the drawing."""
        return self.start + (np.asarray(value) - self.low) / (self.high - self.low) * (self.end - self.start)

    def label(self, tick: float) -> str:
        """Return what to write at a tick."""
        return _short(10**tick if self._log else tick)


def _round_ticks(low: float, high: float) -> list[float]:
    """Return four to eight multiples of 1, 2 or 5 times a power of ten."""
    raw = (high - low) / 5
    power = 10.0 ** np.floor(np.log10(raw))
    step = power * min((1, 2, 5, 10), key=lambda factor: abs(np.log(factor * power / raw)))
    return [float(k * step) for k in range(int(np.ceil(low / step - 1e-9)), int(np.floor(high / step + 1e-9)) + 1)]


def _log_ticks(low: float, high: float) -> list[float]:
    """log10 of powers of ten, or of 1, 2 and 5 times them where few of those fit."""
    powers = range(int(np.floor(low)), int(np.ceil(high)) + 1)
    for factors in ((1,), (1, 2, 5)):
        ticks = [p + float(np.log10(f)) for p in powers for f in factors if low <= p + np.log10(f) <= high]
        if len(ticks) >= 3:
            return ticks
    return _round_ticks(low, high)


def _short(value: float) -> str:
    for limit, letter in ((1e9, "G"), (1e6, "M"), (1e4, "k")):
        if abs(value) >= limit:
            return f"{value / (1e3 if letter == 'k' else limit):.4g}{letter}"
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def bar_chart(
    bars: Mapping[str, Sequence[float | None]],
    names: Sequence[str],
    *,
    title: str,
    x_label: str,
    spreads: Mapping[str, float] | None = None,
) -> Markup:
    """Return an SVG chart with horizontal bars from zero, under each other: for every row one bar of each of the ``names``.

    Args:
        bars: by the name of the row, the values; None is no bar.
        names: what the values are, at most five.
        spreads: by the name of the row, how far the first value may be off; a thin line shows it.
    """
    if len(names) > MAX_SERIES or any(len(values) != len(names) for values in bars.values()):
        raise ValueError(f"every row needs one value for each of the {len(names)} names, and there are at most {MAX_SERIES}")
    spreads = spreads or {}
    known = [value for values in bars.values() for value in values if value is not None and np.isfinite(value)]
    if not known:
        return Markup('<p class="none">{}: nothing was recorded.</p>').format(title)
    ends = [values[0] + sign * spreads[row] for row, values in bars.items() if row in spreads and values[0] is not None
            for sign in (-1, 1)]  # fmt: skip
    row_height = _BAR_HEIGHT * (len(names) + 1)
    top = _TOP + _LEGEND_HEIGHT
    bottom = top + row_height * len(bars)
    x_axis = _Axis(np.array([0.0, *known, *ends]), _NAMES_WIDTH, _WIDTH - _RIGHT)
    parts = []
    for tick in x_axis.ticks:
        x = float(x_axis.place(tick))
        parts.append(Markup('<line class="grid" x1="{:.1f}" x2="{:.1f}" y1="{}" y2="{}"/>').format(x, x, top, bottom))
        parts.append(Markup('<text x="{:.1f}" y="{}" class="middle">{}</text>').format(x, bottom + 17, x_axis.label(tick)))
    zero = float(x_axis.place(0.0))
    for k, (row, values) in enumerate(bars.items()):
        upper = top + k * row_height + 0.5 * _BAR_HEIGHT
        middle = upper + 0.5 * _BAR_HEIGHT * len(names)
        parts.append(Markup('<text x="{}" y="{:.1f}" class="right name">{}</text>').format(_NAMES_WIDTH - 8, middle + 4, row))
        for series, value in enumerate(values):
            if value is not None and np.isfinite(value):
                end = float(x_axis.place(value))
                bar = Markup('<rect class="bar" style="fill:var(--series-{})" x="{:.1f}" y="{:.1f}" width="{:.1f}" height="{}"/>')
                parts.append(
                    bar.format(series + 1, min(zero, end), upper + series * _BAR_HEIGHT, max(abs(end - zero), 0.5), _BAR_HEIGHT - 1)
                )
        if row in spreads and values[0] is not None:
            low, high = (float(x_axis.place(values[0] + sign * spreads[row])) for sign in (-1, 1))
            parts.append(
                Markup('<path class="axis" d="M{:.1f} {:.1f}H{:.1f}"/>').format(low, upper + 0.5 * (_BAR_HEIGHT - 1), high)
            )
    parts.append(Markup('<path class="axis" d="M{:.1f} {}V{}"/>').format(zero, top, bottom))
    label = Markup('<text x="{:.1f}" y="{}" class="middle name">{}</text>')
    parts.append(label.format(0.5 * (x_axis.start + x_axis.end), bottom + 36, x_label))
    return Markup('<svg class="chart" viewBox="0 0 {} {}" role="img" aria-label="{}"><title>{}</title>{}{}</svg>').format(
        _WIDTH, bottom + _BOTTOM, title, title, Markup().join(parts), _legend(names)
    )


def _axes(x_axis: _Axis, y_axis: _Axis, x_label: str, y_label: str) -> Markup:
    """Grid, ticks and the names of the axes."""
    left, right, top, bottom = x_axis.start, x_axis.end, y_axis.end, y_axis.start
    parts = []
    for tick in y_axis.ticks:
        y = float(y_axis.place(tick))
        parts.append(Markup('<line class="grid" x1="{}" x2="{}" y1="{:.1f}" y2="{:.1f}"/>').format(left, right, y, y))
        parts.append(Markup('<text x="{}" y="{:.1f}" class="right">{}</text>').format(left - 7, y + 4, y_axis.label(tick)))
    for tick in x_axis.ticks:
        x = float(x_axis.place(tick))
        parts.append(Markup('<text x="{:.1f}" y="{}" class="middle">{}</text>').format(x, bottom + 17, x_axis.label(tick)))
    parts.append(Markup('<path class="axis" d="M{} {}V{}H{}"/>').format(left, top, bottom, right))
    middle_x, middle_y = (left + right) / 2, (top + bottom) / 2
    parts.append(Markup('<text x="{}" y="{}" class="middle name">{}</text>').format(middle_x, _HEIGHT - 8, x_label))
    turned = Markup('<text transform="translate(13 {}) rotate(-90)" class="middle name">{}</text>')
    parts.append(turned.format(middle_y, y_label))
    return Markup().join(parts)


def _path(line: tuple[np.ndarray, np.ndarray], x_axis: _Axis, y_axis: _Axis, index: int, dots: bool) -> Markup:
    commands, marks, pen_down = [], [], False
    dot = Markup('<circle class="dot" style="fill:var(--series-{})" cx="{:.1f}" cy="{:.1f}" r="{}"/>')
    for x, y in zip(x_axis.place(line[0]), y_axis.place(line[1]), strict=True):
        if np.isfinite(y):
            commands.append(f"{'L' if pen_down else 'M'}{x:.1f} {y:.1f}")
            marks.append(dot.format(index + 1, x, y, _DOT_RADIUS))
        pen_down = bool(np.isfinite(y))
    path = Markup('<path class="line" style="stroke:var(--series-{})" d="{}"/>').format(index + 1, "".join(commands))
    return path + Markup().join(marks) if dots else path


def _legend(names: Sequence[str]) -> Markup:
    """Return the names of the lines, in a row above the chart."""
    entries = []
    x = _LEFT
    for index, name in enumerate(names):
        entry = Markup(
            '<line class="line" style="stroke:var(--series-{})" x1="{}" x2="{}" y1="{}" y2="{}"/><text x="{}" y="{}">{}</text>'
        )
        entries.append(entry.format(index + 1, x, x + 18, _TOP, _TOP, x + 24, _TOP + 4, name))
        x += 24 + _LETTER_WIDTH * len(name) + 18
    return Markup().join(entries)
