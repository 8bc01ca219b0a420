"""Priors that need no computing: the truth of a rendered scene, and files that the user brings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.files import read_json, read_npz
from flowsplat.geometry import Camera
from flowsplat.scenes import Depth, Flow, Scene, Tracks
from flowsplat.scenes.clip import resize_labels
from flowsplat.scenes.formats.masks import GivenMasks, read_labels
from flowsplat.scenes.layers import FLOW_UNIT

FLO_MAGIC = 202021.25
"""First number of a Middlebury ``.flo`` file (https://vision.middlebury.edu/flow/code/flow-code/README.txt)."""


@dataclass(frozen=True)
class GivenPriors:
    """Files that replace what would be computed. Pictures may have another size than the scene, but not another shape."""

    cameras: Path | None = None
    """A JSON list with one camera a frame of the clip: ``viewmat`` [4, 4] world to camera (OpenCV axes), ``K`` [3, 3],
    ``width``, ``height``."""
    depth: Path | None = None
    """A folder of ``00000.npy`` ... [H, W]: planar depth in the units of the cameras, for every training frame."""
    masks: Path | None = None
    """A folder of ``00000.png`` ...: object numbers or colours, black = background, for every training frame. Masks of
    held-out frames are kept for the evaluation."""
    flow: Path | None = None
    """A folder of ``00000_00001.npz`` (as in a scene folder) or ``00000_00001.flo``: flow in pixels, both ways between
    consecutive training frames."""


def consecutive_pairs(scene: Scene) -> list[tuple[int, int]]:
    """Both directions between neighbouring training frames."""
    return [pair for i, j in pairwise(scene.train_frames) for pair in ((i, j), (j, i))]


def use_truth(scene: Scene) -> None:
    """Make the truth of a rendered scene its priors; held-out frames give their cameras and nothing else.

    Flow pairs that the truth does not have (across a held-out frame) are left to the flow stage.

    Raises:
        InputError: the scene has no truth.
    """
    truth = scene.truth
    if truth is None or not truth.has_cameras:
        raise InputError(f"{scene.name} has no truth: only rendered scenes do. Use --priors own.")
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


def use_given(scene: Scene, given: GivenPriors) -> None:
    """Read the user's files into the scene, those that are named.

    Raises:
        InputError: a file is missing, cannot be read, has another shape than the frames, or holds impossible values.
    """
    if given.cameras is not None:
        scene.write_cameras(_read_cameras(given.cameras, scene))
        scene.finish_prior("cameras", method="given", verdict=f"from {given.cameras}")
    if given.depth is not None:
        for i in scene.train_frames:
            depth = _read_depth(given.depth / f"{i:05d}.npy", scene)
            scene.write_depth(i, Depth(depth, np.ones_like(depth)))
        scene.finish_prior("depth", method="given", verdict=f"from {given.depth}")
    if given.masks is not None:
        _use_masks(scene, given.masks)
    if given.flow is not None:
        for i, j in consecutive_pairs(scene):
            scene.write_flow(_read_flow(given.flow, i, j, scene))
        scene.finish_prior("flow", method="given", verdict=f"from {given.flow}")


def _require_shape(path: Path, width: int, height: int, scene: Scene) -> None:
    if abs(width * scene.height - height * scene.width) > max(scene.width, scene.height, width, height):
        raise InputError(
            f"{path} is {width}x{height} pixels, which is another shape than the frames ({scene.width}x{scene.height}): "
            "give priors of the whole, uncropped picture."
        )


def _read_cameras(path: Path, scene: Scene) -> list[Camera]:
    try:
        cameras = [Camera.from_json(value) for value in read_json(path)]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} does not hold cameras (a list with viewmat, K, width, height each): {error}.") from error
    if len(cameras) != scene.num_frames:
        raise InputError(f"{path} holds {len(cameras)} cameras, but the clip has {scene.num_frames} frames: give one a frame.")
    for index, camera in enumerate(cameras):
        if not camera.is_finite:
            raise InputError(f"{path}: the camera of frame {index} is not finite or its viewmat is not a rotation.")
        _require_shape(path, camera.width, camera.height, scene)
    return [camera.resized(scene.width, scene.height) for camera in cameras]


def _read_depth(path: Path, scene: Scene) -> np.ndarray:
    try:
        depth = np.load(path, allow_pickle=False)
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist: give depth for every training frame.") from error
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"{path} is not a readable .npy file: {error}.") from error
    if not isinstance(depth, np.ndarray) or depth.ndim != 2 or depth.dtype.kind not in "fiu":
        raise InputError(f"{path} does not hold one depth map [height, width] of numbers.")
    _require_shape(path, depth.shape[1], depth.shape[0], scene)
    if not (np.isfinite(depth).all() and (depth > 0).all()):
        raise InputError(f"{path} holds depths that are not finite and positive: fill them in first.")
    return resize_labels(depth.astype(np.float32), (scene.width, scene.height))


def _use_masks(scene: Scene, folder: Path) -> None:
    paths = {str(i): folder / f"{i:05d}.png" for i in range(scene.num_frames)}
    for i in scene.train_frames:
        if not paths[str(i)].exists():
            raise InputError(f"{paths[str(i)]} does not exist: give a mask for every training frame.")
    first = paths[str(scene.train_frames[0])]
    height, width = read_labels(first).shape
    _require_shape(first, width, height, scene)
    training = GivenMasks.scan({str(i): paths[str(i)] for i in scene.train_frames}, (width, height))
    size = (scene.width, scene.height)
    for i in scene.train_frames:
        scene.write_mask(i, training.read(str(i), size))
    for i in scene.heldout_frames:
        if paths[str(i)].exists():
            labels = read_labels(paths[str(i)])
            scene.heldout_masks.write_mask(i, resize_labels((labels > 0).astype(np.uint8), size))
    scene.finish_prior("masks", method="given", verdict=f"from {folder}")


def _read_flow(folder: Path, i: int, j: int, scene: Scene) -> Flow:
    stored, raw = (folder / f"{i:05d}_{j:05d}{suffix}" for suffix in (".npz", ".flo"))
    if stored.exists():
        path, arrays = stored, read_npz(stored)
        if not {"flow", "confidence"} <= arrays.keys():
            raise InputError(f"{path} needs the arrays 'flow' and 'confidence'.")
        # Whole numbers are 1/64 pixels and 255 is certain, as in a scene folder; floating-point numbers mean themselves.
        flow, confidence = arrays["flow"], arrays["confidence"]
        flow = flow / np.float32(FLOW_UNIT) if flow.dtype.kind in "iu" else flow.astype(np.float32)
        confidence = confidence / np.float32(255) if confidence.dtype.kind in "iu" else confidence.astype(np.float32)
    elif raw.exists():
        path, flow = raw, _read_flo(raw)
        confidence = np.ones(flow.shape[:2], np.float32)
    else:
        raise InputError(f"{stored} does not exist: give flow both ways between consecutive training frames.")
    if flow.ndim != 3 or flow.shape[2] != 2 or confidence.shape != flow.shape[:2]:
        raise InputError(f"{path} does not hold flow [height, width, 2] with a confidence [height, width].")
    height, width = flow.shape[:2]
    _require_shape(path, width, height, scene)
    if not (np.isfinite(flow).all() and np.isfinite(confidence).all()):
        raise InputError(f"{path} holds values that are not finite: set them to 0 with confidence 0.")
    size = (scene.width, scene.height)
    scale = np.array([scene.width / width, scene.height / height], np.float32)
    resized = cv2.resize(flow, size, interpolation=cv2.INTER_LINEAR) * scale
    return Flow(i, j, resized, resize_labels(np.clip(confidence, 0, 1), size))


def _read_flo(path: Path) -> np.ndarray:
    data = path.read_bytes()
    if len(data) < 12 or np.frombuffer(data, "<f4", 1)[0] != np.float32(FLO_MAGIC):
        raise InputError(f"{path} is not a Middlebury .flo file.")
    width, height = (int(value) for value in np.frombuffer(data, "<i4", 2, offset=4))
    if width <= 0 or height <= 0 or len(data) != 12 + 8 * width * height:
        raise InputError(f"{path} is damaged or truncated.")
    return np.frombuffer(data, "<f4", offset=12).reshape(height, width, 2).astype(np.float32)
