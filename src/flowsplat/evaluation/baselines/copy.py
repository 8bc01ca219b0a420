"""The clip's own frame as it is: the training frame before, or of a view the frame of its time."""

from __future__ import annotations

import cv2
import numpy as np

from flowsplat.common.registry import Entry
from flowsplat.evaluation.baselines import BASELINES, Baseline, HeldoutImage, to_float
from flowsplat.geometry import Camera


def predict_by_copy(image: HeldoutImage) -> np.ndarray:
    """Return the frame."""
    if image.view is None:
        return to_float(image.neighbors[0])
    return copy_to_view(image.frame_of_view, image.view.camera)


def copy_to_view(image: np.ndarray, view: Camera) -> np.ndarray:
    """Return the clip's frame (uint8) as it is, in the size of the other camera's image."""
    size = (view.width, view.height)
    return to_float(image if image.shape[1::-1] == size else cv2.resize(image, size, interpolation=cv2.INTER_AREA))


BASELINES.add(Entry("copy", "copy of the clip's frame", "The frame before.", Baseline(predict_by_copy), place=10))
