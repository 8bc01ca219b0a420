"""The matches of every training frame, solved once for depth and motion, kept in the scene folder, used by masks and depth."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, fields
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from flowsplat.common.files import read_npz, write_npz
from flowsplat.common.progress import track
from flowsplat.common.threads import in_threads, thread_count
from flowsplat.geometry import Camera
from flowsplat.priors.background.longflow import LongFlows, compute_working_size
from flowsplat.priors.background.multiview import MultiView, solve_multiview
from flowsplat.priors.continuity import Continuity
from flowsplat.priors.flow import FlowEstimator, dis_estimator
from flowsplat.scenes import Scene

SURE_PARALLAX_INFORMATION = 25.0
"""Squared working pixels of information above which a depth is sure: 4 % per 0.2 pixels of noise."""

MAX_REST_NOISES = 3.0
"""Multiples of the noise up to which the matches of a pixel are those of a scene at rest. Chosen by eye."""

MIN_SURE_SHARE = 0.03
"""Share of pixels with sure depth from which a clip has parallax (docs/method/masks.md)."""

WEAK_PARALLAX, MIN_WEAK_SHARE = 2.0, 0.3
"""The same where all is less sure: 14 % per 0.2 pixels of noise, but known of so many pixels. Still far better than a guess: on a
rendered room a camera that turns and travels by 0.6 degrees of parallax gives depth that is 4 % off, guessed 28 %."""

SOLUTIONS = "multiview"
"""Folder of the scene with the solutions, of no use once masks and depth exist."""


class MatchedClip:
    """The training frames at working resolution, by their position in ``scene.train_frames``, with their solutions.

    Attributes:
        continuity: which frames can be matched with each other.
        has_parallax: whether the camera travels enough for depth to be seen.
        has_sure_depth: whether it travels enough for depth to be seen well.
        median: inverse depth of the clip where it is sure; 0 without parallax.
        mean_parallax: mean over frames of the median parallax, in working pixels.
    """

    def __init__(self, scene: Scene, estimate: FlowEstimator = dis_estimator):
        """Solve what is not solved yet. Needs cameras and flow.

        Args:
            estimate: finds the flow between frames that are no neighbors.
        """
        self.scene = scene
        self.width, self.height = compute_working_size(scene)
        self.cameras: list[Camera] = [scene.cameras[i].resize(self.width, self.height) for i in scene.train_frames]
        self.continuity = Continuity(scene)
        # Other cameras or other flow make another solution, which must not be mixed with this one.
        flow = str((scene.prior("flow") or {}).get("method"))
        digest = hashlib.sha256((scene.folder / "cameras.json").read_bytes() + flow.encode()).hexdigest()[:12]
        self._folder = scene.folder / SOLUTIONS / digest
        self._solve(estimate)
        samples = [self[k] for k in range(0, len(self), max(1, len(self) // 24))]
        self.median = _median(samples, SURE_PARALLAX_INFORMATION, MIN_SURE_SHARE)
        self.has_sure_depth = self.median > 0
        if not self.has_sure_depth:
            self.median = _median(samples, WEAK_PARALLAX, MIN_WEAK_SHARE)
        self.has_parallax = self.median > 0
        self.mean_parallax = float(np.mean([np.sqrt(np.median(s.information)) for s in samples]))

    def __len__(self) -> int:
        return len(self.cameras)

    def __getitem__(self, k: int) -> MultiView:
        return MultiView(**{name: values.astype(np.float32) for name, values in read_npz(self._path(k)).items()})

    def image(self, k: int) -> np.ndarray:
        """Return RGB [h, w, 3] uint8."""
        frame = self.scene.frame(self.scene.train_frames[k])
        return cv2.resize(frame, (self.width, self.height), interpolation=cv2.INTER_AREA)

    def mask(self, k: int) -> np.ndarray:
        """Object numbers [h, w] uint8."""
        mask = self.scene.mask(self.scene.train_frames[k])
        return cv2.resize(mask, (self.width, self.height), interpolation=cv2.INTER_NEAREST)

    def step_flow(self, k: int, j: int) -> tuple[np.ndarray, np.ndarray]:
        """Return (flow [h, w, 2] in working pixels, confidence [h, w]) from one training frame to the next or previous one."""
        frames = self.scene.train_frames
        flow = self.scene.flow(frames[k], frames[j])
        size = (self.width, self.height)
        scale = np.array([self.width / self.scene.width, self.height / self.scene.height], np.float32)
        small = cv2.resize(flow.flow, size, interpolation=cv2.INTER_AREA) * scale
        return small, cv2.resize(flow.confidence, size, interpolation=cv2.INTER_AREA)

    def _path(self, k: int) -> Path:
        return self._folder / f"{self.scene.train_frames[k]:05d}.npz"

    def _solve(self, estimate: FlowEstimator) -> None:
        missing = [k for k in range(len(self)) if not self._path(k).exists()]
        if not missing:
            return
        flows = LongFlows(self.scene, self.continuity, estimate)
        threads = thread_count() if estimate is dis_estimator else 1  # Networks have all threads for one pair.
        for k in track(missing, "Matching frames"):
            others = flows.neighbors(k)
            if others:
                matches = list(in_threads(partial(flows.matches, k), others, threads))
                solution = solve_multiview(
                    self.cameras[k], [self.cameras[j] for j in others],
                    np.stack([flow for flow, _ in matches]), np.stack([confidence for _, confidence in matches]),
                )  # fmt: skip
            else:
                solution = MultiView(*np.zeros((len(fields(MultiView)), self.height, self.width), np.float32))
            write_npz(self._path(k), asdict(solution))
            flows.forget(k + 1)


def _median(solutions: Sequence[MultiView], information: float, enough: float) -> float:
    """Return inverse depth, the median of resting pixels with more information; 0 where they are less than that share of all."""
    at_rest = [(s.information > information) & (s.motion < MAX_REST_NOISES) for s in solutions]
    known = np.concatenate([s.inverse_depth[rest] for s, rest in zip(solutions, at_rest, strict=True)])
    return float(np.median(known)) if len(known) >= enough * sum(rest.size for rest in at_rest) else 0.0
