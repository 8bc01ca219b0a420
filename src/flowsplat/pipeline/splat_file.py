"""Show a file of static Gaussians as a scene: a folder like that of a run, with a model and a clip that nobody has filmed.

Its cameras go once round the middle of the file, in so many seconds, and its frames are what they see. Whatever shows runs then
shows it: paths of cameras, camera files, the viewer.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from flowsplat.common.devices import DeviceName, pick_device
from flowsplat.common.errors import InputError
from flowsplat.common.files import hash_files, lease
from flowsplat.common.progress import report, track
from flowsplat.common.run_paths import RunPaths
from flowsplat.gaussians.gaussians4d import Gaussians4D, parameter_shapes
from flowsplat.gaussians.model import SceneModel
from flowsplat.gaussians.model_config import ModelConfig
from flowsplat.geometry import Camera, Similarity
from flowsplat.geometry.cameras import MAX_COORDINATE, rigid
from flowsplat.images.colors import float_to_bytes
from flowsplat.output.splat_files import Splats, read_splats, report_left_out
from flowsplat.output.videos import RenderOptions, render_videos, settle_clip
from flowsplat.pipeline.config import RunConfig, check
from flowsplat.pipeline.folder import RunFolder
from flowsplat.scenes import Scene
from flowsplat.training.checkpoint import has_model, is_storable, load_model, save_model

SECONDS, FRAMES, FPS = 8.0, 33, 24.0
"""Of the clip: how long the cameras take, how many there are, and frames a second of its videos. Chosen by eye."""
WIDTH, HEIGHT, FIELD_OF_VIEW = 960, 540, 50.0
"""Pixels of the clip, and degrees of its height. Chosen by eye."""
CIRCLE_RADIUS, CIRCLE_HEIGHT = 2.2, 0.5
"""Of the circle of cameras, in the median distance of the Gaussians from their middle. Chosen by eye."""


def make_model(splats: Splats, name: str = "The file") -> SceneModel:
    """Return what a file holds as a scene in which nothing moves, of ``SECONDS``.

    Args:
        splats: what it holds.
        name: what it is called in messages.

    Raises:
        InputError: nothing of it can be drawn.
    """
    config = ModelConfig(
        mean_poly=0, mean_fourier=0, quat_poly=0, quat_fourier=0, sh_degree=splats.sh_degree, freeze_background=True
    )
    middle, size = _middle_and_size(splats)
    similarity = Similarity(1 / size, np.eye(3), -middle / size)
    given = {
        "means": similarity.points(splats.means.astype(np.float64)), "quats": splats.quats,
        "log_scales": splats.log_scales - np.log(size), "logit_opacities": splats.logit_opacities, "sh": splats.sh,
    }  # fmt: skip
    given = {key: np.ascontiguousarray(value, np.float32) for key, value in given.items()}
    # What was within bounds in the units of the file may be beyond them in those of the model, which nobody could load.
    usable = np.asarray(is_storable("means", given["means"]).all(1) & is_storable("log_scales", given["log_scales"]).all(1))
    report_left_out(name, int((~usable).sum()), len(splats))
    count = int(usable.sum())
    if count == 0:
        raise InputError(f"{name} holds no Gaussian that can be drawn.")
    params = {key: torch.zeros(count, *shape) for key, shape in parameter_shapes(config).items()}
    params |= {key: torch.from_numpy(value[usable]) for key, value in given.items()}
    gaussians = Gaussians4D(params, torch.zeros(count, dtype=torch.bool), config, splats.sh_degree)
    return SceneModel(gaussians, similarity, 0.0, SECONDS, fill=False)


def make_cameras(splats: Splats, name: str = "The file") -> list[Camera]:
    """Return ``FRAMES`` cameras once round the middle, a little above it: y points down, as in most such files.

    Args:
        splats: what the file holds.
        name: what it is called in messages.

    Raises:
        InputError: it is so large, or so far from the origin, that one of them could not look.
    """
    middle, size = _middle_and_size(splats)
    focal = HEIGHT / 2 / np.tan(np.radians(FIELD_OF_VIEW / 2))
    K = np.array([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1]])
    cameras = []
    for angle in np.linspace(0, 2 * np.pi, FRAMES):
        outwards = np.array([np.sin(angle), 0, -np.cos(angle)])
        center = middle + size * (CIRCLE_RADIUS * outwards - np.array([0, CIRCLE_HEIGHT, 0]))
        forward = (middle - center) / np.linalg.norm(middle - center)
        right = np.cross([0.0, 1, 0], forward)
        right /= np.linalg.norm(right)
        R = np.stack([right, np.cross(forward, right), forward])
        cameras.append(Camera(rigid(R, -R @ center), K, WIDTH, HEIGHT))
    if not all(camera.is_valid for camera in cameras):
        reach = f"its middle is at {', '.join(f'{value:.3g}' for value in middle)}, and half of it within {size:.3g}"
        raise InputError(f"{name} is too far away or too large to be seen ({reach}): move it to the origin, or scale it.")
    return cameras


def _middle_and_size(splats: Splats) -> tuple[np.ndarray, float]:
    """Return the median of the means [3], and the median of their distances from it; 1 where all are in one place."""
    means = splats.means.astype(np.float64)
    middle = np.median(means, 0)
    size = float(np.median(np.linalg.norm(means - middle, axis=1)))
    return middle, size if size > 1 / MAX_COORDINATE else 1.0


def open_splat_file(
    path: Path, folder: Path, device: DeviceName = "cpu", options: RenderOptions | None = None
) -> tuple[SceneModel, Scene]:
    """Make of a file the folder of a run that the viewer can open; one that was made of the same file before is taken as it is.

    Args:
        path: of the file.
        folder: empty, or missing, or of the same file.
        device: what draws.
        options: of videos that are to be rendered; None = none are.

    Raises:
        InputError: the file cannot be read, the folder cannot be used, or the options do not fit; before anything is drawn.
    """
    with lease(folder):
        fingerprint = hash_files("splat file", [(Path(path).name, Path(path))], whole=True)
        # All is looked at before anything is written: of what is refused nothing is left, and the folder is for any file.
        if options is not None:
            settle_clip((0.0, SECONDS), FPS, (WIDTH, HEIGHT), options)
        made = None if has_model(RunPaths(folder).model_path) else _make(Path(path))
        run = RunFolder.open_or_create(folder, str(path), fingerprint, RunConfig())
        if made is not None:
            _fill(run, Path(path), *made, pick_device(device))
        return load_model(run.model_path).to(pick_device(device)), Scene(run.scene_path)


def _make(path: Path) -> tuple[SceneModel, list[Camera]]:
    splats = read_splats(path)
    return make_model(splats, path.name), make_cameras(splats, str(path))


def _fill(run: RunFolder, path: Path, model: SceneModel, cameras: list[Camera], device: torch.device) -> None:
    """Write the scene and, last of all, the model."""
    scene = Scene.create(
        run.scene_path, name=path.stem, source=str(path), width=WIDTH, height=HEIGHT,
        timestamps=np.linspace(0, SECONDS, FRAMES).tolist(), holdout=None, source_fps=FPS,
        notes=["Static Gaussians of a file: what its frames show was drawn and not filmed."],
    )  # fmt: skip
    scene.write_cameras(cameras)
    scene.write_similarity(model.similarity)
    report(f"{path}: {len(model.gaussians):,} Gaussians with harmonics of degree {model.gaussians.sh_degree}.")
    drawn = model.to(device)
    for i, camera in track(list(enumerate(cameras)), "Rendering frames"):
        scene.write_frame(i, float_to_bytes(drawn.render(camera, scene.timestamps[i]).color))
    save_model(run.model_path, model)


def render_splat_file(path: Path, out: Path, options: RenderOptions, device: DeviceName = "cpu") -> None:
    """Render videos of a file into a folder, which afterwards is one that ``flowsplat view`` opens.

    Args:
        path: of the file.
        out: empty, or missing, or of the same file.
        options: which videos; without a camera file they go round the middle.
        device: what computes.

    Raises:
        InputError: as ``open_splat_file``, or an option or the camera file cannot be used.
    """
    if options.object_depth or set(options.parts) != {"all"}:
        raise InputError(f"{path} has no objects: --render.parts and --render.object-depth are for clips.")
    check(RunConfig(render=options, device=device))
    with lease(out):
        model, scene = open_splat_file(path, out, device, options)
        render_videos(model, scene, Path(out) / "renders", options)
