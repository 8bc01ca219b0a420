"""A scene's ``scene.json`` changed from outside, as other tools or a damaged disk may."""

from __future__ import annotations

from typing import Any

from flowsplat.common.files import read_json, write_json
from flowsplat.scenes import Scene


def edited(scene: Scene, priors: dict[str, dict[str, Any]] | None = None, **values: Any) -> Scene:
    """The scene with other values in its file, opened again.

    Args:
        priors: how priors were made; those that are not named stay.
    """
    path = scene.folder / "scene.json"
    content = read_json(path)
    content["priors"] |= priors or {}
    write_json(path, content | values)
    return Scene(scene.folder)
