"""The tiny data root of the runs, and a scene whose priors are wrong in known ways."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flowsplat.geometry import Similarity
from flowsplat.priors.prepare import use_truth
from flowsplat.scenes import Depth, Flow
from flowsplat.scenes.synthetic import SyntheticScene, write_synthetic
from tests.flowsplat_benchmarks.datasets.conftest import runs_root

__all__ = ["runs_root"]

SCALE = 0.5
"""Units of the cameras per unit of the truth."""
STATIC, CONSTANT, TRAJECTORY, SHAPE_OFFSET = 0.02, 0.3, 0.1, 0.06
"""Errors of ln depth: of what rests; and of object 1: over the clip, of every other frame, of every third column."""
LEAK = 3
"""Pixels by which masks are shifted."""
SHADOW = 9
"""Number of an object that is none."""


def own_mask(true: np.ndarray, i: int) -> np.ndarray:
    """Shifted; object 1 is object 4, object 2 is 5 and later 6, object 3 is 7; and something that does not move."""
    mask = np.zeros_like(true)
    for number, own in ((1, 4), (2, 5 if i < 4 else 6), (3, 7)):
        mask[true == number] = own
    mask = np.roll(mask, LEAK, axis=1)
    rest = np.roll(true, LEAK, axis=1) + true == 0
    mask[-6:, :20][rest[-6:, :20]] = SHADOW
    return mask


def object_error(i: int, shape: tuple[int, ...]) -> np.ndarray:
    """[H, W] ln of estimated over true depth of object 1 in frame ``i``."""
    columns = np.broadcast_to(np.arange(shape[1]) % 3 - 1, shape)
    return CONSTANT + TRAJECTORY * (-1, 1)[i % 2] + SHAPE_OFFSET * columns


@pytest.fixture(scope="session")
def wrong_scene(tmp_path_factory) -> Path:
    """Cameras of another scale, masks that leak, depth and flow that are off."""
    folder = tmp_path_factory.mktemp("oracles") / "wrong"
    scene = write_synthetic(folder, SyntheticScene(width=96, height=64, frames=8, fps=12.0))
    use_truth(scene)
    truth = scene.truth
    assert truth is not None
    scene.write_cameras([Similarity(SCALE).camera(camera) for camera in truth.cameras])
    for i in scene.train_frames:
        mask, true, depth = own_mask(truth.mask(i), i), truth.mask(i), SCALE * truth.depth(i).depth
        error = np.full(depth.shape, STATIC)
        error[mask == 4] = object_error(i, depth.shape)[mask == 4]
        error[(mask > 0) & (mask != 4)] = -0.2
        scene.write_depth(i, Depth(depth * np.exp(error), np.where((mask > 0) | (true == 0), 0.6, 0.0)))
        scene.write_mask(i, mask)
    for pair in scene.flow_pairs:
        true_flow = scene.flow(*pair)
        scene.write_flow(Flow(*pair, true_flow.flow + np.float32(0.5), true_flow.confidence))
    scene.write_tracks(replace(scene.tracks, points=scene.tracks.points + 0.5))
    for name in ("cameras", "depth", "masks", "flow", "tracks"):
        scene.finish_prior(name, method="test", verdict="wrong")
    _ = scene.similarity
    return folder
