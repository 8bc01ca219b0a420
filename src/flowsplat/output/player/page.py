"""The player as one HTML file: no network, no server, nothing to install; the scene is inside."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup

from flowsplat.common.errors import InputError
from flowsplat.common.files import write_text
from flowsplat.gaussians.model import SceneModel
from flowsplat.geometry import Camera
from flowsplat.images.html import data_uri
from flowsplat.output.player.camera_paths import DEFAULT_DOLLY, DEFAULT_SWING, camera_paths
from flowsplat.output.player.pack import pack

SCRIPTS = ("scene.js", "cameras.js", "camera_paths.js", "sorter.js", "renderer.js", "controls.js", "main.js")
"""In the order in which they stand in the page."""
SHADERS = (
    "slice.glsl", "slice.frag", "splat.vert", "splat.frag", "whole.vert", "shrink.frag", "spread.frag", "present.frag",
)  # fmt: skip
_POSTER_QUALITY = 80
"""Of the JPEG of the poster. Chosen by eye."""


def write_player(
    path: Path, model: SceneModel, times: Sequence[float], cameras: Sequence[Camera], title: str,
    widths: tuple[float, float] = (DEFAULT_SWING, DEFAULT_DOLLY),
) -> Path:  # fmt: skip
    """Write the page.

    Args:
        path: the ``.html`` file.
        model: the scene.
        times: [T] seconds of the clip's frames, two or more.
        cameras: [T] its cameras, in the coordinates of the scene: the path that the player follows.
        title: name of the clip.
        widths: degrees to either side of loops, and how many times as far a dolly zoom goes.

    Raises:
        InputError: there is nothing to show, or the file cannot be written.
    """
    if not len(model.gaussians):
        raise InputError("The scene has no Gaussians: there is nothing to show.")
    packed = pack(model, times, cameras, title)
    cameras_about = camera_paths(model, times, cameras, widths)
    poster = model.render(cameras[0], float(times[0])).color
    template = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined).from_string(_asset("player.html"))
    script = "\n".join(("", '"use strict";', *map(_asset, SCRIPTS), ""))
    page = template.render(
        title=title,
        paths=cameras_about["paths"],
        policy=_policy(script),
        poster=data_uri(np.ascontiguousarray(poster), _POSTER_QUALITY),
        about=_json({**packed.about, **cameras_about}),
        shaders=_json({name: _asset(name) for name in SHADERS}),
        data=Markup(base64.b64encode(packed.data).decode()),
        script=Markup(script),
    )
    write_text(path, page)
    return Path(path)


def _policy(script: str) -> str:
    """Return what a browser lets the page do: run this script and its worker, show what the page holds, and fetch nothing."""
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    allowed = (f"script-src 'sha256-{digest}'", "worker-src blob:", "img-src data: blob:", "style-src 'unsafe-inline'")
    return "; ".join(("default-src 'none'", *allowed, "base-uri 'none'", "form-action 'none'"))


def _asset(name: str) -> str:
    return (files("flowsplat.output.player") / "assets" / name).read_text(encoding="utf-8")


def _json(value: Any) -> Markup:
    """JSON that may stand in a script element, whatever names it holds."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    return Markup(text.replace("<", "\\u003c"))
