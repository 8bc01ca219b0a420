"""Pieces of a page that needs no other file: images inside the page, figures, tables.

Every piece is ``Markup``: text that went into it is escaped, and a template puts it in as it is.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from markupsafe import Markup, escape

from flowsplat.images.colors import float_to_bytes

MAX_IMAGE_WIDTH = 960
"""Pixels of an image in a page. Chosen by eye."""
THUMBNAIL_WIDTH = 320
"""Pixels of an image in a notebook. Chosen by eye."""
NOTHING = "–"
"""What stands in place of a figure that was not measured."""


def shrink_to_page(image: np.ndarray, widest: int = MAX_IMAGE_WIDTH) -> np.ndarray:
    """uint8, not wider than ``widest`` pixels."""
    image = float_to_bytes(image)
    height, width = image.shape[:2]
    if width <= widest:
        return image
    return cv2.resize(image, (widest, max(round(height * widest / width), 1)), None, 0, 0, cv2.INTER_AREA)


def encode(image: np.ndarray, quality: int | None = 88) -> bytes:
    """Return an image [H, W, 3] RGB, uint8 or float between 0 and 1, as a file: JPEG, or PNG for quality None."""
    options = [] if quality is None else [cv2.IMWRITE_JPEG_QUALITY, quality]
    suffix = ".png" if quality is None else ".jpg"
    ok, data = cv2.imencode(suffix, np.ascontiguousarray(float_to_bytes(image)[..., ::-1]), options)
    assert ok
    return bytes(data.tobytes())


def data_uri(image: np.ndarray, quality: int | None = 88) -> str:
    """``encode`` as a ``data:`` address."""
    kind = "png" if quality is None else "jpeg"
    return f"data:image/{kind};base64,{base64.b64encode(encode(image, quality)).decode()}"


def image_tag(image: np.ndarray, description: str, quality: int | None = 88) -> Markup:
    """Return an ``img`` with the image inside."""
    height, width = image.shape[:2]
    return Markup('<img src="{}" alt="{}" width="{}" height="{}" loading="lazy">').format(
        data_uri(image, quality), description, width, height
    )


def format_facts(title: str, facts: Mapping[str, str], image: np.ndarray | None) -> str:
    """Return what a notebook shows of something: its name, an image, and a table of what is known of it, by name."""
    rows = Markup().join(Markup("<tr><td>{}</td><td>{}</td></tr>").format(*fact) for fact in facts.items())
    shown = (
        Markup() if image is None else Markup('<img alt="" src="{}"><br>').format(data_uri(shrink_to_page(image, THUMBNAIL_WIDTH)))
    )
    return str(Markup("<div><b>{}</b><br>{}<table>{}</table></div>").format(title, shown, rows))


def figure(value: float | None, digits: int = 2, reason: str | None = None) -> Markup:
    """Return a number with that many digits behind the point; a dash, with the reason on hover, for None."""
    if value is not None and np.isfinite(value):
        return escape(f"{value:,.{digits}f}")
    if reason:
        return Markup('<span class="none" title="{}">{}</span>').format(reason, NOTHING)
    return Markup('<span class="none">{}</span>').format(NOTHING)


def table(header: Sequence[str], rows: Sequence[Sequence[str]], strong: Sequence[int] = ()) -> Markup:
    """Return a table whose first column names its rows; rows with the indices ``strong`` stand out."""
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
