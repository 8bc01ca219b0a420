"""Load what is looked at: the newest model of a run, trained or still in training, and the scene that it was trained on.

Until training has a checkpoint this is the coarse scene of the run, where there is one: another scene, with cameras and times
of its own.
"""

from __future__ import annotations

import contextlib
import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np
import torch

from flowsplat.common.errors import InputError
from flowsplat.common.run_paths import RunPaths
from flowsplat.gaussians.confidence_fade import keep_all_seen
from flowsplat.gaussians.crop import CropBox, select_in_box
from flowsplat.gaussians.distances import Distances
from flowsplat.gaussians.model import SceneModel
from flowsplat.gaussians.renderer import Part
from flowsplat.geometry import Camera
from flowsplat.geometry.paths import CameraPath, turn_aside
from flowsplat.output.splat_files import is_splat_file
from flowsplat.output.videos import read_swing
from flowsplat.output.videos.amplitudes import SWING_ANGLES
from flowsplat.output.videos.writing import Scales
from flowsplat.scenes import Scene
from flowsplat.scenes.layers import Tracks
from flowsplat.training.checkpoint import check_scene, has_model, load_checkpoint, load_model


class Loaded:
    """A model in one state of its training."""

    def __init__(self, model: SceneModel, state: str, number: int):
        """``state``: in words; ``number`` counts the states, so that one can see whether there is a new one."""
        self.state, self.number = state, number
        self._parts: dict[Part, SceneModel] = {"all": model}
        self._cropped: OrderedDict[tuple[Part, CropBox], SceneModel] = OrderedDict()
        self._cropping = threading.Lock()

    def part(self, part: Part) -> SceneModel:
        """Return the model of a part of the scene, made when it is first asked for."""
        if part not in self._parts:
            self._parts[part] = self._parts["all"].part(part)
        return self._parts[part]

    def crop(self, part: Part, box: CropBox | None) -> SceneModel:
        """Return what of a part of the scene lies in a box, which may be nothing; None = all of it.

        Panels ask for it as well as the thread that renders.
        """
        if box is None:
            return self.part(part)
        with self._cropping:
            if (part, box) not in self._cropped:
                self._cropped[part, box] = select_in_box(self.part(part), box)
                while len(self._cropped) > _MAX_CROPPED:
                    self._cropped.popitem(last=False)
            self._cropped.move_to_end((part, box))
            return self._cropped[part, box]


_OF_SCENE = ("path", "reach", "_inner_path", "step", "tracks", "scales")
"""What is kept of a scene."""
_MAX_CROPPED = 4
"""Cropped scenes that are kept, each with Gaussians of its own: of as many clients, or parts. Chosen by eye."""


class Source:
    """The folder of a run as the viewer reads it. Only one thread may call ``refresh``."""

    def __init__(self, folder: Path, device: torch.device | str = "cpu"):
        """Open a run; ``device``: where its models are rendered.

        Raises:
            InputError: it is none, has neither a model nor a checkpoint nor a coarse scene yet, or was prepared anew after
                its training.
        """
        self.folder, self._device, self._run = Path(folder), device, RunPaths(folder)
        if not self._run.record_path.exists():
            raise InputError(f"{folder} is not the folder of a run: start with flowsplat run INPUT -o {folder}.")
        found = self._find()
        if found is None:
            if not (self._run.scene_path / "scene.json").exists():
                raise InputError(f"{folder} is not prepared yet: run flowsplat prepare or flowsplat run first.")
            raise InputError(
                f"{folder} holds neither a trained scene nor a checkpoint yet: run flowsplat train {folder}; "
                "its first checkpoint can be looked at while it trains."
            )
        self._stamp, place, read = found
        self.scene = Scene(place)
        model, state = read(self.scene)
        self.loaded = Loaded(self._ready(model), state, 0)

    def input_camera(self, t: float, turn: tuple[float, float]) -> Camera:
        """Return the clip's camera at ``t`` seconds, turned by degrees to the left and up round the middle of the scene."""
        own = self.path.at(t)
        return turn_aside(own, 1 / self.scene.similarity.scale, *turn) if any(turn) else own

    def model(
        self,
        part: Part,
        distances: Sequence[tuple[int, float]] = (),
        confidence_fade: bool = False,
        crop: CropBox | None = None,
    ) -> SceneModel:
        """Return the newest model of a part of the scene, with objects so many times as far away as they were trained.

        Numbers that no object has do nothing: in training they may come and go. ``confidence_fade``: without what the clip tells
        too little of; nothing as long as that is not known. ``crop``: what lies in a box alone, as ``flowsplat export`` crops:
        objects by where they were trained.
        """
        model, factors = self.loaded.crop(part, crop), {number: factor for number, factor in distances if factor != 1}
        model = replace(model, distances=Distances(factors, self._inner_path)) if factors else model
        return replace(model, confidence_fade=self._inner_path, fill=False) if confidence_fade else model

    def without_unseen(self, model: SceneModel) -> SceneModel:
        """Return a model of this source without what no frame of the clip has seen, its gaps filled as before.

        It is the model itself where that is not known, and where guesses fade anyway.
        """
        seen = model.gaussians.seen
        if seen is None or model.confidence_fade is not None:
            return model
        return replace(model, gaussians=replace(model.gaussians, seen=keep_all_seen(seen)), confidence_fade=self._inner_path)

    def refresh(self) -> bool:
        """Read the newest state again if it changed; whether it did."""
        found = self._find()
        if found is None or found[0] == self._stamp:
            return False
        stamp, place, read = found
        try:
            scene = self.scene if place == self.scene.folder else Scene(place)
            model, state = read(scene)
        except InputError:
            return False  # It is being replaced at this moment: the next call finds it whole.
        loaded = Loaded(self._ready(model), state, self.loaded.number + 1)  # may raise, and all stays as it was
        self.__dict__.pop("reach", None)  # videos may have been rendered meanwhile
        if scene is not self.scene:
            self.scene = scene
            for name in _OF_SCENE:
                self.__dict__.pop(name, None)
        self._stamp, self.loaded = stamp, loaded
        return True

    def _ready(self, model: SceneModel) -> SceneModel:
        """On the device that renders, prepared for many frames."""
        return replace(model.to(self._device), graphs=True)

    def _find(self) -> tuple[tuple[str, int], Path, Callable[[Scene], tuple[SceneModel, str]]] | None:
        """Return the newest state: what tells it from others, the folder of its scene, and how to read it.

        A training that begins removes the model that was there, so a model is never older than a checkpoint beside it; the clock
        may have been set between the two.
        """
        run, coarse = self._run, self._run.coarse
        trained = run.all_frames_path if has_model(run.all_frames_path) else run.model_path
        for path, place, read in (
            (trained / "model.json", run.scene_path, partial(_read_model, trained, "trained")),
            (run.training_path / "latest.json", run.scene_path, self._read_checkpoint),
            (coarse.model_path / "model.json", coarse.scene_path, partial(_read_model, coarse.model_path, "a coarse scene")),
        ):
            with contextlib.suppress(OSError):
                return (str(path), path.stat().st_mtime_ns), place, read
        return None

    def _read_checkpoint(self, scene: Scene) -> tuple[SceneModel, str]:
        first, last = float(scene.timestamps[0]), float(scene.timestamps[-1])
        focal = float(scene.cameras[scene.train_frames[0]].K[0, 0])
        model, step, steps = load_checkpoint(self._run.training_path, scene.similarity, first, last, focal)
        return model, f"in training, step {step} of {steps}"

    @property
    def file(self) -> Path | None:
        """The file of static Gaussians that the folder was made of; None = it is a run of a clip."""
        path = Path(self.scene.info.source)
        return path if is_splat_file(path) else None

    @property
    def clip(self) -> tuple[float, float]:
        """Seconds of the first and the last frame."""
        return float(self.scene.timestamps[0]), float(self.scene.timestamps[-1])

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the clip."""
        return self.scene.width, self.scene.height

    @cached_property
    def reach(self) -> float:
        """Degrees by which the input camera may be looked past to either side, half as many up and down: as the narrowest loop of
        the videos of this scene goes, which was measured for them; as far as every loop goes where none was, or none holds."""
        renders = (self._run if self.scene.folder == self._run.scene_path else self._run.coarse).renders_path
        with contextlib.suppress(InputError):
            swing = read_swing(renders)
            if swing is not None and swing["holds"]:
                return float(max(swing["degrees"], min(SWING_ANGLES)))
        return min(SWING_ANGLES)

    @cached_property
    def path(self) -> CameraPath:
        """The clip's own cameras."""
        return CameraPath(self.scene.timestamps.tolist(), self.scene.cameras)

    @cached_property
    def _inner_path(self) -> CameraPath:
        """The same in the normalized coordinates and the clip time of the models."""
        first, last = self.clip
        times = (self.path.times - first) / (last - first)
        return CameraPath(times.tolist(), [self.scene.similarity.camera(camera) for camera in self.path.cameras])

    @cached_property
    def step(self) -> float:
        """Seconds from one frame to the next, their median."""
        return float(np.median(np.diff(self.scene.timestamps)))

    @cached_property
    def tracks(self) -> Tracks | None:
        """The clip's tracks, if it has some."""
        return self.scene.tracks if self.scene.has_tracks else None

    @cached_property
    def scales(self) -> Scales:
        """Color scales of flow and depth, which no image of the viewer changes."""
        shots = [(camera, float(t)) for camera, t in zip(self.path.cameras, self.scene.timestamps, strict=True)]
        return Scales.of(self.loaded.part("all"), shots)

    def frame_number(self, t: float) -> int:
        """Return the frame nearest to a time."""
        return int(np.abs(self.scene.timestamps - t).argmin())

    def frame(self, t: float) -> np.ndarray:
        """Return [H, W, 3] uint8 the input frame nearest to a time, held-out frames included: nothing learns from what is shown."""
        i = self.frame_number(t)
        return self.scene.frame(i) if i in self.scene.train_frames else self.scene.heldout_frame(i)


def _read_model(path: Path, state: str, scene: Scene) -> tuple[SceneModel, str]:
    model = load_model(path)
    check_scene(path, model, scene)
    return model, state
