"""Flow between training frames that lie several frames apart: composed from shorter flows, then refined."""

from __future__ import annotations

import threading
from collections import defaultdict

import cv2
import numpy as np

from flowsplat.priors.continuity import Continuity
from flowsplat.priors.flow import FlowEstimator, compose, dis_estimator, forward_backward_confidence
from flowsplat.scenes import Scene
from flowsplat.scenes.overlay import hide_overlay

FLOW_STRIDES = (1, 2, 4, 8, 16)
"""Steps between training frames, each twice the one before (docs/method/flow.md)."""


def compute_working_size(scene: Scene) -> tuple[int, int]:
    """Return (width, height) of half the resolution, at which depth and motion are solved."""
    return max(8, scene.width // 2), max(8, scene.height // 2)


class LongFlows:
    """Flows in working pixels between training frames, by their position in ``scene.train_frames``.

    Computed when asked for and kept until ``forget``; a walk over the clip keeps about 8 strides x 16 frames. Threads may ask
    together.
    """

    def __init__(self, scene: Scene, continuity: Continuity, estimate: FlowEstimator = dis_estimator):
        self._scene, self._continuity, self._estimate = scene, continuity, estimate
        self._width, self._height = compute_working_size(scene)
        self._overlay = scene.overlay
        self._flows: dict[tuple[int, int], np.ndarray] = {}
        self._frames: dict[int, np.ndarray] = {}
        self._turns: defaultdict[tuple[int, int], threading.Lock] = defaultdict(threading.Lock)

    def neighbors(self, k: int) -> list[int]:
        """Return the positions one, two, four, eight and sixteen steps before and after ``k`` that can be matched with it."""
        count = len(self._scene.train_frames)
        around = [j for stride in FLOW_STRIDES for j in (k - stride, k + stride) if 0 <= j < count]
        return [j for j in around if self._continuity.are_joined(k, j)]

    def forget(self, before: int) -> None:
        """Drop what no frame from position ``before`` on needs."""
        self._flows = {pair: flow for pair, flow in self._flows.items() if max(pair) >= before}
        self._frames = {k: image for k, image in self._frames.items() if k >= before - FLOW_STRIDES[-1]}
        self._turns.clear()

    def matches(self, a: int, b: int) -> tuple[np.ndarray, np.ndarray]:
        """Return (flow [h, w, 2], confidence [h, w]) from ``a`` to ``b``, which are a stride apart, in working pixels."""
        forward = self._flow(a, b)
        confidence = hide_overlay(self._overlay, forward, forward_backward_confidence(forward, self._flow(b, a)))
        if abs(a - b) == 1 and (self._scene.prior("flow") or {}).get("method") == "given":
            # Other people's flow may be 0 where they know none, both ways: the round trip cannot tell.
            frames = self._scene.train_frames
            stored = self._scene.flow(frames[a], frames[b]).confidence
            confidence = np.minimum(confidence, cv2.resize(stored, confidence.shape[::-1], interpolation=cv2.INTER_AREA))
        return forward, confidence

    def _flow(self, a: int, b: int) -> np.ndarray:
        with self._turns[a, b]:  # What another thread computes is waited for. Halves are shorter, so none waits for itself.
            if (a, b) not in self._flows:
                self._flows[a, b] = self._compute_flow(a, b)
            return self._flows[a, b]

    def _compute_flow(self, a: int, b: int) -> np.ndarray:
        if abs(a - b) == 1:
            frames = self._scene.train_frames
            flow = self._scene.flow(frames[a], frames[b]).flow
        else:
            half = (a + b) // 2
            guess = self._resize(compose(self._flow(a, half), self._flow(half, b)), self._scene.width, self._scene.height)
            flow = self._estimate(self._frame(a), self._frame(b), guess)
        return self._resize(flow, self._width, self._height)

    def _frame(self, k: int) -> np.ndarray:
        if k not in self._frames:
            self._frames[k] = self._scene.frame(self._scene.train_frames[k])
        return self._frames[k]

    @staticmethod
    def _resize(flow: np.ndarray, width: int, height: int) -> np.ndarray:
        """Return the same flow on another grid, in the pixels of that grid."""
        old_height, old_width = flow.shape[:2]
        method = cv2.INTER_AREA if width < old_width else cv2.INTER_LINEAR
        scale = np.array([width / old_width, height / old_height], np.float32)
        return cv2.resize(flow, (width, height), interpolation=method) * scale
