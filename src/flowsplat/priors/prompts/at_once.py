"""Show what clicks and boxes mean at first sight, before anything is known of the clip: told by colors and one flow, and shown."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from flowsplat.images.colors import tint
from flowsplat.images.sheets import stack
from flowsplat.priors.flow import FlowEstimator, forward_backward_confidence
from flowsplat.priors.prompts.cutting import cut_out
from flowsplat.priors.prompts.parsing import CLICK_RADIUS, ClipFrames, Prompt
from flowsplat.scenes import Flow, Scene
from flowsplat.scenes.layers import write_image

IMAGE = "clicks.png"
"""In the folder of a scene."""

BOX_FRAME_GAP, CLICK_FRAME_GAP = 1, 3
"""Training frames to the one that a box is matched with, and a click alone, whose own motion must be told from all else. Chosen
on tuned scenes and random worlds (docs/notebook/2026-11.md, Clicks and boxes)."""

_CLICK_COLOR, _BESIDE_COLOR, _BOX_COLOR = (60, 230, 60), (240, 50, 50), (255, 220, 0)
"""Red, green and blue in which clicks on and beside an object and boxes are drawn. Chosen by eye."""


def cut_prompts(scene: ClipFrames, prompts: Sequence[Prompt], estimate: FlowEstimator) -> list[np.ndarray]:
    """Return the object of every prompt on its frame, bool [H, W]; nothing of a prompt without clicks on it or a box round it."""
    flows: dict[tuple[int, int], Flow] = {}
    found = []
    for prompt in prompts:
        image = scene.frame(prompt.frame)
        if not prompt.clicks and prompt.box is None:
            found.append(np.zeros(image.shape[:2], bool))
            continue
        pair = prompt.frame, _near(scene, prompt.frame, CLICK_FRAME_GAP if prompt.box is None else BOX_FRAME_GAP)
        if pair not in flows:
            flows[pair] = _one_flow(scene, *pair, estimate)
        found.append(cut_out(image, flows[pair], prompt))
    return found


def show_at_once(scene: Scene, prompts: Sequence[Prompt], estimate: FlowEstimator) -> Path:
    """Draw every frame with prompts, what they mean in color, into ``IMAGE`` in the folder of the scene; its path."""
    found = cut_prompts(scene, prompts, estimate)
    rows = []
    for i in sorted({prompt.frame for prompt in prompts}):
        here = [(prompt, mask) for prompt, mask in zip(prompts, found, strict=True) if prompt.frame == i]
        numbers = np.zeros((scene.height, scene.width), np.uint8)
        for prompt, mask in here[::-1]:
            numbers[mask] = prompt.number
        image = tint(scene.frame(i), numbers)
        for prompt, _ in here:
            _draw(image, prompt)
        _write(image, f"frame {i}", (6, image.shape[0] - 8))
        rows.append(image)
    path = scene.folder / IMAGE
    write_image(path, stack(rows))
    return path


def _near(scene: ClipFrames, i: int, steps: int) -> int:
    """Return the training frame that is so many after another one, or before it near the end; the last or first in the shortest
    clips."""
    frames = scene.train_frames
    k = frames.index(i)
    return frames[k + steps if k + steps < len(frames) else max(k - steps, 0) or (0 if k else 1)]


def _one_flow(scene: ClipFrames, i: int, j: int, estimate: FlowEstimator) -> Flow:
    """Return the flow from one frame to another, and how sure it is."""
    a, b = scene.frame(i), scene.frame(j)
    forth = estimate(a, b)
    return Flow(i, j, forth, forward_backward_confidence(forth, estimate(b, a)))


def _draw(image: np.ndarray, prompt: Prompt) -> None:
    """Box, clicks, and the number of the object, on an image [H, W, 3] uint8."""
    radius = max(2, round(CLICK_RADIUS * max(image.shape)))
    for points, color in ((prompt.clicks, _CLICK_COLOR), (prompt.beside, _BESIDE_COLOR)):
        for x, y in points:
            cv2.circle(image, (int(x), int(y)), radius + 1, (0, 0, 0), -1, cv2.LINE_AA)
            cv2.circle(image, (int(x), int(y)), radius, color, -1, cv2.LINE_AA)
    if prompt.box is not None:
        x0, y0, x1, y1 = (round(value) for value in prompt.box)
        cv2.rectangle(image, (x0, y0), (x1 - 1, y1 - 1), _BOX_COLOR, 1)
    corner = prompt.box[:2] if prompt.box is not None else prompt.clicks[0] if prompt.clicks else None
    if corner is not None:
        _write(image, str(prompt.number), (int(corner[0]) + radius + 2, int(corner[1]) + 12))


def _write(image: np.ndarray, text: str, where: tuple[int, int]) -> None:
    cv2.putText(image, text, where, cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 255, 255), 1, cv2.LINE_AA)
