"""Videos of a trained scene: along the clip's own cameras, round its middle, with time standing still, along a given path.

A path gives two files: ``<name>.mp4`` with colour, flow and depth beside each other, and ``<name>_colour.mp4`` with the
colour alone; what else there is (stereo pairs, movers on transparent, a wiggle) gives one. ``renders.json`` beside them
tells what they were made of; a video that is there and would come out the same is not rendered again.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from flowsplat import __version__
from flowsplat.common.files import read_json, write_json
from flowsplat.gaussians.rendering import PartedRenderer
from flowsplat.output.videos.options import RenderOptions
from flowsplat.output.videos.plans import Plan, plan_videos
from flowsplat.output.videos.writing import Scales, write_plan
from flowsplat.scenes import Scene

__all__ = ["RenderOptions", "render_videos"]


def render_videos(model: PartedRenderer, scene: Scene, folder: Path, options: RenderOptions) -> dict[str, str]:
    """Render the videos that ``options`` ask for into ``folder``.

    Returns:
        what was made, by name, to the file's name in ``folder``: ``input_path``, ``stabilised``, ``orbit``,
        ``bullet_time``, ``dolly_zoom``, ``wiggle`` and ``custom_path``, with ``_slow4`` where time plays four times slower,
        ``_background`` or ``_movers`` where a part is shown, then ``_stereo`` or ``_colour`` for the other files.

    Raises:
        InputError: an option or the camera file cannot be used, or the folder cannot be written.
    """
    book_path = Path(folder) / "renders.json"
    book: dict[str, Any] = read_json(book_path) if book_path.exists() else {}
    plans = plan_videos(model, scene, options)
    parts = {part: model.part(part) for part in options.parts}
    made: dict[str, str] = {}
    for plan in plans:
        shown = parts[plan.part]
        scales = Scales.of(shown, plan.shots)
        entry = {"key": _key(plan, scales), "fps": plan.fps, "frames": len(plan.shots), "files": plan.files}
        if book.get(plan.name) != entry or not all((Path(folder) / file).exists() for file in plan.files):
            write_plan(shown, plan, scales, Path(folder))
            book[plan.name] = entry
            write_json(book_path, book)
        made |= dict(zip((plan.name, f"{plan.name}_colour"), plan.files))  # noqa: B905 (there may be one file only)
    return made


def _key(plan: Plan, scales: Scales) -> str:
    """A hash of all that a video depends on; what the model is shows in the shots that were looked at."""
    text = json.dumps([__version__, plan.to_json(), scales.looks])
    return hashlib.sha256(text.encode()).hexdigest()[:16]
