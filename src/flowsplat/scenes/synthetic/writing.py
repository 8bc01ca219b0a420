"""A drawn clip as a scene folder, and as a video."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path

import numpy as np

from flowsplat.common.progress import track
from flowsplat.common.threads import get_max_threads, in_threads
from flowsplat.images.video import write_mp4
from flowsplat.scenes.layers import Depth
from flowsplat.scenes.scene import Scene
from flowsplat.scenes.synthetic.drawn_clip import DrawnClip

CRF = 12
"""Of x264: nearly lossless. Chosen by eye."""


def write_synthetic(folder: str | Path, spec: DrawnClip, *, holdout: int | None = None, with_truth: bool = True) -> Scene:
    """Render the clip into a scene folder, without any prior.

    Args:
        holdout: every how many frames one is held out; None = none.
        with_truth: also write the truth (cameras, depth, masks and tracks of all frames; flow both ways between
            neighboring frames, and between neighboring training frames) and the held-out views.

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
    truth, threads = scene.create_truth() if with_truth else None, get_max_threads()
    cameras = [spec.camera(i) for i in range(spec.frames)]
    frames = in_threads(lambda i: spec.render(cameras[i], spec.timestamps[i]), range(spec.frames), threads)
    for i, view in enumerate(track(frames, "Rendering the synthetic clip", spec.frames)):
        scene.write_frame(i, view.image)
        if truth:
            truth.write_depth(i, Depth(view.depth, np.ones_like(view.depth)))
            truth.write_mask(i, view.mask)
    if not truth:
        return scene
    truth.write_cameras(cameras)
    truth.write_tracks(spec.tracks())
    neighbors = sorted({*pairwise(range(spec.frames)), *pairwise(scene.train_frames)})
    flows = in_threads(lambda pair: (spec.flow(*pair), spec.flow(*pair[::-1])), neighbors, threads)
    for forward, backward in track(flows, "Writing its true flow", len(neighbors)):
        truth.write_flow(forward)
        truth.write_flow(backward)
    heldout = spec.heldout_views()
    views = in_threads(lambda each: (spec.render(each.camera, spec.timestamps[each.frame]), spec.covisible(each)), heldout, threads)
    for each, (view, seen) in zip(heldout, track(views, "Rendering its held-out views", len(heldout)), strict=True):
        scene.write_view(each, view.image, view.mask, seen)
    return scene


def write_synthetic_video(path: str | Path, spec: DrawnClip) -> None:
    """Render the clip and encode it as a nearly lossless mp4.

    Raises:
        InputError: the file cannot be written.
    """
    frames = in_threads(lambda i: spec.render(spec.camera(i), spec.timestamps[i]).image, range(spec.frames), get_max_threads())
    write_mp4(Path(path), track(frames, "Rendering the synthetic clip", spec.frames), spec.fps, crf=CRF)


def encode_frames(path: Path, scene: Scene) -> None:
    """The video that ``write_synthetic_video`` writes, of the frames that a scene folder holds already.

    Raises:
        InputError: a frame is missing, or the file cannot be written.
    """
    heldout = set(scene.heldout_frames)
    frames: Iterable[np.ndarray] = (scene.heldout_frame(i) if i in heldout else scene.frame(i) for i in range(scene.num_frames))
    write_mp4(path, frames, float(scene.info.source_fps), crf=CRF)
