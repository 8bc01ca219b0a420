"""A small scene that needs no training: a wall of resting Gaussians, and some that move and turn in front of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from flowsplat.gaussians.gaussians4d import Gaussians4D, parameter_shapes
from flowsplat.gaussians.model import SceneModel
from flowsplat.gaussians.model_config import ModelConfig
from flowsplat.gaussians.motion import SharedMotion, motion_model
from flowsplat.gaussians.render import render
from flowsplat.geometry import Camera, Similarity
from flowsplat.output.player import write_player
from flowsplat.scenes import Scene
from flowsplat.training.checkpoint import save_model

WIDTH, HEIGHT, FRAMES = 96, 64, 9
FIRST, LAST = 0.5, 2.5

OURS = ModelConfig(
    mean_poly=3, mean_fourier=1, quat_poly=1, quat_fourier=0, sh_degree=1, gains=5, slopes=True, freeze_background=True
)
PAPER = ModelConfig()
LINEAR = ModelConfig(move_means=False, move_quats=False, sh_degree=2)
OTHERS = {
    kind: ModelConfig(kind=kind, knots=6, bases=3, sh_degree=1, freeze_background=True)
    for kind in ("splines", "marbles", "bases", "hexplane", "deformation")
}
"""Motion models of other papers."""


def small_gaussians(config: ModelConfig = OURS, resting: int = 400, moving: int = 250, seed: int = 0) -> Gaussians4D:
    """A wall at depth 1 and objects between 0.5 and 0.9 in front of the normalized origin."""
    generator = torch.Generator().manual_seed(seed)
    count = resting + moving
    dynamic = torch.arange(count) >= resting

    def random(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator)

    means = (random(count, 3) - 0.5) * torch.tensor([1.6, 1.1, 0.0])
    means[:, 2] = torch.where(dynamic, 0.5 + 0.4 * random(count), 1 + 0.1 * random(count))
    params = {name: 0.02 * (random(count, *shape) - 0.5) for name, shape in parameter_shapes(config).items()}
    params["means"] = means
    if config.slopes:
        params["slopes"] *= 20
    params["times"] = torch.where(dynamic, random(count), torch.full((count,), 0.5))
    params["logit_opacities"] = 3 * random(count) - 0.5
    params["sh"][:, 0] = 3 * (random(count, 3) - 0.5)
    params["sh"][:, 1:] *= 10
    params["log_gains"] = 0.3 * (random(count, config.gains) - 0.5)
    for name in ("mean_poly", "mean_cos", "mean_sin", "mean_knots", "quat_poly", "quat_cos", "quat_sin", "quat_knots"):
        if name in params:
            params[name] *= dynamic[:, None, None] * (40 if name.startswith("quat") else 20)
    if "places" in params:
        params["places"] *= 5  # the page rounds kinks, and so it does these, less than 8 bits tell
    if "quats" in params:
        params["quats"] = random(count, 4) - 0.5
        params["log_scales"] = torch.log(0.02 + 0.05 * random(count, 3))
    elif "log_radii" in params:
        params["log_radii"] = torch.log(0.02 + 0.05 * random(count))
    if "log_lambdas" in params:
        params["log_lambdas"] = torch.where(dynamic, 2 + 3 * random(count), torch.full((count,), -13.8))
    else:
        params["quats_left"], params["quats_right"] = random(count, 4) - 0.5, random(count, 4) - 0.5
        params["log_scales4"] = torch.log(0.03 + 0.1 * random(count, 4))
    # Two objects, of the left and of the right.
    object_ids = torch.where(dynamic, torch.where(means[:, 0] < 0, 1, 2), 0).to(torch.uint8)
    shared = {}
    if isinstance(motion := motion_model(config), SharedMotion):
        params["anchors" if "anchors" in params else "basis_logits"] *= 50
        shared = {
            name: value + 0.1 * (torch.rand(value.shape, generator=generator) - 0.5)
            for name, value in motion.initial_shared().items()
        }
    return Gaussians4D(params, dynamic, config, config.sh_degree, object_ids, shared=shared)


def small_model(
    config: ModelConfig = OURS, *, rotation: np.ndarray | None = None, fill: bool = False, focal: float = 0.0,
    is_thin: bool = False, **counts: int,
) -> SceneModel:  # fmt: skip
    """The model in a scene that is three times as large and moved; a thin one lets some of the black behind it through."""
    similarity = Similarity(1 / 3, np.eye(3) if rotation is None else rotation, np.array([0.2, -0.1, 0.05]))
    gaussians = small_gaussians(config, **counts)
    if is_thin:
        gaussians.params["logit_opacities"] -= 2
    return SceneModel(gaussians, similarity, FIRST, LAST, fill=fill, focal=focal)


def small_cameras(model: SceneModel, width: int = WIDTH, height: int = HEIGHT) -> list[Camera]:
    """A camera that moves to the right and turns back, in the coordinates of the scene."""
    cameras = []
    for share in np.linspace(0, 1, FRAMES):
        angle = 0.1 * (share - 0.5)
        viewmat = np.eye(4)
        viewmat[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
        viewmat[0, 3] = 0.1 - 0.2 * share
        inner = Camera(viewmat, np.array([[80.0, 0, 47], [0, 82, 33], [0, 0, 1]]), WIDTH, HEIGHT)
        cameras.append(model.similarity.inverse().camera(inner).resize(width, height))
    return cameras


def small_times() -> list[float]:
    """Seconds of the frames."""
    return np.linspace(FIRST, LAST, FRAMES).tolist()


def small_run(folder: Path, model: SceneModel) -> Path:
    """A run folder with that trained model and its scene, without images."""
    scene = Scene.create(
        folder / "scene", name="small", source="test", width=WIDTH, height=HEIGHT, timestamps=small_times(), holdout=4,
        source_fps=4.0,
    )  # fmt: skip
    scene.write_cameras(small_cameras(model))
    scene.write_similarity(model.similarity)
    save_model(folder / "model", model)
    return folder


def small_player(path: Path, model: SceneModel, title: str = "small") -> Path:
    """The page that plays the model."""
    return write_player(path, model, small_times(), small_cameras(model), title)


def rendered(model: SceneModel, camera: Camera, seconds: float) -> np.ndarray:
    """[H, W, 3] our image, uncovered pixels black."""
    return render(model.gaussians, model.similarity.camera(camera), model.clip_time(seconds)).color.numpy()


def flat(model: SceneModel) -> SceneModel:
    """The model with one color for each Gaussian, as formats of others have it."""
    return replace(model, gaussians=model.gaussians.without_slopes())


def psnr(image: np.ndarray, reference: np.ndarray) -> float:
    """dB of images between 0 and 1."""
    return float(-10 * np.log10(np.mean((np.clip(image, 0, 1) - np.clip(reference, 0, 1)) ** 2) + 1e-12))


def five_pairs(model: SceneModel) -> list[tuple[Camera, float]]:
    """Input cameras at and between frames, and two cameras beside the path."""
    cameras, times = small_cameras(model), small_times()
    beside = []
    for shift in (0.3, -0.2):
        viewmat = cameras[4].viewmat.copy()
        viewmat[:2, 3] += shift
        beside.append(Camera(viewmat, cameras[4].K, WIDTH, HEIGHT))
    return [(cameras[0], times[0]), (cameras[3], times[3]), (cameras[-1], times[-1]), (beside[0], times[4] + 0.1), (beside[1], 1.9)]
