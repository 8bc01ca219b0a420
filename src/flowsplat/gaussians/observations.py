"""The training frames of a scene in memory, in the normalized coordinates of the model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.geometry import Camera, Similarity
from flowsplat.scenes import Flow, Scene, StoredFlow


@dataclass(frozen=True)
class Observation:
    """One training frame.

    Attributes:
        frame: its number in the clip.
        time: clip time.
        camera: in normalized coordinates.
        image: [H, W, 3] uint8 sRGB.
        depth: [H, W] float32, median of all frames 1.
        depth_trusted: [H, W] bool.
        objects: [H, W] uint8 number of the moving object in a pixel, 0 = background.
        forward: flow to the next training frame; None in the last.
        backward: flow to the previous training frame, or what reads it: only the start asks for it. None in the first.
    """

    frame: int
    time: float
    camera: Camera
    image: np.ndarray
    depth: np.ndarray
    depth_trusted: np.ndarray
    object_ids: np.ndarray
    forward: Flow | StoredFlow | None
    backward: Flow | StoredFlow | Callable[[], StoredFlow] | None

    def flow(self, step: int) -> Flow | StoredFlow | None:
        """Return the flow to the next training frame (1) or to the previous one (-1)."""
        found = self.forward if step > 0 else self.backward
        return found() if callable(found) else found

    @property
    def mask(self) -> np.ndarray:
        """[H, W] bool: moving objects."""
        return self.object_ids > 0


@dataclass(frozen=True)
class Observations:
    """All training frames, in order; the similarity that normalized them; and [H, W] bool what is burnt into them, if anything."""

    frames: list[Observation]
    similarity: Similarity
    overlay: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, k: int) -> Observation:
        return self.frames[k]

    @property
    def times(self) -> np.ndarray:
        """[T] clip times of the frames."""
        return np.array([frame.time for frame in self.frames])

    @property
    def focal(self) -> float:
        """Pixels that a unit of length has at the median depth."""
        return float(self.frames[0].camera.K[0, 0])

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)."""
        return self.frames[0].camera.width, self.frames[0].camera.height


def load_observations(scene: Scene) -> Observations:
    """Read the training frames with all their priors.

    Raises:
        InputError: a prior is missing.
    """
    for name in ("cameras", "flow", "depth", "masks"):
        if scene.prior(name) is None:
            raise InputError(f"{scene.folder} has no {name} yet: run flowsplat prepare on it first.")
    similarity, times, train = scene.similarity, scene.times, scene.train_frames
    pairs = set(scene.flow_pairs)

    frames = []
    for k, i in enumerate(train):
        depth = scene.depth(i)
        after, before = train[k + 1] if k + 1 < len(train) else -1, train[k - 1] if k > 0 else -1
        frames.append(
            Observation(
                frame=i,
                time=float(times[i]),
                camera=similarity.camera(scene.cameras[i]),
                image=scene.frame(i),
                depth=depth.depth * np.float32(similarity.scale),
                depth_trusted=depth.trusted,
                object_ids=scene.mask(i),
                forward=scene.read_stored_flow(i, after) if (i, after) in pairs else None,
                backward=partial(scene.read_stored_flow, i, before) if (i, before) in pairs else None,
            )
        )
    return Observations(frames, similarity, scene.overlay)
