"""A coarse scene of a clip: something to turn about while the priors of the real one are computed.

It is an ordinary scene, prepared and trained as any other, of few and small frames: what it costs does not depend on the length and
size of the clip. It takes frames that the run trains on, lies in a folder of its own that nothing else reads, and is shown until
training has a checkpoint.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from flowsplat.common.devices import pick_device
from flowsplat.common.progress import as_one, report
from flowsplat.common.run_paths import RunPaths
from flowsplat.gaussians.observations import load_observations
from flowsplat.images.colors import float_to_bytes
from flowsplat.images.sheets import preview_sheet
from flowsplat.output.videos import RenderOptions, render_videos
from flowsplat.pipeline.folder import RunFolder, Stage, stage_key
from flowsplat.priors.cameras import CameraOptions
from flowsplat.priors.options import PriorsOptions
from flowsplat.priors.prepare import prepare_priors
from flowsplat.scenes.clip import Clip, InputOptions, resize_image, resize_labels
from flowsplat.scenes.ingest import ingest
from flowsplat.scenes.layers import write_image
from flowsplat.training.checkpoint import has_model, save_model
from flowsplat.training.config import PRESETS, TrainConfig
from flowsplat.training.scene_model import scene_model
from flowsplat.training.trainer import Trainer

STAGE = "coarse"
"""The stage that makes it."""
MAX_FRAMES = 24
"""Frames that it is made from, at most. Chosen by eye."""
MAX_FRAME_SECONDS = 0.2
"""Seconds between two of them at most, unless the run's own are farther apart: motion has to be followed. Of a longer clip they
show the beginning. Chosen by eye."""
LONG_SIDE = 284
"""Pixels of their long side. Chosen by eye."""
COARSE_STEPS = 200
"""Training steps of the coarse scene. Chosen by eye."""
REFERENCE_SECONDS = 30.0
"""What it takes on the reference machine, two cores, with a margin."""
MAX_RUN_SHARE = 0.08
"""Of a whole run, which it may take at most: a shorter run has something to show soon enough. Chosen by eye."""
VIDEOS = RenderOptions(paths=("input", "orbit"), width=427, max_frames=48)


def is_worth_it(whole: float) -> bool:
    """Return whether a run that takes ``whole`` seconds on the reference machine begins with it."""
    return MAX_RUN_SHARE * whole >= REFERENCE_SECONDS


def choose_frames(timestamps: np.ndarray, train: Sequence[int]) -> list[int]:
    """Return frames that the coarse scene is made from: evenly over the training frames of the clip, or over its beginning."""
    times = timestamps[list(train)]
    over_all = -(-len(train) // MAX_FRAMES)
    followed = int(MAX_FRAME_SECONDS / float(np.median(np.diff(times))) + 1e-6)
    return list(train)[:: max(1, min(over_all, followed))][:MAX_FRAMES]


@dataclass(kw_only=True)
class CoarseClip(Clip):
    """Few frames of a clip, made small.

    Attributes:
        whole: the clip.
        numbers: [T] which of its frames.
    """

    whole: Clip
    numbers: list[int]

    @staticmethod
    def of(clip: Clip, options: InputOptions) -> CoarseClip:
        """That of a clip, without the frames that a run holds out."""
        train, _ = clip.split(options)
        numbers = choose_frames(clip.timestamps, train)
        scale = min(1.0, LONG_SIDE / max(clip.width, clip.height))
        width, height = (max(32, round(side * scale)) for side in (clip.width, clip.height))
        cameras = clip.cameras and [clip.cameras[i].resize(width, height) for i in numbers]
        return CoarseClip(
            name=clip.name, source=clip.source, width=width, height=height, timestamps=clip.timestamps[numbers],
            source_fps=clip.source_fps, has_masks=clip.has_masks, cameras=cameras, whole=clip, numbers=numbers,
        )  # fmt: skip

    def frames(self, numbers: Sequence[int]) -> Iterator[np.ndarray]:
        for image in self.whole.frames([self.numbers[i] for i in numbers]):
            yield resize_image(image, (self.width, self.height))

    def mask(self, i: int) -> np.ndarray:
        return resize_labels(self.whole.mask(self.numbers[i]), (self.width, self.height))


def coarse_settings() -> TrainConfig:
    """Return how it is trained."""
    ours = PRESETS["default"]
    return replace(
        ours, iterations=COARSE_STEPS, checkpoint_every=0, preview_every=0,
        density=replace(ours.density, every=COARSE_STEPS // 3, start=COARSE_STEPS // 3),
    )  # fmt: skip


def coarse_scene(folder: RunFolder, clip: Clip) -> None:
    """Make the coarse scene of a run from its clip, or what is missing of it; where that is impossible a line says so.

    Writes ``coarse/scene``, ``coarse/model``, ``coarse/renders`` and the run's ``preview.png``.
    """
    where = folder.coarse
    settings = coarse_settings()
    key = stage_key(folder.fingerprint, MAX_FRAMES, MAX_FRAME_SECONDS, LONG_SIDE, settings)
    with folder.stage(STAGE, key, (where.path,), made=has_model(where.model_path)) as stage:
        if not stage.is_done:
            _make_coarse(folder, stage, clip, where, settings)


def _make_coarse(folder: RunFolder, stage: Stage, clip: Clip, where: RunPaths, settings: TrainConfig) -> None:
    coarse = CoarseClip.of(clip, folder.config.input)
    device = pick_device(folder.config.device)
    report(f"First a coarse scene of {coarse.num_frames} small frames, to look at meanwhile (--no-coarse-scene leaves it out).")
    try:
        with as_one("A coarse scene"):
            _make(folder, coarse, where, settings, device)
    except Exception as error:  # Nothing depends on it: whatever it fails of, memory too, the run goes on.
        report(f"There is no coarse scene: {error or type(error).__name__}")
        return
    stage.finish()
    report(f"Look at it: flowsplat view {folder.path}, or {where.renders_path}. It is coarse: the scene proper takes its place.")


def _make(folder: RunFolder, coarse: CoarseClip, where: RunPaths, settings: TrainConfig, device: torch.device) -> None:
    focal = folder.config.priors.cameras.focal
    scene = ingest(coarse, where.scene_path, InputOptions(holdout=None))
    cameras = CameraOptions(focal=None if focal is None else focal * coarse.width / coarse.whole.width, solver="own")
    prepare_priors(scene, PriorsOptions(cameras=cameras))
    tracks = scene.tracks if scene.has_tracks else None
    trainer = Trainer(load_observations(scene), tracks, settings, device=device)
    model = scene_model(scene, trainer.run(), settings)
    save_model(where.model_path, model)
    middle = scene.num_frames // 2
    rendered = model.render(scene.cameras[middle], float(scene.timestamps[middle]))
    write_image(folder.preview_path, preview_sheet(scene.frame(middle), float_to_bytes(rendered.color)))
    render_videos(model, scene, where.renders_path, VIDEOS)
