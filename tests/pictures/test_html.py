"""Pieces of pages."""

from __future__ import annotations

import base64
import re
import xml.etree.ElementTree as ElementTree

import cv2
import numpy as np
import pytest

from flowsplat.pictures.html import NOTHING, data_uri, figure, line_chart, picture, table

NASTY = '<script>alert("1")</script> & {0}'


def parse(svg: str) -> ElementTree.Element:
    return ElementTree.fromstring(svg)


def lines_of(svg: str) -> list[list[tuple[float, float]]]:
    found = [path.get("d") for path in parse(svg).iter("path") if path.get("class") == "line"]
    return [[tuple(map(float, p.split())) for p in re.findall(r"[ML]([\d. -]+)", d or "")] for d in found]


def texts_of(svg: str) -> list[str]:
    return [text.text or "" for text in parse(svg).iter("text")]


@pytest.mark.parametrize("quality", [None, 90])
def test_data_uri_decodes_to_the_picture(quality):
    image = np.full((8, 9, 3), (250, 120, 10), np.uint8)
    kind, encoded = data_uri(image, quality).split(";base64,")
    assert kind == ("data:image/png" if quality is None else "data:image/jpeg")
    back = cv2.imdecode(np.frombuffer(base64.b64decode(encoded), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert np.abs(back.astype(int) - image).max() <= (0 if quality is None else 6)


def test_picture_escapes_its_description():
    tag = picture(np.zeros((2, 3, 3), np.uint8), NASTY)
    assert "<script" not in tag
    assert 'width="3" height="2"' in tag


def test_figures():
    assert figure(31.4159) == "31.42"
    assert figure(12345, 0) == "12,345"
    assert NOTHING in figure(None)
    assert NOTHING in figure(float("nan"))
    assert 'title="no &lt;masks&gt;"' in figure(None, reason="no <masks>")


def test_table_escapes_text_and_keeps_pieces():
    html = table(("", NASTY), [(NASTY, figure(None)), ("b", "2")], strong=[1])
    assert "<script" not in html
    assert html.count('class="strong"') == 1
    assert '<span class="none">' in html


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
