"""Do what a fresh process does in ``startup``. Imports nothing of the benchmark, whose own kernels would count."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from flowsplat.gaussians.gaussians4d import Gaussians4D, parameter_shapes
from flowsplat.gaussians.model import SceneModel
from flowsplat.geometry import Camera, Similarity
from flowsplat.training.config import PRESETS

CONFIG = PRESETS["default"]
IMAGE_SIZE = 854, 480
"""Width and height, pixels."""


def _gaussians(count: int = 5000) -> Gaussians4D:
    """Half of them background, half moving."""
    generator = torch.Generator().manual_seed(0)
    params = {name: torch.zeros(count, *shape) for name, shape in parameter_shapes(CONFIG.model).items()}
    params["means"] = torch.rand(count, 3, generator=generator) * 2 - 1
    params["log_scales"].fill_(-4.0)
    params["quats"][:, 0] = 1
    return Gaussians4D(params, torch.arange(count) >= count // 2, CONFIG.model, CONFIG.model.sh_degree)


def _camera() -> Camera:
    viewmat = np.eye(4)
    viewmat[2, 3] = 3
    return Camera(viewmat, np.array([[700, 0, IMAGE_SIZE[0] / 2], [0, 700, IMAGE_SIZE[1] / 2], [0, 0, 1]]), *IMAGE_SIZE)


def image() -> None:
    """Render one image of a small 4D scene."""
    SceneModel(_gaussians(), Similarity(), 0.0, 1.0).render(_camera(), 0.5)


def step() -> None:
    """Take one training step on it, with all losses."""
    from flowsplat.gaussians.observations import Observation, Observations
    from flowsplat.scenes import Flow
    from flowsplat.training.trainer import Trainer

    width, height = IMAGE_SIZE
    covered, flat = np.ones((height, width), bool), np.ones((height, width), np.float32)
    image, flow = np.zeros((height, width, 3), np.uint8), Flow(0, 1, np.zeros((height, width, 2), np.float32), flat)
    # Both have a flow, so that it does not matter which is drawn.
    frames = [Observation(k, float(k), _camera(), image, flat, covered, covered, flow, None) for k in range(2)]
    config = replace(CONFIG, iterations=1, preview_every=0)
    Trainer(Observations(frames, Similarity()), None, config, start=_gaussians()).run()
