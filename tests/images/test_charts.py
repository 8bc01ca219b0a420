"""Charts."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from flowsplat.images.charts import bar_chart, line_chart, svg_file

NASTY = '<script>alert("1")</script> & {0}'


def parse(svg: str) -> ElementTree.Element:
    return ElementTree.fromstring(svg)


def lines_of(svg: str) -> list[list[tuple[float, float]]]:
    found = [path.get("d") for path in parse(svg).iter("path") if path.get("class") == "line"]
    return [[tuple(map(float, p.split())) for p in re.findall(r"[ML]([\d. -]+)", d or "")] for d in found]


def texts_of(svg: str) -> list[str]:
    return [text.text or "" for text in parse(svg).iter("text")]


def test_chart_maps_values_to_places():
    svg = line_chart({"loss": ([0, 50, 100], [1.0, 3.0, 2.0])}, title="Loss", x_label="step", y_label="loss")
    ((x0, y0), (x1, y1), (x2, y2)) = lines_of(svg)[0]
    assert x0 < x1 < x2
    assert x1 - x0 == pytest.approx(x2 - x1, abs=0.2)
    assert y1 < y2 < y0, "the page's y grows downwards"
    assert y2 - y1 == pytest.approx(y0 - y2, abs=0.2)
    assert {"step", "loss", "0", "100", "1", "2", "3"} <= set(texts_of(svg))


def test_chart_on_a_logarithmic_axis():
    svg = line_chart({"a": ([1, 2, 3, 4], [100.0, 10.0, 0.0, 1.0])}, title="t", x_label="x", y_label="y", log=True)
    (first, second, last) = lines_of(svg)[0]
    assert second[1] - first[1] == pytest.approx(last[1] - second[1], abs=0.2)
    assert {"1", "10", "100"} <= set(texts_of(svg))


def test_chart_with_gaps_and_many_points():
    x = list(range(5000))
    y = [None if 2000 <= k < 3000 else float(np.sin(k / 500)) for k in x]
    svg = line_chart({"a": (x, y), "b": (x, [0.5] * 5000)}, title="t", x_label="x", y_label="y")
    first, second = (path.get("d") or "" for path in parse(svg).iter("path") if path.get("class") == "line")
    assert first.count("M") == 2
    assert second.count("M") == 1
    assert second.count("L") < 500
    assert {"a", "b"} <= set(texts_of(svg)), "two lines need a legend"


@pytest.mark.parametrize("values", [[5.0], [0.0, 0.0], [1e-9, 1e-9], [1e7, 3e7], [-2.0, float("inf")]])
def test_chart_of_odd_values_is_drawn(values):
    svg = line_chart({"a": (list(range(len(values))), values)}, title="t", x_label="x", y_label="y")
    assert "nan" not in svg
    assert "inf" not in svg
    assert len(lines_of(svg)[0]) >= 1


def test_chart_without_values_says_so_and_names_are_escaped():
    assert "nothing was recorded" in line_chart({"a": ([1], [None])}, title="Loss", x_label="x", y_label="y")
    svg = line_chart({NASTY: ([0, 1], [1, 2]), "b": ([0, 1], [1, 2])}, title=NASTY, x_label=NASTY, y_label=NASTY)
    parse(svg)
    assert "<script" not in svg
    with pytest.raises(ValueError, match="at most 5"):
        line_chart({str(k): ([0], [1]) for k in range(6)}, title="t", x_label="x", y_label="y")


def test_dots_mark_every_point():
    svg = line_chart({"a": ([1, 2, 3], [1.0, None, 2.0])}, title="t", x_label="x", y_label="y", dots=True)
    assert len(list(parse(svg).iter("circle"))) == 2


def rectangles(svg: str) -> list[tuple[float, float]]:
    """(left, right) of the bars."""
    found = [(float(bar.get("x") or 0), float(bar.get("width") or 0)) for bar in parse(svg).iter("rect")]
    return [(x, x + width) for x, width in found]


def test_bars_start_at_zero_and_end_at_their_values():
    bars = {"worse": (-2.0, -1.0), "better": (1.0, None)}
    svg = bar_chart(bars, ("ours", "theirs"), title="Bars", x_label="dB", spreads={"worse": 0.5})
    ours, theirs, better = rectangles(svg)
    assert [ours[1], theirs[1]] == pytest.approx([better[0]] * 2, abs=0.2), "all of them begin at zero"
    length = ours[1] - ours[0]
    assert theirs[1] - theirs[0] == pytest.approx(length / 2, abs=0.2)
    assert better[1] - better[0] == pytest.approx(length / 2, abs=0.2)
    spread = re.search(r"M([\d.]+) [\d.]+H([\d.]+)", svg)
    assert spread is not None
    assert float(spread[2]) - float(spread[1]) == pytest.approx(length / 2, abs=0.2)
    assert {"worse", "better", "ours", "theirs", "dB", "0", "-2", "1"} <= set(texts_of(svg))


def test_bars_of_nothing_and_of_odd_names():
    assert "nothing was recorded" in bar_chart({"a": (None,)}, ("ours",), title="Bars", x_label="dB")
    assert "<script" not in bar_chart({NASTY: (0.0,)}, (NASTY,), title=NASTY, x_label=NASTY)
    with pytest.raises(ValueError, match="one value for each"):
        bar_chart({"a": (1.0,)}, ("ours", "theirs"), title="Bars", x_label="dB")


def test_a_chart_as_a_file_stands_alone():
    chart = line_chart({"a": ([1, 2], [1, 2])}, title="t", x_label="x", y_label="y")
    root = parse(svg_file(chart))
    assert root.tag == "{http://www.w3.org/2000/svg}svg"
    assert "--series-1:" in svg_file(chart)
    with pytest.raises(ValueError, match="only a chart"):
        svg_file(line_chart({"a": ([1], [None])}, title="t", x_label="x", y_label="y"))
