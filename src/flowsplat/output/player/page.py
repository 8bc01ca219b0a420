"""The player as one HTML file: no network, no server, nothing to install; the scene is inside."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import quote

import jinja2
import numpy as np
from markupsafe import Markup, escape

from flowsplat.common.errors import InputError
from flowsplat.common.files import write_text
from flowsplat.gaussians.model import SceneModel
from flowsplat.geometry import Camera
from flowsplat.images.html import data_uri
from flowsplat.output.player.camera_paths import camera_paths
from flowsplat.output.player.pack import pack
from flowsplat.output.text_encoding import encode_text
from flowsplat.output.videos.amplitudes import DEFAULT_WIDTHS, LoopWidths

SCRIPTS = (
    "scene.js", "cameras.js", "camera_paths.js", "elastic_view.js", "sorter.js", "renderer.js", "recording.js",
    "sharing.js", "controls.js", "main.js",
)  # fmt: skip
"""In the order in which they stand in the page."""
SHADERS = (
    "slice.glsl", "slice.frag", "splat.vert", "splat.frag", "whole.vert", "shrink.frag", "spread.frag", "present.frag",
)  # fmt: skip
DATA_OPENING = '<script id="data" type="text/plain">'
"""Of the element in which the scene lies."""
_POSTER_QUALITY = 80
"""Of the JPEG of the poster. Chosen by eye."""


def write_player(
    path: Path, model: SceneModel, times: Sequence[float], cameras: Sequence[Camera], title: str,
    widths: LoopWidths = DEFAULT_WIDTHS,
) -> Path:  # fmt: skip
    """Write the page.

    Args:
        path: the ``.html`` file.
        model: the scene.
        times: [T] seconds of the clip's frames, two or more.
        cameras: [T] its cameras, in the coordinates of the scene: the path that the player follows.
        title: name of the clip.
        widths: how far from there the camera may go.

    Raises:
        InputError: there is nothing to show, or the file cannot be written.
    """
    if not len(model.gaussians):
        raise InputError("The scene has no Gaussians: there is nothing to show.")
    packed = pack(model, times, cameras, title)
    cameras_about = camera_paths(model, times, cameras, widths)
    poster = model.render(cameras[0], float(times[0])).color
    template = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined).from_string(read_asset("player.html"))
    script = player_script()
    page = template.render(
        title=title,
        paths=cameras_about["paths"],
        policy=make_policy(script),
        poster=data_uri(np.ascontiguousarray(poster), _POSTER_QUALITY),
        about=make_json({**packed.about, "bytes": len(packed.data), **cameras_about}),
        shaders=make_json({name: read_asset(name) for name in SHADERS}),
        data=Markup(encode_text(packed.data)),
        script=Markup(script),
    )
    write_text(path, page)
    return Path(path)


def make_iframe(page: Path, title: str, width: int, height: int) -> str:
    """Return the HTML that shows a page of the player in another page, playing and without its controls, with images of that
    size in pixels, where both files lie in one folder."""
    return (
        f'<iframe src="{quote(page.name)}#embed" title="{escape(title)}" width="{width}" height="{height}" loading="lazy" '
        f'allow="fullscreen" style="border:0;max-width:100%;height:auto;aspect-ratio:{width}/{height}"></iframe>'
    )


def player_script() -> str:
    """Return the script of the page."""
    return "\n".join(("", '"use strict";', *map(read_asset, SCRIPTS), ""))


def make_policy(*scripts: str) -> str:
    """Return what a browser lets the page do: run these scripts and its worker, show what the page holds, and fetch nothing."""
    digests = (base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts)
    run = " ".join(("script-src", *(f"'sha256-{digest}'" for digest in digests)))
    allowed = (run, "worker-src blob:", "img-src data: blob:", "style-src 'unsafe-inline'")
    return "; ".join(("default-src 'none'", *allowed, "base-uri 'none'", "form-action 'none'"))


def read_asset(name: str) -> str:
    """Return the text of a file of the page."""
    return (files("flowsplat.output.player") / "assets" / name).read_text(encoding="utf-8")


def make_json(value: Any) -> Markup:
    """Return JSON that may stand in a script element, whatever names it holds."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    return Markup(text.replace("<", "\\u003c"))
