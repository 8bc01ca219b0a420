"""What a type checker sees of the public names: mypy reads this with the sources, nothing runs it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from typing_extensions import assert_type

import flowsplat


def a_user() -> None:
    """None of the names is ``Any``."""
    run = flowsplat.run("clip.mp4", Path("out"), preset="fast", overrides={"train.loss.flow": 0.1})
    assert_type(run, flowsplat.Run)
    assert_type(run.folder, Path)
    assert_type(run.metrics, dict[str, Any])
    assert_type(run.model, flowsplat.SceneModel)
    assert_type(run.model.gaussians, flowsplat.Gaussians4D)
    assert_type(run.scene, flowsplat.Scene)
    assert_type(run.scene.cameras, list[flowsplat.Camera])
    rendering = flowsplat.load("out").render(run.scene.cameras[0], 0.5)
    assert_type(rendering, flowsplat.Rendering)
    assert_type(rendering.color, np.ndarray)
    assert_type(flowsplat.preset("default"), flowsplat.RunConfig)
    assert_type(flowsplat.__version__, str)
