"""What clicks and boxes mean at first sight, before anything is known of the clip: told by colours and one flow, and shown."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from flowsplat.pictures.colors import tinted
from flowsplat.pictures.sheets import stacked
from flowsplat.priors.flow import FlowEstimator, forward_backward_confidence
from flowsplat.priors.prompts.cutting import cut_out
from flowsplat.priors.prompts.parsing import Prompt
from flowsplat.scenes import Flow, Scene
from flowsplat.scenes.layers import write_image

PICTURE = "clicks.png"
"""In the folder of a scene."""

_ON, _BESIDE, _BOX = (60, 230, 60), (240, 50, 50), (255, 220, 0)


def cut_at_once(scene: Scene, prompts: Sequence[Prompt], estimate: FlowEstimator) -> list[np.ndarray]:
    """The object of every prompt on its frame, bool [H, W]; nothing of a prompt without clicks on it or a box round it."""
    flows: dict[int, Flow] = {}
    found = []
    for prompt in prompts:
        image = scene.frame(prompt.frame)
        if not prompt.clicks and prompt.box is None:
            found.append(np.zeros(image.shape[:2], bool))
            continue
        if prompt.frame not in flows:
            flows[prompt.frame] = _one_flow(scene, prompt.frame, estimate)
        found.append(cut_out(image, flows[prompt.frame], prompt))
    return found


def show_at_once(scene: Scene, prompts: Sequence[Prompt], estimate: FlowEstimator) -> Path:
    """Draw every frame with prompts, what they mean in colour, into ``PICTURE`` in the folder of the scene; its path."""
    found = cut_at_once(scene, prompts, estimate)
    rows = []
    for i in sorted({prompt.frame for prompt in prompts}):
        here = [(prompt, mask) for prompt, mask in zip(prompts, found, strict=True) if prompt.frame == i]
        numbers = np.zeros((scene.height, scene.width), np.uint8)
        for prompt, mask in here[::-1]:
            numbers[mask] = prompt.number
        picture = tinted(scene.frame(i), numbers)
        for prompt, _ in here:
            _draw(picture, prompt)
        cv2.putText(picture, f"frame {i}", (6, picture.shape[0] - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 255, 255), 1, cv2.LINE_AA)
        rows.append(picture)
    path = scene.folder / PICTURE
    write_image(path, stacked(rows))
    return path


def _one_flow(scene: Scene, i: int, estimate: FlowEstimator) -> Flow:
    """The flow to the next training frame, or from the last to the one before, and how sure it is."""
    frames = scene.train_frames
    k = frames.index(i)
    j = frames[k + 1] if k + 1 < len(frames) else frames[k - 1]
    a, b = scene.frame(i), scene.frame(j)
    forth = estimate(a, b)
    return Flow(i, j, forth, forward_backward_confidence(forth, estimate(b, a)))


def _draw(picture: np.ndarray, prompt: Prompt) -> None:
    """Box, clicks, and the number of the object, on a picture [H, W, 3] uint8."""
    radius = max(2, round(0.006 * max(picture.shape)))
    for points, colour in ((prompt.clicks, _ON), (prompt.beside, _BESIDE)):
        for x, y in points:
            cv2.circle(picture, (int(x), int(y)), radius + 1, (0, 0, 0), -1, cv2.LINE_AA)
            cv2.circle(picture, (int(x), int(y)), radius, colour, -1, cv2.LINE_AA)
    if prompt.box is not None:
        x0, y0, x1, y1 = (round(value) for value in prompt.box)
        cv2.rectangle(picture, (x0, y0), (x1 - 1, y1 - 1), _BOX, 1)
    corner = prompt.box[:2] if prompt.box is not None else prompt.clicks[0] if prompt.clicks else None
    if corner is not None:
        where = (int(corner[0]) + radius + 2, int(corner[1]) + 12)
        cv2.putText(picture, str(prompt.number), where, cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 255, 255), 1, cv2.LINE_AA)
