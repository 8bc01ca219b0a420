"""Pieces of a page that needs no other file: pictures inside the page, line charts as SVG, tables.

Every piece is ``Markup``: text that went into it is escaped, and a template puts it in as it is. Charts take their
colours from the page (``currentColor``, and ``--series-1`` to ``--series-5`` for the lines), so they follow its light
or dark mode.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from markupsafe import Markup, escape

from flowsplat.pictures.colors import float_to_bytes

Points = tuple[Sequence[float | None], Sequence[float | None]]
"""(x, y) of a line; None or what is not finite leaves a gap."""

NOTHING = "–"
"""What stands in place of a figure that was not measured."""

_WIDTH, _HEIGHT = 640, 260
_LEFT, _RIGHT, _TOP, _BOTTOM = 58, 14, 12, 44
_LEGEND = 22
"""Height of the row with the names of the lines."""
_LETTER = 7
"""About the width of a letter, to put names beside each other."""
_MOST_POINTS = 400
_SERIES = 5


def data_uri(image: np.ndarray, quality: int | None = 88) -> str:
    """A picture [H, W, 3] RGB, uint8 or float between 0 and 1, as a ``data:`` address; JPEG, or PNG for quality None."""
    suffix, kind = (".png", "png") if quality is None else (".jpg", "jpeg")
    options = [] if quality is None else [cv2.IMWRITE_JPEG_QUALITY, quality]
    ok, encoded = cv2.imencode(suffix, np.ascontiguousarray(float_to_bytes(image)[..., ::-1]), options)
    assert ok
    return f"data:image/{kind};base64,{base64.b64encode(encoded.tobytes()).decode()}"


def picture(image: np.ndarray, description: str, quality: int | None = 88) -> Markup:
    """An ``img`` with the picture inside."""
    height, width = image.shape[:2]
    return Markup('<img src="{}" alt="{}" width="{}" height="{}" loading="lazy">').format(
        data_uri(image, quality), description, width, height
    )


def figure(value: float | None, digits: int = 2, reason: str | None = None) -> Markup:
    """A number with that many digits behind the point; a dash, with the reason on hover, for None."""
    if value is not None and np.isfinite(value):
        return escape(f"{value:,.{digits}f}")
    if reason:
        return Markup('<span class="none" title="{}">{}</span>').format(reason, NOTHING)
    return Markup('<span class="none">{}</span>').format(NOTHING)


def table(header: Sequence[str], rows: Sequence[Sequence[str]], strong: Sequence[int] = ()) -> Markup:
    """A table whose first column names its rows; rows with the indices ``strong`` stand out."""
    head = Markup().join(Markup('<th scope="col">{}</th>').format(cell) for cell in header)
    body = Markup().join(
        Markup('<tr{}><th scope="row">{}</th>{}</tr>').format(
            Markup(' class="strong"') if index in strong else Markup(),
            row[0],
            Markup().join(Markup("<td>{}</td>").format(cell) for cell in row[1:]),
        )
        for index, row in enumerate(rows)
    )
    return Markup('<div class="scroll"><table><thead><tr>{}</tr></thead><tbody>{}</tbody></table></div>').format(head, body)


def line_chart(series: Mapping[str, Points], *, title: str, x_label: str, y_label: str, log: bool = False) -> Markup:
    """An SVG chart with one line for every named series (at most five), axes, grid and a legend.

    ``log`` draws y on a logarithmic axis; values that are not positive are left out then.
    """
    if len(series) > _SERIES:
        raise ValueError(f"a chart shows at most {_SERIES} lines, not {len(series)}")
    lines = {name: _clean(points, log) for name, points in series.items()}
    xs, ys = (np.concatenate([line[k][np.isfinite(line[1])] for line in lines.values()] or [[]]) for k in (0, 1))
    if not len(xs):
        return Markup('<p class="none">{}: nothing was recorded.</p>').format(title)
    legend = _legend(list(lines)) if len(lines) > 1 else Markup()
    top = _TOP + _LEGEND if legend else _TOP
    x_axis, y_axis = _Axis(xs, _LEFT, _WIDTH - _RIGHT), _Axis(ys, _HEIGHT - _BOTTOM, top, log)
    return Markup(
        '<svg class="chart" viewBox="0 0 {} {}" role="img" aria-label="{}"><title>{}</title>{}{}{}</svg>'
    ).format(
        _WIDTH, _HEIGHT, title, title, _axes(x_axis, y_axis, x_label, y_label),
        Markup().join(_path(line, x_axis, y_axis, index) for index, line in enumerate(lines.values())), legend,
    )  # fmt: skip


def _clean(points: Points, log: bool) -> tuple[np.ndarray, np.ndarray]:
    """At most ``_MOST_POINTS`` means of neighbouring points; gaps are NaN, y is log10 for a logarithmic axis."""
    x, y = (np.array([np.nan if value is None else value for value in part], np.float64) for part in points)
    y[~np.isfinite(y) | (y <= 0 if log else False)] = np.nan
    keep = np.isfinite(x)
    x, y = x[keep], np.log10(y[keep]) if log else y[keep]
    if len(x) > _MOST_POINTS:
        chunks = np.array_split(np.arange(len(x)), _MOST_POINTS)
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
        """Values (log10 of them on a logarithmic axis) to pixels of the drawing."""
        return self.start + (np.asarray(value) - self.low) / (self.high - self.low) * (self.end - self.start)

    def label(self, tick: float) -> str:
        """What to write at a tick."""
        return _short(10**tick if self._log else tick)


def _round_ticks(low: float, high: float) -> list[float]:
    """Four to eight multiples of 1, 2 or 5 times a power of ten."""
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


def _path(line: tuple[np.ndarray, np.ndarray], x_axis: _Axis, y_axis: _Axis, index: int) -> Markup:
    commands, pen_down = [], False
    for x, y in zip(x_axis.place(line[0]), y_axis.place(line[1]), strict=True):
        if np.isfinite(y):
            commands.append(f"{'L' if pen_down else 'M'}{x:.1f} {y:.1f}")
        pen_down = bool(np.isfinite(y))
    return Markup('<path class="line" style="stroke:var(--series-{})" d="{}"/>').format(index + 1, "".join(commands))


def _legend(names: Sequence[str]) -> Markup:
    """The names of the lines, in a row above the chart."""
    entries = []
    x = _LEFT
    for index, name in enumerate(names):
        entry = Markup(
            '<line class="line" style="stroke:var(--series-{})" x1="{}" x2="{}" y1="{}" y2="{}"/><text x="{}" y="{}">{}</text>'
        )
        entries.append(entry.format(index + 1, x, x + 18, _TOP, _TOP, x + 24, _TOP + 4, name))
        x += 24 + _LETTER * len(name) + 18
    return Markup().join(entries)
