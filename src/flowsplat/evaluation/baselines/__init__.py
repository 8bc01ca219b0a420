"""Baselines: what a held-out image looks like without the model that is measured. Each is a file of this folder, or of another
package (entry points ``flowsplat.baselines``); ``metrics.json`` has it by its name, tables by its title.

A 4D model that does not beat ``flow_interpolation`` has not learned the scene's motion. All images are float32 RGB [H, W, 3]
between 0 and 1.
"""

from __future__ import annotations

import bisect
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from flowsplat.common.registry import Registry
from flowsplat.scenes import HeldoutView, Scene


@dataclass(frozen=True)
class HeldoutImage:
    """What is to be predicted: a held-out frame, or a held-out view.

    Attributes:
        scene: whose training frames may be used; of a view, the frame of its time, too.
        frame: its number, of a view that of its time.
        view: None = it is a frame of the clip.
        render_static: gives what a model without motion renders there; None = there is none.
    """

    scene: Scene
    frame: int
    view: HeldoutView | None = None
    render_static: Callable[[], np.ndarray] | None = None

    @cached_property
    def neighbors(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Training frames before and after it, [H, W, 3] uint8, and how far it is from the one to the other, 0 to 1: before the
        first training frame and after the last that one, twice."""
        scene, frames = self.scene, self.scene.train_frames
        following = bisect.bisect(frames, self.frame)
        if following in (0, len(frames)):
            only = scene.frame(frames[0 if following == 0 else -1])
            return only, only, 0.0
        before, after = frames[following - 1], frames[following]
        span = scene.timestamps[after] - scene.timestamps[before]
        fraction = float((scene.timestamps[self.frame] - scene.timestamps[before]) / span)
        return scene.frame(before), scene.frame(after), fraction

    @cached_property
    def frame_of_view(self) -> np.ndarray:
        """[H, W, 3] uint8 the clip's frame of the same time, held out or not: of a view."""
        is_heldout = self.frame in self.scene.heldout_frames
        return self.scene.heldout_frame(self.frame) if is_heldout else self.scene.frame(self.frame)


@dataclass(frozen=True)
class Baseline:
    """A baseline.

    Attributes:
        predict: returns the image [H, W, 3], None where it cannot be told.
        of_frames: it predicts held-out frames.
        of_views: it predicts held-out views.
    """

    predict: Callable[[HeldoutImage], np.ndarray | None]
    of_frames: bool = True
    of_views: bool = True


BASELINES: Registry[Baseline] = Registry("baseline", __name__, "flowsplat.baselines")


def list_baselines(of_views: bool) -> tuple[str, ...]:
    """Return the names of those for held-out views, or of those for held-out frames."""
    return tuple(entry.name for entry in BASELINES.entries() if (entry.value.of_views if of_views else entry.value.of_frames))


def title_of(name: str) -> str:
    """Return what tables call a baseline: its name where it is not known here."""
    return BASELINES.entry(name).title if name in BASELINES else name


def predict(image: HeldoutImage) -> dict[str, np.ndarray]:
    """Return the image as every baseline predicts it that can, by name."""
    found = {name: BASELINES[name].predict(image) for name in list_baselines(image.view is not None)}
    return {name: predicted for name, predicted in found.items() if predicted is not None}


def to_float(image: np.ndarray) -> np.ndarray:
    """uint8 to float32 between 0 and 1."""
    return image.astype(np.float32) / 255
