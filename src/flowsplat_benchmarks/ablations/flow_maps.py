"""The paper's figure that compares flow maps: flow that is rendered of its baseline, without parts of its method, and of all of it.

All maps of a scene are of the same two frames and have the same colors, those of the flow prior's range.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flowsplat.gaussians.model import SceneModel
from flowsplat.images.colors import flow_scale, flow_to_color
from flowsplat.images.sheets import side_by_side, stack
from flowsplat.scenes import Scene
from flowsplat.scenes.layers import read_image, write_image
from flowsplat_benchmarks.ablations.page import scene_names
from flowsplat_benchmarks.reports import scene_section
from flowsplat_benchmarks.tables import Result

FOLDER = "flow_maps"
"""Of the folder of results, with one image a run, and those of the scene."""
COMPARED_VARIANTS = {
    "4dgs": "baseline (4DGS)", "linear": "w/o 4D Gaussian", "no-velocity": "w/o velocity loss", "random": "w/o initialization",
    "full": "full",
}  # fmt: skip
"""The variants of the paper's figure, in its order, by what it calls them."""
COLUMNS = 4
"""Images beside each other in a sheet: the frame and the prior come first."""
TITLE = "Flow maps (the paper's figure)"


def choose_frames(scene: Scene) -> tuple[int, int]:
    """Return the frames whose flow is shown: the middle training frame, and the next one."""
    k = (len(scene.train_frames) - 1) // 2
    return scene.train_frames[k], scene.train_frames[k + 1]


def write_flow_map(out: Path, name: str, variant: str, model: SceneModel, scene: Scene) -> None:
    """Write ``OUT/flow_maps/<name>_<variant>.png``, and those of the frame and the flow prior where they are not there yet.

    Args:
        name: of the prepared scene.

    Raises:
        InputError: the folder cannot be written.
    """
    i, j = choose_frames(scene)
    prior = scene.flow(i, j).flow
    scale = flow_scale([prior])
    times = [float(scene.timestamps[k]) for k in (i, j)]
    rendering = model.render(scene.cameras[i], times[0], (scene.cameras[j], times[1]))
    assert rendering.flow is not None
    images = {variant: flow_to_color(rendering.flow, scale), "frame": scene.frame(i), "prior": flow_to_color(prior, scale)}
    (out / FOLDER).mkdir(parents=True, exist_ok=True)
    for each, image in images.items():
        write_image(out / FOLDER / f"{name}_{each}.png", image)


def list_flow_maps(out: Path, results: Sequence[Result]) -> Iterator[dict[str, Any]]:
    """Yield what the page says of each scene of which there are maps, and write ``OUT/flow_maps/<name>.png`` with all of them."""
    for name, title in scene_names(results).items():
        known = {"frame": "frame", "prior": "flow prior", **COMPARED_VARIANTS}
        paths = {label: out / FOLDER / f"{name}_{each}.png" for each, label in known.items()}
        images = {label: read_image(path) for label, path in paths.items() if path.exists()}
        if len(images) <= 2:
            continue
        blank = np.full_like(next(iter(images.values())), 255)
        cells = [*images.items(), *[("", blank)] * (-len(images) % COLUMNS)]
        rows = [cells[k : k + COLUMNS] for k in range(0, len(cells), COLUMNS)]
        sheet = stack([side_by_side([image for _, image in row], [label for label, _ in row]) for row in rows])
        write_image(out / FOLDER / f"{name}.png", sheet)
        shown = "Flow to the next training frame, rendered by flow splatting; hue is direction, white is rest"
        yield scene_section(
            out, f"{TITLE}: {title}", f"{len(images) - 2} of {len(COMPARED_VARIANTS)} rows", "", [(sheet, shown)], shown=shown
        )
