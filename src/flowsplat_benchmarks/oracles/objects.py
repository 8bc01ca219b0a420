"""The objects of a rendered scene's masks beside the true ones: which object is which true one, and how wrong its depth is.

The estimated cameras have a scale of their own, so true depth is first brought to it by one factor for the whole clip
(``depth_scale``). How wrong the depth of an object is falls into three parts of e = ln(estimated / true) over its pixels, of which
each needs another cure: one number for the clip (``constant``), how it is off over time (``depth_trajectory``), and what is left
inside a frame (``shape_offset``).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.evaluation.placement import true_scale
from flowsplat.scenes import Layers, Scene

MIN_OBJECT_SHARE = 0.2
"""Share of an object's pixels that must lie on the true object that it is on most, else it is on none. Chosen by eye."""
MIN_PIXELS = 20
"""Pixels of an object in a frame from which that frame tells how its depth changes over time. Chosen by eye."""


@dataclass(frozen=True)
class MatchedObject:
    """Objects of the scene's masks that are on one true object.

    Attributes:
        true: its number in the true masks; 0 = the one object is on nothing that moves.
        ids: numbers in the scene's masks.
    """

    true: int
    ids: tuple[int, ...]

    def region(self, mask: np.ndarray) -> np.ndarray:
        """Return [H, W] bool: its pixels in the scene's mask [H, W] of a frame."""
        return np.isin(mask, self.ids)

    def select_compared(self, mask: np.ndarray, true_mask: np.ndarray) -> np.ndarray:
        """Return [H, W] bool: those of its pixels that are truly on the object; all of them if it is on nothing that moves."""
        region = self.region(mask)
        return region & (true_mask == self.true) if self.true else region


@dataclass(frozen=True)
class ObjectDepthError:
    """How wrong the depth of an object is, in natural logarithms of estimated over true depth: .01 is one percent too far.

    Attributes:
        matched: which.
        pixels: how many were compared.
        frames: in how many frames.
        constant: median over pixels and frames.
        depth trajectory: standard deviation over time of the median of a frame; None with less than two frames that tell.
        shape offset: median over pixels and frames of the absolute difference from the median of the frame.
    """

    matched: MatchedObject
    pixels: int
    frames: int
    constant: float
    depth_trajectory: float | None
    shape_offset: float


def truth_of(scene: Scene) -> Layers:
    """Return the truth of a rendered scene.

    Raises:
        InputError: it has none, or no depth and masks.
    """
    truth, first = scene.truth, scene.train_frames[0]
    if truth is None or not (truth.has_cameras and truth.has_depth(first) and truth.has_mask(first)):
        raise InputError(f"{scene.name} has no true cameras, depth and masks: only rendered scenes do.")
    return truth


def depth_scale(scene: Scene) -> float:
    """Units of the scene's cameras per unit of the truth, one factor for the clip: from the camera paths; 1 with true cameras.

    Not from static depth, which has a bias of its own (``static_error``) that would become one of the objects. On the rendered
    scenes workshop and garden true depth times this factor leads from frame to frame, 8 and 16 apart, with estimated cameras to
    within .06 and .04 pixels (median) of where the truth leads, and to the held-out cameras, which are placed by the same
    factor, to within .02. No other factor does better in the root mean square. Static depth alone would ask for .6 % less, and
    that costs workshop with true depth 2.2 dB inside objects.
    """
    return 1 / true_scale(scene)


def static_error(scene: Scene) -> float:
    """Return the median of ln(estimated / true) depth over trusted static pixels of all training frames: by how much an object at
    its true distance misses what it stands on.

    Raises:
        InputError: the scene has no truth.
    """
    truth, scale, off = truth_of(scene), depth_scale(scene), []
    for i, mask, true_mask in masks_of(scene):
        depth = scene.depth(i)
        static = depth.trusted & (mask == 0) & (true_mask == 0)
        off.append(np.log(depth.depth[static] / (scale * truth.depth(i).depth[static])))
    pooled = np.concatenate(off)
    return float(np.median(pooled)) if len(pooled) else 0.0


def match_objects(scene: Scene) -> list[MatchedObject]:
    """Return every object of the scene's masks on the true object that most of it is on over the clip, or on none.

    Returns:
        the true objects that were found, by number; then every object that is on none.
    """
    truth = truth_of(scene)
    counts = np.zeros((256, 256), np.int64)
    for i in scene.train_frames:
        pairs = scene.mask(i).astype(np.int64) * 256 + truth.mask(i)
        counts += np.bincount(pairs.ravel(), minlength=256 * 256).reshape(256, 256)
    found: dict[int, list[int]] = {}
    alone = []
    for number in map(int, np.flatnonzero(counts[1:].sum(1)) + 1):
        best = int(counts[number, 1:].argmax()) + 1
        if counts[number, best] >= MIN_OBJECT_SHARE * counts[number].sum():
            found.setdefault(best, []).append(number)
        else:
            alone.append(MatchedObject(0, (number,)))
    return [MatchedObject(true, tuple(objects)) for true, objects in sorted(found.items())] + alone


def object_depth_errors(scene: Scene, objects: Sequence[MatchedObject] | None = None) -> list[ObjectDepthError]:
    """Return how wrong the depth of every object is, over the training frames.

    Args:
        objects: which; None = ``match_objects``.

    Raises:
        InputError: the scene has no truth, or no depth and masks yet.
    """
    objects = match_objects(scene) if objects is None else objects
    truth, scale = truth_of(scene), depth_scale(scene)
    frames: dict[MatchedObject, list[np.ndarray]] = {obj: [] for obj in objects}
    for i, mask, true_mask in masks_of(scene):
        off = np.log(scene.depth(i).depth / (scale * truth.depth(i).depth))
        for obj in objects:
            inside = obj.select_compared(mask, true_mask)
            if inside.any():
                frames[obj].append(off[inside].astype(np.float64))
    return [_error(obj, frames[obj]) for obj in objects if frames[obj]]


def _error(obj: MatchedObject, frames: Sequence[np.ndarray]) -> ObjectDepthError:
    pooled = np.concatenate(frames)
    depth_trajectory = [np.median(values) for values in frames if len(values) >= MIN_PIXELS]
    left = np.concatenate([np.abs(values - np.median(values)) for values in frames])
    return ObjectDepthError(
        obj, len(pooled), len(frames), float(np.median(pooled)),
        float(np.std(depth_trajectory)) if len(depth_trajectory) > 1 else None,
        float(np.median(left)),
    )  # fmt: skip


def masks_of(scene: Scene) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Yield (training frame, the scene's mask [H, W], the true mask [H, W])."""
    truth = truth_of(scene)
    for i in scene.train_frames:
        yield i, scene.mask(i), truth.mask(i)
