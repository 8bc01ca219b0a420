"""Write a run to keep: see the package."""

from __future__ import annotations

import shutil
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

import flowsplat
from flowsplat.pipeline import run
from flowsplat.scenes.layers import write_image
from flowsplat.scenes.synthetic import SyntheticScene, write_synthetic
from tests.kept import FRAME, HERE, IMAGE
from tests.shared import small_config

SPEC = SyntheticScene(width=32, height=24, frames=6, fps=6.0)
GAUSSIANS = 120
LEFT_OUT = (
    "report.html", "priors.html", "preview.png", "logs", "training/step_*", "training/latest.json", "evaluation", "renders/*.mp4",
    "scene/truth",
)  # fmt: skip
"""What no later version reads, and the truth, which clips of others do not have."""


def main(name: str) -> None:
    """Write the folder."""
    out = HERE / name
    if out.exists():
        raise SystemExit(f"{out} is there, and is never written again.")
    with tempfile.TemporaryDirectory() as folder:
        write_synthetic(Path(folder) / "scene", SPEC, holdout=4)
        config = small_config(gaussians=GAUSSIANS)
        config = replace(config, render=replace(config.render, width=24))
        run(Path(folder) / "scene", out, config)
    for pattern in LEFT_OUT:
        for path in out.glob(pattern):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    scene = flowsplat.Scene(out / "scene")
    image = flowsplat.load(out / "model").render(scene.cameras[FRAME], float(scene.timestamps[FRAME])).color
    write_image(out / IMAGE, np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8))


if __name__ == "__main__":
    main(sys.argv[1])
