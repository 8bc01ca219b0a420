"""The synthetic clip as a scene folder, and as a video."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np

from flowsplat.common.progress import track
from flowsplat.pictures.video import write_mp4
from flowsplat.scenes.layers import Depth
from flowsplat.scenes.scene import Scene
from flowsplat.scenes.synthetic.synthetic_scene import SyntheticScene


def write_synthetic(folder: Path, spec: SyntheticScene, *, holdout: int | None = None, with_truth: bool = True) -> Scene:
    """Render the clip into a scene folder, without any prior.

    Args:
        holdout: every how many frames one is held out; None = none.
        with_truth: also write the truth (cameras, depth, masks and tracks of all frames; flow both ways between
            neighbouring frames, and between neighbouring training frames) and the held-out views.

    Raises:
        InputError: the folder cannot be written, or too few training frames remain.
    """
    scene = Scene.create(
        folder,
        name="synthetic",
        source="synthetic",
        width=spec.width,
        height=spec.height,
        timestamps=spec.timestamps.tolist(),
        holdout=holdout,
        source_fps=spec.fps,
    )
    truth = scene.create_truth() if with_truth else None
    for i in track(range(spec.frames), "Rendering the synthetic clip"):
        view = spec.render(spec.camera(i), spec.timestamps[i])
        scene.write_frame(i, view.picture)
        if truth:
            truth.write_depth(i, Depth(view.depth, np.ones_like(view.depth)))
            truth.write_mask(i, view.mask)
    if not truth:
        return scene
    truth.write_cameras([spec.camera(i) for i in range(spec.frames)])
    truth.write_tracks(spec.tracks())
    neighbours = {*pairwise(range(spec.frames)), *pairwise(scene.train_frames)}
    for i, j in track(sorted(neighbours), "Writing its true flow"):
        truth.write_flow(spec.flow(i, j))
        truth.write_flow(spec.flow(j, i))
    for heldout in track(spec.heldout_views(), "Rendering its held-out views"):
        view = spec.render(heldout.camera, spec.timestamps[heldout.frame])
        scene.write_view(heldout, view.picture, view.mask, spec.covisible(heldout))
    return scene


def write_synthetic_video(path: Path, spec: SyntheticScene) -> None:
    """Render the clip and encode it as a nearly lossless mp4.

    Raises:
        InputError: the file cannot be written.
    """
    frames = (
        spec.render(spec.camera(i), spec.timestamps[i]).picture for i in track(range(spec.frames), "Rendering the synthetic clip")
    )
    write_mp4(path, frames, spec.fps, crf=12)
