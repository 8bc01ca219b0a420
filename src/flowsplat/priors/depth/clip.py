"""What the matches say about every training frame: solved once, kept in the scene folder, used for masks and depth."""

from __future__ import annotations

import hashlib
import shutil
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np

from flowsplat.common.files import read_npz, write_npz
from flowsplat.common.progress import track
from flowsplat.geometry import Camera
from flowsplat.priors.depth.longflow import LongFlows, working_size
from flowsplat.priors.depth.multiview import MultiView, solve_multiview
from flowsplat.scenes import Scene

PARALLAX = 25.0
"""Squared working pixels of information above which a depth is sure: 4 % per 0.2 pixels of noise."""

RESTS = 3.0
"""Multiples of the noise up to which the matches of a pixel are those of a scene at rest."""

ENOUGH = 0.03
"""Share of pixels with sure depth below which a clip is said to have no parallax."""


def _folder(scene: Scene) -> Path:
    return scene.folder / "multiview"


def forget_solutions(scene: Scene) -> None:
    """Delete the stored solutions, of no use once masks and depth exist."""
    shutil.rmtree(_folder(scene), ignore_errors=True)


class SolvedClip:
    """The training frames at working resolution, by their position in ``scene.train_frames``, with their solutions.

    Attributes:
        has_parallax: whether the camera travels enough for depth to be seen.
        median: inverse depth of the clip where it is sure; 0 without parallax.
        mean_parallax: mean over frames of the median parallax, in working pixels.
    """

    def __init__(self, scene: Scene):
        """Solve what is not solved yet. Needs cameras and flow."""
        self.scene = scene
        self.width, self.height = working_size(scene)
        self.cameras: list[Camera] = [scene.cameras[i].resized(self.width, self.height) for i in scene.train_frames]
        # Other cameras make another solution, which must not be mixed with this one.
        digest = hashlib.sha256((scene.folder / "cameras.json").read_bytes()).hexdigest()[:12]
        self._folder = _folder(scene) / digest
        self._solve()
        samples = [self[k] for k in range(0, len(self), max(1, len(self) // 24))]
        at_rest = [(s.information > PARALLAX) & (s.motion < RESTS) for s in samples]
        sure = np.concatenate([s.inverse_depth[rest] for s, rest in zip(samples, at_rest, strict=True)])
        self.has_parallax = len(sure) >= ENOUGH * sum(rest.size for rest in at_rest)
        self.median = float(np.median(sure)) if self.has_parallax else 0.0
        self.mean_parallax = float(np.mean([np.sqrt(np.median(s.information)) for s in samples]))

    def __len__(self) -> int:
        return len(self.cameras)

    def __getitem__(self, k: int) -> MultiView:
        return MultiView(**{name: values.astype(np.float32) for name, values in read_npz(self._path(k)).items()})

    def image(self, k: int) -> np.ndarray:
        """RGB [h, w, 3] uint8."""
        frame = self.scene.frame(self.scene.train_frames[k])
        return cv2.resize(frame, (self.width, self.height), interpolation=cv2.INTER_AREA)

    def mask(self, k: int) -> np.ndarray:
        """Object numbers [h, w] uint8."""
        mask = self.scene.mask(self.scene.train_frames[k])
        return cv2.resize(mask, (self.width, self.height), interpolation=cv2.INTER_NEAREST)

    def step_flow(self, k: int, j: int) -> tuple[np.ndarray, np.ndarray]:
        """(flow [h, w, 2] in working pixels, confidence [h, w]) from one training frame to the next or previous one."""
        frames = self.scene.train_frames
        flow = self.scene.flow(frames[k], frames[j])
        size = (self.width, self.height)
        scale = np.array([self.width / self.scene.width, self.height / self.scene.height], np.float32)
        small = cv2.resize(flow.flow, size, interpolation=cv2.INTER_AREA) * scale
        return small, cv2.resize(flow.confidence, size, interpolation=cv2.INTER_AREA)

    def _path(self, k: int) -> Path:
        return self._folder / f"{self.scene.train_frames[k]:05d}.npz"

    def _solve(self) -> None:
        missing = [k for k in range(len(self)) if not self._path(k).exists()]
        if not missing:
            return
        flows = LongFlows(self.scene)
        for k in track(missing, "Matching frames"):
            others = flows.neighbours(k)
            matches = [flows.matches(k, j) for j in others]
            solution = solve_multiview(
                self.cameras[k], [self.cameras[j] for j in others],
                np.stack([flow for flow, _ in matches]), np.stack([confidence for _, confidence in matches]),
            )  # fmt: skip
            write_npz(self._path(k), asdict(solution))
            flows.forget(k + 1)
