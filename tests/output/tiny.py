"""A run whose model was made by hand: a bluish wall, a red object in front of it that goes to the right, a moving camera."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import torch

from flowsplat.common.files import write_json
from flowsplat.gaussians.gaussians4d import Gaussians4D, parameter_shapes
from flowsplat.gaussians.model import SceneModel
from flowsplat.gaussians.model_config import ModelConfig
from flowsplat.geometry import Camera, Similarity
from flowsplat.scenes import Scene
from flowsplat.splatting.rules import C0
from flowsplat.training.checkpoint import save_model

WALL, OBJECT = 4.0, 2.5
"""Depths."""
CONFIG = ModelConfig(mean_poly=1, mean_fourier=0, quat_poly=0, quat_fourier=0, sh_degree=0, freeze_background=True)
SIMILARITY = Similarity(1 / WALL)
FRAMES, FPS = 9, 8.0


def tiny_cameras(size: tuple[int, int], shake: float = 0.0) -> list[Camera]:
    """To the right by 0.3 in all, shaking up and down."""
    width, height = size
    K = np.array([[max(size), 0, width / 2], [0, max(size), height / 2], [0, 0, 1.0]])
    cameras = []
    for i in range(FRAMES):
        viewmat = np.eye(4)
        viewmat[:2, 3] = -0.3 * i / (FRAMES - 1), -shake * (-1) ** i
        cameras.append(Camera(viewmat, K, width, height))
    return cameras


def tiny_model(objects: int = 1, half_width: float = 4.0) -> SceneModel:
    """The wall is ``2 half_width`` wide and high, the object, number 2, a ball of up to one Gaussian for each of ``objects``."""
    side = np.arange(-half_width, half_width + 1e-6, 0.2)
    x, y = (part.ravel() for part in np.meshgrid(side, side))
    wall = np.stack([x, y, np.full_like(x, WALL)], -1)
    waves = 0.4 + 0.3 * np.sin(5 * x) * np.sin(5 * y)
    ball = np.array([[-0.5 + 0.02 * k, 0.05 * np.sin(k), OBJECT] for k in range(objects)]).reshape(-1, 3)
    count = len(wall) + len(ball)
    params = {name: torch.zeros(count, *shape) for name, shape in parameter_shapes(CONFIG).items()}
    params["means"] = torch.tensor(np.concatenate([wall, ball]) / WALL, dtype=torch.float32)
    colors = np.concatenate([np.stack([0.1 + 0 * waves, waves, 0.9 - waves / 2], -1), np.tile([0.9, 0.1, 0.1], (len(ball), 1))])
    params["sh"][:, 0] = torch.tensor((colors - 0.5) / C0, dtype=torch.float32)
    params["logit_opacities"][:] = 5.0
    params["log_lambdas"][:] = -8.0
    params["quats"][:, 0] = 1.0
    params["log_scales"][:] = float(np.log(0.15 / WALL))
    dynamic = torch.arange(count) >= len(wall)
    params["mean_poly"][dynamic, 0, 0] = 1.0 / WALL  # to the right by 1 over the clip
    return SceneModel(
        Gaussians4D(params, dynamic, CONFIG, object_ids=2 * dynamic.to(torch.uint8)), SIMILARITY, 0.0, (FRAMES - 1) / FPS
    )


def tiny_run(folder: Path, objects: int = 1, size: tuple[int, int] = (64, 48), trained: bool = True, shake: float = 0.0) -> Path:
    """A run folder with frames that the model itself rendered."""
    model, cameras = tiny_model(objects), tiny_cameras(size, shake)
    times = np.arange(FRAMES) / FPS
    scene = Scene.create(
        folder / "scene", name="tiny", source="test", width=size[0], height=size[1], timestamps=times.tolist(), holdout=5,
        source_fps=FPS,
    )  # fmt: skip
    scene.write_cameras(cameras)
    scene.write_similarity(SIMILARITY)
    for i in range(FRAMES):
        scene.write_frame(i, (model.render(cameras[i], float(times[i])).color * 255).astype(np.uint8))
    write_json(folder / "run.json", {})
    if trained:
        save_model(folder / "model", model)
    return folder


def red(image: np.ndarray) -> np.ndarray:
    """[H, W] bool: where the object is in an image [H, W, 3]."""
    image = image.astype(np.int32)
    return (image[..., 0] > 120) & (image[..., 0] > image[..., 2] + 50)


def frames_of(path: Path, decoder: str | None = None, pixels: str = "rgb24") -> list[np.ndarray]:
    """The frames of a video; alpha needs the ``decoder`` named."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        if decoder is None:
            return [frame.to_ndarray(format=pixels) for frame in container.decode(stream)]
        context = av.CodecContext.create(decoder, "r")
        return [f.to_ndarray(format=pixels) for packet in container.demux(stream) if packet.size for f in context.decode(packet)]
