"""A model and its scene to figures: held-out frames and views, training frames, baselines, flow and depth
(docs/method/evaluation.md).

The keys of ``metrics.json``. Every number is finite; what could not be measured is null:

- ``heldout_frames``: ``psnr``, ``ssim``, ``lpips``, ``detail``, ``contrast`` (means over the images), ``count``, and the same in
  ``moving``, inside the given masks or, where there are none, the true ones. Runs of earlier versions have no ``detail``.
- ``heldout_frames_refined``: the same figures with the pose of every held-out frame refined on its own image. Never the
  headline; null where that was not asked for. In ``per_image`` they are each image's ``refined``.
- ``heldout_views``: as ``heldout_frames``, and in ``covisible``, the pixels that the clip saw.
- ``training_frames``: the same on one training frame in ``training_stride``; ``moving`` is the true or else the scene's own mask.
- ``baselines``: held-out frames by ``copy``, ``blend``, ``flow_interpolation`` and the ``static`` model.
- ``baselines_views``: held-out views by ``copy``, ``warp_by_depth`` (true depth and cameras) and the ``static`` model, each with
  ``moving`` and ``covisible``, too.
- ``flow_epe``: rendered flow to the next training frame against the truth, ``mean`` and ``median`` in pixels, and both
  in ``moving``; on every pair that truth has.
- ``prior_flow_epe``: that of the flow prior instead of the rendered flow, on the same pixels: what the model was taught by.
- ``flow_prior_epe``: rendered flow against the trusted pixels of the flow prior, on the training frames that were rendered.
- ``depth_abs_rel``: rendered depth against the truth, relative: ``mean`` and ``median`` in ``all``, ``static`` and
  ``moving``.
- ``measured``: the folder of the model that every figure is of; ``shown``: of the one that videos and exports show (of a run).
- ``gaussians`` (of a run): ``total``, those ``active`` in each frame, their mean ``active_mean``, and of ``objects`` by number.
- ``objects`` (of a run): a list, an object each: number, frames, distance with its sigma and what tells it, largest step.
- ``orbit`` (of a run): how far loops round the clip's cameras go; null before videos are rendered.
- ``seconds``, ``memory_gib``: what each stage of a run took, and the GiB that it needed at most; ``wall_seconds``: the whole run by
  the clock, ``peak_memory_gib``: the most of all stages.
- ``lpips_reason``: why ``lpips`` is null.
- ``per_image``: a list of images with ``kind``, ``name``, ``frame``, their figures and those of their ``baselines``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path

import numpy as np

from flowsplat.common.progress import track
from flowsplat.common.threads import in_threads
from flowsplat.evaluation.baselines import HeldoutImage, list_baselines, predict, to_float
from flowsplat.evaluation.motion import MotionErrors, read_object_mask
from flowsplat.evaluation.perceptual import PerceptualMetric, lpips_metric
from flowsplat.evaluation.placement import view_camera
from flowsplat.evaluation.scores import Figures, score_image, summarize
from flowsplat.gaussians.model import at_once
from flowsplat.gaussians.renderer import Renderer, Rendering
from flowsplat.geometry import Camera
from flowsplat.images.colors import float_to_bytes
from flowsplat.images.sheets import preview_sheet
from flowsplat.scenes import HeldoutView, Scene
from flowsplat.scenes.layers import write_image

Refine = Callable[[Camera, float, np.ndarray], Camera]
"""(camera, seconds, image [H, W, 3] float) to the camera nearby that shows the image best."""

FRAME_REGIONS = ("moving",)
VIEW_REGIONS = ("moving", "covisible")

TRAINING_STRIDE = 8
"""Every how many training frames one is measured, fewer where that would leave less than eight."""


def evaluate(
    model: Renderer,
    scene: Scene,
    *,
    folder: str | Path | None = None,
    baselines: bool = True,
    static_model: Renderer | None = None,
    refine: Refine | None = None,
    perceptual: PerceptualMetric | None = None,
) -> Figures:
    """Measure a model on everything that its scene knows.

    Args:
        folder: where held-out renderings go: ``heldout/00009.png``, ``views/<name>.png``, and beside each its
            ``..._sheet.png``. None writes none.
        baselines: also predict the held-out images without a model.
        static_model: a model of the same scene without motion, measured among the baselines.
        refine: measures the held-out frames a second time, from the cameras that it finds.
        perceptual: LPIPS; None = as it is installed, if it is.

    Returns:
        the content of ``metrics.json``, but for what a run adds.

    Raises:
        InputError: the scene is damaged or incomplete, or the folder cannot be written.
    """
    evaluator = _Evaluator(model, static_model, scene, None if folder is None else Path(folder), baselines, refine, perceptual)
    frames, views, threads = [], [], at_once(model)
    if scene.heldout_frames:
        frames = list(in_threads(evaluator.score_heldout_frame, track(scene.heldout_frames, "Held-out frames"), threads))
    if scene.views:
        views = list(in_threads(evaluator.score_heldout_view, track(scene.views, "Held-out views"), threads))
    stride = choose_training_stride(scene)
    # Only truth makes more than a sample worth its time: it is the one thing that says where motion is wrong.
    measured = scene.train_frames[:: 1 if scene.truth else stride]
    next_frame = dict(zip_longest(scene.train_frames, scene.train_frames[1:]))
    sampled, training, errors = set(scene.train_frames[::stride]), [], MotionErrors(scene)

    def training_frame(i: int) -> tuple[int, Rendering, Figures | None]:
        rendering = evaluator.render_with_flow(i, next_frame[i])
        return i, rendering, evaluator.score_training_frame(i, rendering) if i in sampled else None

    for i, rendering, figures in in_threads(training_frame, track(measured, "Training frames"), threads):
        errors.add(i, next_frame[i], rendering)
        if figures is not None:
            training.append(figures)
    return {
        "heldout_frames": summarize(frames, FRAME_REGIONS),
        "heldout_frames_refined": summarize([frame.get("refined") for frame in frames], FRAME_REGIONS),
        "heldout_views": summarize(views, VIEW_REGIONS),
        "training_frames": summarize(training, FRAME_REGIONS),
        "training_stride": stride,
        "baselines": _summarize_baselines(frames, list_baselines(of_views=False), FRAME_REGIONS),
        "baselines_views": _summarize_baselines(views, list_baselines(of_views=True), VIEW_REGIONS),
        **errors.figures(),
        "lpips_reason": evaluator.lpips_reason,
        "per_image": frames + views + training,
    }


def choose_training_stride(scene: Scene) -> int:
    """Return every how many training frames one is measured."""
    return int(np.clip(len(scene.train_frames) // TRAINING_STRIDE, 1, TRAINING_STRIDE))


def _summarize_baselines(images: Sequence[Figures], names: Sequence[str], regions: Sequence[str]) -> Figures | None:
    figures = {name: summarize([image["baselines"].get(name) for image in images], regions) for name in names}
    return figures if any(figures.values()) else None


def find_heldout_mask(scene: Scene, i: int) -> np.ndarray | None:
    """Return [H, W] bool what moves in a held-out frame: as given or, where it is not, as it truly is; None = not known."""
    for layers in (scene.heldout_masks, scene.truth):
        if layers is not None and layers.has_mask(i):
            return layers.mask(i) > 0
    return None


class _Evaluator:
    """Renders and scores one image after the other."""

    def __init__(
        self,
        model: Renderer,
        static_model: Renderer | None,
        scene: Scene,
        folder: Path | None,
        baselines: bool,
        refine: Refine | None,
        perceptual: PerceptualMetric | None,
    ):
        self._model, self._static_model = model, static_model
        self._scene, self._folder, self._baselines, self._refine = scene, folder, baselines, refine
        self._overlay = scene.overlay
        self._lpips, reason = lpips_metric() if perceptual is None else (perceptual, "")
        self.lpips_reason = reason or None

    def score_heldout_frame(self, i: int) -> Figures:
        """Render, write and score a held-out frame with the camera that the camera stage found for it."""
        scene = self._scene
        camera, target = scene.cameras[i], to_float(scene.heldout_frame(i))
        regions = {"moving": find_heldout_mask(scene, i)}
        what = {"kind": "heldout_frame", "name": f"{i:05d}", "frame": i}
        figures = self._heldout_image(what, "heldout", camera, target, regions)
        if self._refine is not None:
            seconds = float(scene.timestamps[i])
            image = _finite(self._model.render(self._refine(camera, seconds, target), seconds)).color
            figures["refined"] = score_image(image, target, regions, self._lpips, self._overlay, with_sharpness=True)
        return figures

    def score_heldout_view(self, view: HeldoutView) -> Figures:
        """Render, write and score a held-out view."""
        scene = self._scene
        return self._heldout_image(
            {"kind": "heldout_view", "name": view.name, "frame": view.frame},
            "views",
            view_camera(scene, view),
            to_float(scene.view_image(view)),
            {"moving": scene.view_mask(view), "covisible": scene.view_mask(view, "covisible")},
            view,
        )

    def score_training_frame(self, i: int, rendering: Rendering) -> Figures:
        """Score a training frame that was rendered already."""
        target = to_float(self._scene.frame(i))
        regions = {"moving": read_object_mask(self._scene, i)}
        figures = score_image(rendering.color, target, regions, self._lpips, self._overlay, with_sharpness=True)
        return {"kind": "training_frame", "name": f"{i:05d}", "frame": i, **figures, "baselines": {}}

    def render_with_flow(self, i: int, j: int | None) -> Rendering:
        """Training frame ``i`` with its flow to frame ``j``."""
        cameras, seconds = self._scene.cameras, self._scene.timestamps
        flow_to = None if j is None else (cameras[j], float(seconds[j]))
        return _finite(self._model.render(cameras[i], float(seconds[i]), flow_to))

    def _heldout_image(
        self,
        what: Figures,
        subfolder: str,
        camera: Camera,
        target: np.ndarray,
        regions: dict[str, np.ndarray | None],
        view: HeldoutView | None = None,
    ) -> Figures:
        seconds = float(self._scene.timestamps[what["frame"]])
        image = _finite(self._model.render(camera, seconds)).color
        static = self._static_model
        render_static = None if static is None else lambda: _finite(static.render(camera, seconds)).color
        predictions = predict(HeldoutImage(self._scene, what["frame"], view, render_static)) if self._baselines else {}
        if self._folder is not None:
            self._write(self._folder / subfolder, what["name"], image, target)
        scores = {
            name: score_image(predicted, target, regions, self._lpips, self._overlay) for name, predicted in predictions.items()
        }
        own = score_image(image, target, regions, self._lpips, self._overlay, with_sharpness=True)
        return {**what, **own, "baselines": scores}

    def _write(self, folder: Path, name: str, image: np.ndarray, target: np.ndarray) -> None:
        write_image(folder / f"{name}.png", float_to_bytes(image))
        write_image(folder / f"{name}_sheet.png", preview_sheet(target, image))


def _finite(rendering: Rendering) -> Rendering:
    """Return numbers that are not finite become 0, so that a broken model scores badly instead of breaking its figures."""
    flow = rendering.flow if rendering.flow is None else np.nan_to_num(rendering.flow, posinf=0, neginf=0)
    color, depth = (np.nan_to_num(x, posinf=0, neginf=0) for x in (rendering.color, rendering.depth))
    return replace(rendering, color=color, depth=depth, flow=flow)
