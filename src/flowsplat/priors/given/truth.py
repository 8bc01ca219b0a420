"""The truth of a rendered scene as its priors."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.geometry import Camera
from flowsplat.scenes import Scene, Tracks
from flowsplat.scenes.layers import Layers


def consecutive_pairs(scene: Scene) -> list[tuple[int, int]]:
    """Both directions between neighbouring training frames."""
    return [pair for i, j in pairwise(scene.train_frames) for pair in ((i, j), (j, i))]


def true_layers(scene: Scene) -> Layers:
    """The truth of a rendered scene.

    Raises:
        InputError: the scene has no truth.
    """
    truth = scene.truth
    if truth is None or not truth.has_cameras:
        raise InputError(f"{scene.name} has no truth: only rendered scenes do. Use --priors own.")
    return truth


def use_truth(scene: Scene) -> None:
    """Make the truth of a rendered scene its priors; held-out frames give their cameras and nothing else.

    Flow pairs that the truth does not have (across a held-out frame) are left to the flow stage.

    Raises:
        InputError: the scene has no truth.
    """
    truth = true_layers(scene)
    scene.write_cameras(truth.cameras)
    scene.finish_prior("cameras", method="truth", verdict="true cameras")
    for i in scene.train_frames:
        scene.write_depth(i, truth.depth(i))
        scene.write_mask(i, truth.mask(i))
    scene.finish_prior("depth", method="truth", verdict="true depth")
    scene.finish_prior("masks", method="truth", verdict="true masks")
    known = set(truth.flow_pairs)
    wanted = consecutive_pairs(scene)
    for pair in wanted:
        if pair in known:
            scene.write_flow(truth.flow(*pair))
    if known.issuperset(wanted):
        scene.finish_prior("flow", method="truth", verdict="true flow")
    if truth.has_tracks:
        scene.write_tracks(_projected(truth.tracks, truth.cameras, scene.train_frames))
        scene.finish_prior("tracks", method="truth", verdict="true tracks")


def _projected(tracks: Tracks, cameras: Sequence[Camera], train_frames: Sequence[int]) -> Tracks:
    """World tracks [P, T, 3] as pixels [P, T, 2], seen in training frames only."""
    points = np.zeros((*tracks.points.shape[:2], 2), np.float32)
    visible = np.zeros_like(tracks.visible)
    for i in train_frames:
        pixels, depth = cameras[i].project(tracks.points[:, i].astype(np.float64))
        seen = tracks.visible[:, i] & (depth > 0)
        points[seen, i], visible[:, i] = pixels[seen], seen
    return Tracks(points, visible, np.where(visible, tracks.confidence, 0), tracks.moving)
