"""Define the report of the priors benchmark: figures, their targets, and the rows of its table."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from flowsplat_benchmarks.tables import Result, label

HEADER = ("prior", "figure", "scene", "", "target", "")


@dataclass(frozen=True)
class Figure:
    """A figure of a scene.

    Attributes:
        key: its name in the JSON of a scene; what stands before the point names the prior.
        name: what it is, for people.
        unit, digits: how it is written.
        targets: its bound by kind or name of the scene; without one it is only told.
        at_least: whether the target is a lower bound, else it is an upper one.
    """

    key: str
    name: str
    unit: str
    digits: int
    targets: Mapping[str, float] = field(default_factory=dict)
    at_least: bool = False

    def target(self, kind: str, scene: str) -> float | None:
        """Return the bound for a scene."""
        return self.targets.get(scene, self.targets.get(kind))

    def meets(self, value: float, target: float) -> bool:
        """Return whether a value meets a target."""
        return value >= target if self.at_least else value <= target

    def text(self, value: float) -> str:
        """Return a value with its unit."""
        return f"{value:,.{self.digits}f}{' ' if self.unit else ''}{self.unit}"

    def target_text(self, target: float) -> str:
        """Return a target with its unit."""
        return f"{'≥' if self.at_least else '≤'} {target:,g}{' ' if self.unit else ''}{self.unit}"


FIGURES = (
    Figure("flow.epe", "end-point error, mean over all pixels with true flow", "px", 2, {"pair": 0.25, "rig": 0.35}),
    Figure("flow.epe_objects", "the same on objects", "px", 2, {"rig": 1.0}),
    Figure("flow.epe_matched", "end-point error, mean over pixels visible in both images", "px", 2),
    Figure("flow.epe_matched_objects", "the same on objects", "px", 2),
    Figure("flow.kept", "pixels with a true match that the confidence keeps", "%", 1, {"pair": 85, "rig": 85}, True),
    Figure("flow.kept_objects", "the same on objects", "%", 1),
    Figure("flow.right", "kept pixels right to 1 px", "%", 1, {"pair": 90, "rig": 90}, True),
    Figure("cameras.path", "position error after alignment, mean, of the path's length", "%", 2, {"rig": 0.3}),
    Figure("cameras.rotation", "rotation error after alignment, mean", "°", 3, {"rig": 0.1}),
    Figure("cameras.focal", "focal length error", "%", 2, {"rig": 1.0}),
    Figure("depth.static", "relative error on static pixels, median", "%", 2, {"rig": 2.5}),
    Figure("depth.objects", "relative error on objects, median", "%", 2, {"rig": 10.0}),
    Figure("masks.iou", "IoU, pooled over training frames", "", 3, {"rig": 0.8, "davis": 0.5}, True),
    Figure("tracks.life", "life as a share of the true visible life, median", "%", 1, {"rig": 60}, True),
    Figure("tracks.life_objects", "the same on objects", "%", 1),
    Figure("tracks.within", "living samples within 2 px", "%", 1, {"rig": 85}, True),
    Figure("tracks.within_objects", "the same on objects", "%", 1),
    Figure("tracks.unseen", "living samples of points that are hidden then", "%", 1),
    Figure("tracks.objects", "own tracks on objects", "", 0, {"rig": 2000}, True),
    Figure("time.total", "time of all stages", "s", 0, {"bear": 150}),
    Figure("time.cpu", "time of the processor, all cores", "s", 0),
    Figure("time.memory", "peak memory", "GiB", 2, {"bear": 4}),
)  # fmt: skip

MEAN_CLIPS, MEAN_TARGET = 4, 0.7
"""How many DAVIS clips are averaged, and the target of their mean IoU."""

DEFINITIONS = (
    "Everything is computed from the images alone: no focal length, no masks. Rig scenes train on all frames; DAVIS clips hold "
    "out every tenth, and their masks are seen by the measurement only.",
    "Flow: pooled over the pixels of all pairs of neighbors, both ways (of the pair: one way). On a rig scene the flow of hidden "
    "pixels is known and counts. A pixel is kept when its confidence is one half or more; on the pair every pixel with known flow "
    "counts as having a match.",
    "Cameras: rotations are aligned first, then scale and translation. Depth: at the scale that aligns the camera path; every "
    "pixel of every frame, whatever its confidence.",
    "Masks: any moving object against the background, intersections and unions summed over the training frames of a scene.",
    "Tracks: asked for the true points at the frame and pixel of their birth. Life: frames in which the point is visible and we "
    "follow it. Within 2 px: of all samples we call visible, births excepted, hidden points included. Own tracks: those that were "
    "on objects, by the true masks, in most of their frames.",
    "Time: by the clock, on the machine that the benchmark ran on, reading the input included.",
)


@dataclass(frozen=True)
class Row:
    """A line of the table: texts, and whether its target is met (None = it has none)."""

    prior: str
    figure: str
    scene: str
    value: str
    target: str
    met: bool | None

    @property
    def cells(self) -> tuple[str, ...]:
        """As ``HEADER`` names them."""
        verdict = {True: "met", False: "not met", None: ""}[self.met]
        return self.prior, self.figure, self.scene, self.value, self.target, verdict


def table_rows(results: Sequence[Result]) -> Iterator[Row]:
    """Yield one row for every figure of every scene, sorted by figure.

    Args:
        results: the JSON of the scenes (see ``run_priors_benchmark``).
    """
    for figure in FIGURES:
        prior = figure.key.split(".")[0]
        for result in results:
            value = result["figures"].get(figure.key)
            if value is None:
                continue
            target = figure.target(result["kind"], result["scene"])
            met = None if target is None else figure.meets(value, target)
            bound = "" if target is None else figure.target_text(target)
            yield Row(prior, figure.name, label(result), figure.text(value), bound, met)
        if figure.key == "masks.iou":
            yield from _mean_of_clips(results, figure)


def _mean_of_clips(results: Sequence[Result], figure: Figure) -> Iterator[Row]:
    values = [result["figures"][figure.key] for result in results if result["kind"] == "davis" and figure.key in result["figures"]]
    if len(values) < MEAN_CLIPS:
        return
    mean = float(np.mean(values))
    bound = Figure(figure.key, figure.name, figure.unit, figure.digits, {"davis": MEAN_TARGET}, True)
    scene = f"mean of {len(values)} DAVIS clips"
    yield Row("masks", figure.name, scene, figure.text(mean), bound.target_text(MEAN_TARGET), bound.meets(mean, MEAN_TARGET))
