"""Measure how far the priors of a prepared scene are from the truth. Shares are in percent, IoU between 0 and 1."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import cv2
import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.evaluation.placement import true_scale
from flowsplat.geometry.similarity import path_errors
from flowsplat.priors.tracks import follow_queries
from flowsplat.scenes import Flow, Layers, Scene
from flowsplat.scenes.clip import InputOptions, resize_labels
from flowsplat.scenes.formats.images import list_images
from flowsplat.scenes.formats.masks import read_labels
from flowsplat.scenes.formats.rig import RigTruth
from flowsplat.scenes.ingest import open_clip
from flowsplat_benchmarks.priors.scenes import TRUE_FLOW, BenchmarkScene

MAX_FLOW_ERROR = 1.0
"""Pixels up to which flow counts as right. Chosen by eye."""
MAX_TRACK_ERROR = 2.0
"""Pixels up to which a point of a track counts as right. Chosen by eye."""
UNKNOWN_FLOW = 1e9
"""Values above this say in a ``.flo`` file that the flow is not known."""

Figures = dict[str, float]


def measure(benchmark: BenchmarkScene, scene: Scene) -> Figures:
    """Return all figures of a scene, by the keys of ``rows``.

    Raises:
        InputError: the truth is damaged, or does not fit the scene.
    """
    return _MEASURES[benchmark.kind](benchmark, scene)


def _measure_pair(benchmark: BenchmarkScene, scene: Scene) -> Figures:
    return flow_figures([(scene.flow(0, 1), read_true_flow(benchmark, scene), None)])


def _measure_davis(benchmark: BenchmarkScene, scene: Scene) -> Figures:
    return {"masks.iou": compute_pooled_iou((scene.mask(i), true_mask(benchmark, scene, i)) for i in scene.train_frames)}


def _measure_rig(benchmark: BenchmarkScene, scene: Scene) -> Figures:
    truth = scene.truth
    assert truth is not None
    figures = flow_figures((scene.flow(i, j), truth.flow(i, j), truth.mask(i) > 0) for i, j in truth.flow_pairs)
    figures |= camera_figures(scene, truth)
    figures |= depth_figures(scene, truth)
    figures["masks.iou"] = compute_pooled_iou((scene.mask(i), truth.mask(i)) for i in scene.train_frames)
    clip = open_clip(benchmark.folder, InputOptions(holdout=None))
    assert isinstance(clip.truth, RigTruth)
    figures |= track_figures(scene, truth, clip.truth.births)
    figures["tracks.objects"] = tracks_on(scene, truth)
    return figures


_MEASURES: dict[str, Callable[[BenchmarkScene, Scene], Figures]] = {
    "pair": _measure_pair, "davis": _measure_davis, "rig": _measure_rig,
}  # fmt: skip


# -- the truth that is not in the scene


def read_true_flow(benchmark: BenchmarkScene, scene: Scene) -> Flow:
    """Return the measured flow of a pair; its confidence is 1 where it is known, else 0.

    Raises:
        InputError: damaged, or of another size than the images.
    """
    path = benchmark.folder / TRUE_FLOW
    flow = cv2.readOpticalFlow(str(path))
    if flow is None or flow.shape[:2] != (scene.height, scene.width):
        raise InputError(f"{path} does not hold flow of {scene.width}x{scene.height} pixels.")
    known = (np.abs(flow) < UNKNOWN_FLOW).all(-1)
    return Flow(0, 1, np.where(known[..., None], flow, 0).astype(np.float32), known.astype(np.float32))


def true_mask(benchmark: BenchmarkScene, scene: Scene, i: int) -> np.ndarray:
    """Return [H, W] the true mask of frame ``i`` of a DAVIS clip, 0 = background.

    Raises:
        InputError: there are not as many as images, or it is damaged.
    """
    paths, images = list_images(benchmark.folder / "masks"), list_images(benchmark.source)
    if len(paths) != len(images) or len(paths) != scene.num_frames:
        raise InputError(f"{benchmark.folder}: {len(paths)} masks, {len(images)} images, {scene.num_frames} of them prepared.")
    return resize_labels((read_labels(paths[i]) > 0).astype(np.uint8), (scene.width, scene.height))


# -- figures


def flow_figures(pairs: Iterable[tuple[Flow, Flow, np.ndarray | None]]) -> Figures:
    """Measure (estimated, true, mask of objects [H, W] bool or None), pooled over the pixels of all pairs.

    ``flow.epe``: mean end-point error of pixels with known flow, hidden ones included where a rendered scene knows it
    (``flow.epe_objects`` on objects, ``flow.epe_matched`` of those that are visible in both images); ``flow.kept``: of
    the pixels that have a match, those with a confidence of one half or more; ``flow.right``: of those kept, also without a
    match, those within a pixel of the truth.
    """
    errors, matched, kept, objects = [], [], [], []
    for estimated, true, mask in pairs:
        known = true.trusted if mask is None else np.ones(true.trusted.shape, bool)
        errors.append(np.linalg.norm(estimated.flow - true.flow, axis=-1)[known])
        matched.append(true.trusted[known])
        kept.append(estimated.trusted[known])
        objects.append(np.zeros(known.sum(), bool) if mask is None else mask[known])
    error, match, keep, moving = (np.concatenate(part) for part in (errors, matched, kept, objects))
    figures = {
        "flow.epe": _mean(error), "flow.kept": 100 * _mean(keep[match]), "flow.right": 100 * _mean(error[keep] <= MAX_FLOW_ERROR),
    }  # fmt: skip
    if moving.any():
        figures |= {"flow.epe_objects": _mean(error[moving]), "flow.epe_matched": _mean(error[match])}
        figures |= {
            "flow.epe_matched_objects": _mean(error[match & moving]),
            "flow.kept_objects": 100 * _mean(keep[match & moving]),
        }
    return figures


def camera_figures(scene: Scene, truth: Layers) -> Figures:
    """``path_errors``: rotations are aligned first, then scale and translation."""
    errors = path_errors(scene.cameras, truth.cameras)
    return {"cameras.path": 100 * errors["path"], "cameras.rotation": errors["rotation"], "cameras.focal": 100 * errors["focal"]}


def depth_figures(scene: Scene, truth: Layers) -> Figures:
    """Return the median relative error on static things and on objects, at the scale that brings our camera path onto the true one.

    Every pixel of every training frame counts, whatever its confidence.
    """
    scale = true_scale(scene)
    errors: dict[bool, list[np.ndarray]] = {False: [], True: []}
    for i in scene.train_frames:
        true, moving = truth.depth(i).depth, truth.mask(i) > 0
        error = np.abs(scale * scene.depth(i).depth / true - 1)
        for part in (False, True):
            errors[part].append(error[moving == part])
    return {
        name: 100 * float(np.median(np.concatenate(errors[part])))
        for name, part in (("depth.static", False), ("depth.objects", True))
        if sum(map(len, errors[part]))
    }


def compute_pooled_iou(masks: Iterable[tuple[np.ndarray, np.ndarray]]) -> float:
    """Return intersection over union of (ours, true), any object against background, pooled over frames; 1 where both are empty."""
    both = either = 0
    for ours, true in masks:
        both += int(((ours > 0) & (true > 0)).sum())
        either += int(((ours > 0) | (true > 0)).sum())
    return both / either if either else 1.0


def track_figures(scene: Scene, truth: Layers, births: np.ndarray) -> Figures:
    """Our tracks asked for the true points at the pixels and frames of their births.

    ``tracks.life``: of the frames in which a point is visible, its birth excepted, those in which we follow it; the median
    over points. ``tracks.within``: of all samples that we call visible, births excepted, those within two pixels of the
    true projection; ``tracks.unseen``: those of points that are hidden then. The same with ``_objects`` on objects.

    Args:
        births: [P] the frame in which each true point is asked for; negative = not at all.
    """
    true = truth.tracks
    pixels = np.stack([camera.project(true.points[:, i])[0] for i, camera in enumerate(truth.cameras)], 1)
    asked = np.flatnonzero((births >= 0) & (true.visible.sum(1) > 1))
    births, pixels, seen, moving = births[asked], pixels[asked], true.visible[asked], true.moving[asked]
    own = follow_queries(scene, births, pixels[np.arange(len(asked)), births].astype(np.float32))
    others = np.ones_like(seen)
    others[np.arange(len(asked)), births] = False
    others[:, scene.heldout_frames] = False
    alive, seen = own.visible & others, seen & others
    near = np.linalg.norm(own.points - pixels, axis=-1) <= MAX_TRACK_ERROR
    figures = {}
    for suffix, part in (("", np.ones(len(asked), bool)), ("_objects", moving)):
        if seen[part].any():
            life = (alive & seen)[part].sum(1) / np.maximum(seen[part].sum(1), 1)
            figures[f"tracks.life{suffix}"] = 100 * float(np.median(life[seen[part].any(1)]))
            figures[f"tracks.within{suffix}"] = 100 * _mean(near[part][alive[part]])
            figures[f"tracks.unseen{suffix}"] = 100 * _mean(~seen[part][alive[part]])
    return figures


def tracks_on(scene: Scene, truth: Layers) -> float:
    """Return how many of the scene's own tracks were on objects, by the true masks, in most of their frames."""
    tracks = scene.tracks
    inside = np.zeros(len(tracks.points))
    for i in scene.train_frames:
        here = np.flatnonzero(tracks.visible[:, i])
        x, y = np.clip(tracks.points[here, i].astype(int), 0, [scene.width - 1, scene.height - 1]).T
        inside[here] += truth.mask(i)[y, x] > 0
    return float((inside > 0.5 * tracks.visible.sum(1)).sum())


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else 0.0
