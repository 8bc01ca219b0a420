"""Pieces of pages."""

from __future__ import annotations

import base64

import cv2
import numpy as np
import pytest

from flowsplat.images.html import NOTHING, data_uri, figure, image_tag, table

NASTY = '<script>alert("1")</script> & {0}'


@pytest.mark.parametrize("quality", [None, 90])
def test_data_uri_decodes_to_the_image(quality):
    image = np.full((8, 9, 3), (250, 120, 10), np.uint8)
    kind, encoded = data_uri(image, quality).split(";base64,")
    assert kind == ("data:image/png" if quality is None else "data:image/jpeg")
    back = cv2.imdecode(np.frombuffer(base64.b64decode(encoded), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert np.abs(back.astype(int) - image).max() <= (0 if quality is None else 6)


def test_image_escapes_its_description():
    tag = image_tag(np.zeros((2, 3, 3), np.uint8), NASTY)
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
