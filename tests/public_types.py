"""What a type checker sees of the public names: mypy reads this with the sources, nothing runs it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from typing_extensions import assert_type

import flowsplat
from flowsplat.gaussians.observations import Observations


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
    assert_type(flowsplat.export(run, "html", "out/player.html"), Path)
    assert_type(flowsplat.compare(run, "out", Path("other"), out="compare.html"), Path)
    frame = flowsplat.render(run.model.gaussians, run.scene.cameras[0], 0.5)
    assert_type(frame.color, Tensor)
    arrays = np.zeros((3, 3)), np.ones((3, 4)), np.ones((3, 3)), np.ones(3), np.ones((3, 3))
    image, alphas, info = flowsplat.rasterize(*arrays, np.eye(4), np.eye(3), 16, 12)
    assert_type(image, Tensor)
    assert_type(alphas, Tensor)
    assert_type(info, dict[str, Any])
    tensors = torch.zeros(3, 3), torch.ones(3, 4), torch.ones(3, 3), torch.ones(3), torch.ones(3, 3)
    colors, _, _ = flowsplat.rasterization(*tensors, torch.eye(4)[None], torch.eye(3)[None], 16, 12)
    assert_type(colors, Tensor)
    camera = flowsplat.Camera(np.eye(4), np.diag([100, 100, 1]), 160, 120)
    assert_type(camera.center, np.ndarray)


def a_user_who_trains(observations: Observations) -> None:
    """The trainer and what it trains."""
    trainer = flowsplat.Trainer(observations, None, flowsplat.preset("fast").train, checkpoints="out/training")
    assert_type(trainer, flowsplat.Trainer)
    assert_type(trainer.gaussians, flowsplat.Gaussians4D)
    assert_type(flowsplat.__version__, str)
