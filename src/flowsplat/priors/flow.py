"""Optical flow without weights: Dense Inverse Search (https://arxiv.org/abs/1603.03590) both ways, and its check."""

from __future__ import annotations

from itertools import pairwise
from typing import Protocol

import cv2
import numpy as np

from flowsplat.common.progress import track
from flowsplat.common.threads import in_threads, thread_count
from flowsplat.geometry.cameras import pixel_grid
from flowsplat.geometry.interpolation import sample_map
from flowsplat.priors.continuity import Continuity
from flowsplat.scenes import Flow, Scene

MIN_SIDE = 64
"""Pixels. Smaller images are enlarged, because the search needs room for its patches. Chosen by eye."""

FINE_PATCH, FINE_STEP, FINE_DESCENTS, FINE_ROUNDS = 5, 2, 24, 3
"""Of the fine search: side of a patch and distance between patches in pixels, steps of descent for a patch, and rounds of
variational refinement (docs/method/flow.md)."""


def gray(image: np.ndarray) -> np.ndarray:
    """Return RGB [H, W, 3] uint8 to gray [H, W] uint8."""
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def read_gray(scene: Scene, i: int, longest: int) -> np.ndarray:
    """Return gray [h, w] uint8 of any frame of a clip, held-out ones too, with at most ``longest`` pixels on its longer side."""
    factor = min(1.0, longest / max(scene.width, scene.height))
    size = max(1, round(scene.width * factor)), max(1, round(scene.height * factor))
    return cv2.resize(gray(scene.any_frame(i)), size, interpolation=cv2.INTER_AREA)


def dis_flow(a: np.ndarray, b: np.ndarray, initial: np.ndarray | None = None, fine: bool = False) -> np.ndarray:
    """Return flow [H, W, 2] float32 in pixels from gray ``a`` to gray ``b`` (both [H, W] uint8).

    Args:
        initial: a first guess [H, W, 2], for large displacements.
        fine: search at full instead of half resolution, with smaller patches: half the error, eight times the time.
    """
    height, width = a.shape
    factor = -(-MIN_SIDE // min(height, width))
    if factor > 1:
        size = (width * factor, height * factor)
        a, b = (cv2.resize(image, size, interpolation=cv2.INTER_LINEAR) for image in (a, b))
        initial = None if initial is None else cv2.resize(initial, size) * factor
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    if fine:
        search.setFinestScale(0)
        search.setPatchSize(FINE_PATCH)
        search.setPatchStride(FINE_STEP)
        search.setGradientDescentIterations(FINE_DESCENTS)
        search.setVariationalRefinementIterations(FINE_ROUNDS)
    a, b = np.ascontiguousarray(a), np.ascontiguousarray(b)
    if initial is None:
        flow = search.calc(a, b, None)
    else:
        flow = search.calc(a, b, np.array(initial, np.float32, order="C"))  # a copy: the guess is overwritten
    if factor > 1:
        flow = cv2.resize(flow, (width, height), interpolation=cv2.INTER_AREA) / factor
    return np.asarray(flow, np.float32)


def _inside(points: np.ndarray, width: int, height: int) -> np.ndarray:
    return (points >= 0).all(-1) & (points[..., 0] <= width) & (points[..., 1] <= height)


def lengths(flow: np.ndarray) -> np.ndarray:
    """Return [...] of vectors [..., 2]: several times as fast as ``np.linalg.norm``, which sums along so short an axis."""
    x, y = flow[..., 0], flow[..., 1]
    return np.sqrt(x * x + y * y)


def forward_backward_confidence(forward: np.ndarray, backward: np.ndarray) -> np.ndarray:
    """Confidence [H, W] float32 between 0 and 1 of ``forward`` [H, W, 2], given the flow back.

    With the round trip's error e and the limit l = 0.5 + 0.05 |forward| pixels it is 1 / (1 + (e / l)^2): 1 for a
    perfect round trip, one half at the limit, and 0 where the target lies outside the image.
    """
    height, width = forward.shape[:2]
    target = pixel_grid(width, height) + forward
    returned = sample_map(backward, target.reshape(-1, 2)).reshape(forward.shape)
    error = lengths(forward + returned)
    limit = 0.5 + 0.05 * lengths(forward)
    return np.where(_inside(target, width, height), 1 / (1 + (error / limit) ** 2), 0).astype(np.float32)


def compose(ab: np.ndarray, bc: np.ndarray) -> np.ndarray:
    """Return flow from a to c [H, W, 2] out of the flows from a to b and from b to c."""
    height, width = ab.shape[:2]
    target = pixel_grid(width, height) + ab
    return ab + sample_map(bc, target.reshape(-1, 2)).reshape(ab.shape)


class FlowEstimator(Protocol):
    """What finds flow."""

    def __call__(self, a: np.ndarray, b: np.ndarray, guess: np.ndarray | None = None) -> np.ndarray:
        """Return the flow [H, W, 2] float32 in pixels from image ``a`` to ``b`` (RGB [H, W, 3] uint8).

        Args:
            guess: for images that lie further apart, the flow [H, W, 2] that shorter ones lead to. An estimator that finds large
                motion without it may ignore it.
        """
        ...


def dis_estimator(a: np.ndarray, b: np.ndarray, guess: np.ndarray | None = None) -> np.ndarray:
    """As ``FlowEstimator``, without weights: fine between neighbors, and from a guess at half resolution."""
    return dis_flow(gray(a), gray(b), guess, fine=guess is None)


def flow_stage(scene: Scene, method: str = "dis", estimate: FlowEstimator = dis_estimator) -> None:
    """Flow between consecutive training frames (8 and 10 where 9 is held out), both ways; existing pairs are kept.

    Args:
        method: what ``estimate`` is called, for provenance.
    """
    done, continuity, pairs = set(scene.flow_pairs), Continuity(scene), list(pairwise(scene.train_frames))

    def between(k: int) -> tuple[int, float]:
        """Return how many were missing between training frames k and k + 1, and the share of pixels that is trusted."""
        i, j = pairs[k]
        missing = [pair for pair in ((i, j), (j, i)) if pair not in done]
        if missing:
            a, b = scene.frame(i), scene.frame(j)
            flows = {(i, j): estimate(a, b), (j, i): estimate(b, a)}
            for s, t in missing:
                confidence = forward_backward_confidence(flows[s, t], flows[t, s])
                if not continuity.are_joined(k, k + 1):
                    confidence = np.zeros_like(confidence)  # what agrees across a cut agrees by chance
                scene.write_flow(Flow(s, t, flows[s, t], confidence))
        return len(missing), float(scene.flow(i, j).trusted.mean())

    # Networks have all threads for one pair.
    threads = thread_count() if estimate is dis_estimator else 1
    found = list(in_threads(between, track(range(len(pairs)), "Flow"), threads))
    computed, shares = sum(count for count, _ in found), [share for _, share in found]
    share = float(np.mean(shares))
    verdict = f"{share:.0%} of the pixels match there and back"
    scene.finish_prior("flow", method=method, verdict=verdict, pairs=computed, trusted=round(share, 4))
