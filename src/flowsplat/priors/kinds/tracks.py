"""Tracks: points followed along the flow, and completed by the paths of resting points once depth tells these."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from flowsplat.geometry import Camera
from flowsplat.priors.given.tracks import read_tracks, write_tracks
from flowsplat.priors.prior import Kind, Request, Stage
from flowsplat.priors.tracks import complete_tracks, tracks_stage
from flowsplat.scenes import Scene, Tracks
from flowsplat.scenes.layers import Layers


def _read_true(scene: Scene, truth: Layers) -> bool:
    if truth.has_tracks:
        scene.write_tracks(_project(truth.tracks, truth.cameras, scene.train_frames))
    return truth.has_tracks


def _project(tracks: Tracks, cameras: Sequence[Camera], train_frames: Sequence[int]) -> Tracks:
    """World tracks [P, T, 3] as pixels [P, T, 2], seen in training frames only."""
    points = np.zeros((*tracks.points.shape[:2], 2), np.float32)
    visible = np.zeros_like(tracks.visible)
    for i in train_frames:
        pixels, depth = cameras[i].project(tracks.points[:, i].astype(np.float64))
        seen = tracks.visible[:, i] & (depth > 0)
        points[seen, i], visible[:, i] = pixels[seen], seen
    return Tracks(points, visible, np.where(visible, tracks.confidence, 0), tracks.moving)


def _read_given(request: Request, path: Path) -> Stage:
    """Which of them are on objects, masks have to tell."""
    tracks = read_tracks(path, request.scene, request.options.given.tracks_size)
    return partial(write_tracks, tracks, path, request.scene)


TRACKS = Kind(
    compute=lambda request: partial(tracks_stage, request.scene),
    files=("tracks.npz",),
    own=("patches",),
    read_true=_read_true,
    read_given=_read_given,
    given_replaces=True,
)

RESTING_TRACKS = Kind(
    compute=lambda request: partial(complete_tracks, request.scene),
    is_due=lambda request: bool((request.scene.prior("tracks") or {}).get("incomplete")),
)
