"""Write a run to keep: see the package."""

from __future__ import annotations

import shutil
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

import flowsplat
from flowsplat.scenes.layers import write_image
from flowsplat.scenes.synthetic import SyntheticScene, write_synthetic
from tests.kept import FRAME, HERE, IMAGE
from tests.shared import small_config

SPEC = SyntheticScene(width=48, height=32, frames=8, fps=6.0)
GAUSSIANS = 150
MADE_ANEW = (
    "report.html",
    "priors.html",
    "training/events*",
    "training/step_*",
    "training/latest.json",
    "evaluation",
    "renders/*.mp4",
)
"""Pages, images and what a finished training does not need: no later version reads them."""


def main(name: str) -> None:
    """Write the folder."""
    out = HERE / name
    if out.exists():
        raise SystemExit(f"{out} is there, and is never written again.")
    with tempfile.TemporaryDirectory() as folder:
        write_synthetic(Path(folder) / "scene", SPEC, holdout=4)
        config = small_config(gaussians=GAUSSIANS)
        config = replace(config, render=replace(config.render, width=24))
        flowsplat.run(Path(folder) / "scene", out, config)
    for pattern in MADE_ANEW:
        for path in out.glob(pattern):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    scene = flowsplat.Scene(out / "scene")
    image = flowsplat.load(out / "model").render(scene.cameras[FRAME], float(scene.timestamps[FRAME])).color
    write_image(out / IMAGE, np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8))


if __name__ == "__main__":
    main(sys.argv[1])
