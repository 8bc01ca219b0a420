"""How far rendered flow and depth are from the truth, and rendered flow from the prior that taught it."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np

from flowsplat.evaluation.metrics import depth_abs_rel, end_point_error
from flowsplat.evaluation.placement import true_scale
from flowsplat.gaussians.renderer import Rendering
from flowsplat.scenes import Flow, Scene

Errors = dict[str, float]


def read_object_mask(scene: Scene, i: int) -> np.ndarray | None:
    """[H, W] bool objects of a training frame: the true ones, else those of the scene, else None."""
    for layers in (scene.truth, scene):
        if layers is not None and layers.has_mask(i):
            return layers.mask(i) > 0
    return None


class MotionErrors:
    """Collects the errors of training frames one by one.

    A pixel that the model leaves empty counts: its flow is 0 and its depth is 0, a relative error of 1.
    """

    def __init__(self, scene: Scene):
        self._scene, self._scale = scene, true_scale(scene)
        self._true_pairs = set(scene.truth.flow_pairs) if scene.truth else set()
        self._prior_pairs = set(scene.flow_pairs)
        self._errors: dict[tuple[str, str], list[Errors | None]] = defaultdict(list)

    def add(self, i: int, j: int | None, rendering: Rendering) -> None:
        """Take training frame ``i``, rendered with its flow to training frame ``j`` (None for the last frame)."""
        moving = read_object_mask(self._scene, i)
        truth = self._scene.truth
        if j is not None and rendering.flow is not None:
            prior = self._scene.flow(i, j) if (i, j) in self._prior_pairs else None
            if truth is not None and (i, j) in self._true_pairs:
                true = truth.flow(i, j)
                self._add_flow("flow_epe", rendering.flow, true, moving)
                if prior is not None:
                    self._add_flow("prior_flow_epe", prior.flow, true, moving)
            if prior is not None:
                self._add_flow("flow_prior_epe", rendering.flow, prior, moving)
        if truth is not None and truth.has_depth(i):
            true_depth = truth.depth(i)
            regions = {"all": np.ones_like(true_depth.trusted)}
            if moving is not None:
                regions |= {"static": ~moving, "moving": moving}
            for region, mask in regions.items():
                error = depth_abs_rel(rendering.depth * self._scale, true_depth.depth, true_depth.trusted & mask)
                self._errors["depth_abs_rel", region].append(error)

    def _add_flow(self, name: str, flow: np.ndarray, reference: Flow, moving: np.ndarray | None) -> None:
        self._errors[name, "all"].append(end_point_error(flow, reference.flow, reference.trusted))
        if moving is not None:
            error = end_point_error(flow, reference.flow, reference.trusted & moving)
            self._errors[name, "moving"].append(error)

    def _average(self, name: str, region: str) -> Errors | None:
        errors = [error for error in self._errors[name, region] if error is not None]
        return {key: float(np.mean([error[key] for error in errors])) for key in ("mean", "median")} if errors else None

    def figures(self) -> dict[str, Any]:
        """``flow_epe``, ``prior_flow_epe`` and ``flow_prior_epe`` (``mean``, ``median``, ``moving``) and ``depth_abs_rel``
        (``all``, ``static``, ``moving``): ``mean`` and ``median`` over the pixels of a frame, averaged over the frames. None
        each where there was nothing to compare with."""
        figures: dict[str, Any] = {}
        for name in ("flow_epe", "prior_flow_epe", "flow_prior_epe"):
            whole = self._average(name, "all")
            figures[name] = None if whole is None else {**whole, "moving": self._average(name, "moving")}
        depth = {region: self._average("depth_abs_rel", region) for region in ("all", "static", "moving")}
        figures["depth_abs_rel"] = None if depth["all"] is None else depth
        return figures
