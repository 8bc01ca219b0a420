"""What the pages of a run have in common: their look, and images beside each other. A page needs no network."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import jinja2
import numpy as np
from markupsafe import Markup

from flowsplat import __version__
from flowsplat.common.files import write_text
from flowsplat.images.colors import float_to_bytes
from flowsplat.images.html import image_tag

POLICY = "; ".join((
    "default-src 'none'", "img-src 'self' data: file:", "media-src 'self' data: file:", "style-src 'unsafe-inline'",
    "base-uri 'none'", "form-action 'none'",
))  # fmt: skip
"""What a browser lets a page do: show images and videos that it holds or that lie beside it, no script, no network."""
WIDEST = 960
"""Pixels of an image in a page."""


def script_policy(script: str) -> str:
    """``POLICY`` for a page that also runs this one script."""
    return f"{POLICY}; script-src 'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}'"


def write_page(path: Path, template: str, *, policy: str = POLICY, package: str = "flowsplat.output", **values: Any) -> None:
    """Fill a template and write the page.

    Args:
        template: its name in the folder ``templates`` of ``package``; it may extend those of this folder.
        policy: what a browser lets it do.

    Raises:
        InputError: it cannot be written.
    """
    loader = jinja2.ChoiceLoader([jinja2.PackageLoader(each, "templates") for each in dict.fromkeys((package, "flowsplat.output"))])
    environment = jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    write_text(path, environment.get_template(template).render(version=__version__, policy=policy, **values))


def card(value: Markup | str, unit: str, name: str, remark: str) -> dict[str, Any]:
    """One of the few figures on top of a page."""
    return {"value": value, "unit": unit, "name": name, "remark": remark}


def shrink_to_page(image: np.ndarray, widest: int = WIDEST) -> np.ndarray:
    """uint8, not wider than a page needs."""
    image = float_to_bytes(image)
    height, width = image.shape[:2]
    if width <= widest:
        return image
    return cv2.resize(image, (widest, max(round(height * widest / width), 1)), None, 0, 0, cv2.INTER_AREA)


def image_row(images: Mapping[str, np.ndarray], label: str) -> list[dict[str, Any]]:
    """Images by name, as the macro ``panels`` of the templates wants them."""
    return [{"name": name, "image": image_tag(shrink_to_page(image), f"{label}, {name}")} for name, image in images.items()]
