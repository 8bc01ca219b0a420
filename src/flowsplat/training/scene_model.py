"""Convert trained Gaussians to the space and time of their scene."""

from __future__ import annotations

from flowsplat.gaussians.gaussians4d import Gaussians4D
from flowsplat.gaussians.model import SceneModel
from flowsplat.scenes import Scene
from flowsplat.training.config import TrainConfig


def scene_model(scene: Scene, gaussians: Gaussians4D, config: TrainConfig) -> SceneModel:
    """Gaussians with the space and time of their scene."""
    first, last = float(scene.timestamps[0]), float(scene.timestamps[-1])
    focal = float(scene.cameras[scene.train_frames[0]].K[0, 0])
    return SceneModel(gaussians, scene.similarity, first, last, config.flow_model, config.fill, focal)
