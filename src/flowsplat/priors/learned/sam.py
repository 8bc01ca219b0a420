"""Masks of moving objects followed through the clip by SAM 2 (https://arxiv.org/abs/2408.00714), SAM 3, or EdgeTAM
(https://arxiv.org/abs/2501.07256), which is SAM 2 made for small devices.

What is to be followed is shown to it on one frame an object: the user's clicks and boxes, or without them what the motion
found (``masks``), each object where it covers the largest area.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import cv2
import numpy as np
import torch

from flowsplat.common.progress import progress_bar
from flowsplat.priors.learned.weights import ModelOptions, from_hub, require_package
from flowsplat.priors.prompts import Prompt, plain
from flowsplat.scenes import Scene

INSTEAD = "--masks motion"

CLASSES = {
    "sam2": ("Sam2VideoModel", "Sam2VideoProcessor"),
    "sam3": ("Sam3TrackerVideoModel", "Sam3TrackerVideoProcessor"),
    "edgetam": ("EdgeTamVideoModel", "Sam2VideoProcessor"),
}
"""Of every network, the classes of transformers for itself and for what prepares its input."""


@dataclass(frozen=True)
class Segmenter:
    """A network that follows objects: its name, its weights' source, itself, what prepares its input, and its device."""

    name: str
    source: str
    network: Any
    processor: Any
    device: torch.device


def load_segmenter(name: str, models: ModelOptions, device: torch.device) -> Segmenter:
    """``sam2``, ``sam3`` or ``edgetam``.

    Raises:
        InputError: transformers, the package of its backbone or the weights are not there.
    """
    option, setting = f"--masks {name}", f"--models.{name}"
    transformers = require_package("transformers", option, INSTEAD)
    require_package("torchvision", option, INSTEAD)  # What prepares the images needs it.
    if name == "edgetam":
        require_package("timm", option, INSTEAD, "pip install timm")  # has its backbone
    source = str(getattr(models, name))
    network, processor = (
        from_hub(getattr(transformers, kind), source, option=option, setting=setting, instead=INSTEAD) for kind in CLASSES[name]
    )
    return Segmenter(name, source, network.to(device), processor, device)


def prompts_from_masks(scene: Scene) -> list[Prompt]:
    """Return one box with one click in its object, for every object of the stored masks, where it is largest."""
    best: dict[int, tuple[int, int]] = {}
    for i in scene.train_frames:
        for number, area in enumerate(np.bincount(scene.mask(i).ravel())[1:], start=1):
            if area > best.get(number, (0, 0))[0]:
                best[number] = int(area), i
    prompts: list[Prompt] = []
    for number, (_, i) in sorted(best.items()):
        inside = (scene.mask(i) == number).astype(np.uint8)
        x, y, width, height = cv2.boundingRect(inside)
        depth_inside = cv2.distanceTransform(np.pad(inside, 1), cv2.DIST_L2, 3)[1:-1, 1:-1]
        row, column = np.unravel_index(depth_inside.argmax(), inside.shape)
        click, box = (column + 0.5, row + 0.5), (x, y, x + width, y + height)
        prompts.append(Prompt(i, (click,), box, number=len(prompts) + 1))
    return prompts


def sam_stage(scene: Scene, segmenter: Segmenter, prompts: Sequence[Prompt], shown_by: str) -> None:
    """Masks with object numbers for the training frames; nothing else of the clip is seen.

    Args:
        prompts: by the numbers of their objects, of each the one first that shows it.
        shown_by: where the prompts come from, for the verdict.
    """
    labels = _follow(scene, segmenter, prompts) if prompts else {}
    pixels = 0
    for i in scene.train_frames:
        mask = labels.get(i, np.zeros((scene.height, scene.width), np.uint8))
        scene.write_mask(i, mask)
        pixels += int((mask > 0).sum())
    share = pixels / (len(scene.train_frames) * scene.width * scene.height)
    how = f"shown by {shown_by}, followed by {segmenter.name} ({segmenter.source})"
    objects = len({prompt.number for prompt in prompts})
    verdict = f"{objects} object(s) on {share:.1%} of the image, {how}"
    figures = {"objects": objects, "share": round(share, 5), "prompts": plain(prompts)}
    scene.finish_prior("masks", method=segmenter.name, verdict=verdict, **figures)


@torch.inference_mode()
def _follow(scene: Scene, segmenter: Segmenter, prompts: Sequence[Prompt]) -> dict[int, np.ndarray]:
    """Object numbers [H, W] uint8 of every training frame; of several objects at a pixel the surest has it."""
    frames, network, processor = scene.train_frames, segmenter.network, segmenter.processor
    size = scene.height, scene.width
    best = {i: np.zeros(size, np.float16) for i in frames}
    labels = {i: np.zeros(size, np.uint8) for i in frames}
    objects = {number: list(group) for number, group in groupby(prompts, lambda prompt: prompt.number)}
    begins = {number: frames.index(group[0].frame) for number, group in objects.items()}
    starts = sorted(set(begins.values()))
    with progress_bar("Masks", len(frames) * len(starts)) as bar:
        for start in starts:
            # One walk for each frame with prompts: the network wants all objects to be known when it sets out.
            session = processor.init_video_session(
                video=[scene.frame(i) for i in frames], inference_device=segmenter.device, video_storage_device="cpu",
                dtype=network.dtype,
            )  # fmt: skip
            for number, group in objects.items():
                for prompt in group if begins[number] == start else []:
                    at = frames.index(prompt.frame)
                    processor.add_inputs_to_inference_session(session, at, number, **_inputs(prompt))
                    # Taken in before the next one comes, which would replace it.
                    network(inference_session=session, frame_idx=at)
            for backwards in (False, True):
                for found in network.propagate_in_video_iterator(session, start_frame_idx=start, reverse=backwards):
                    i = frames[found.frame_idx]
                    masks = processor.post_process_masks([found.pred_masks], [list(size)], binarize=False)[0]
                    for number, values in zip(found.object_ids, masks[:, 0], strict=True):
                        scores = values.float().cpu().numpy().clip(-100, 100).astype(np.float16)
                        better = scores > best[i]
                        best[i][better], labels[i][better] = scores[better], number
                    bar.advance()
    return labels


def _inputs(prompt: Prompt) -> dict[str, Any]:
    inputs: dict[str, Any] = {}
    if prompt.clicks or prompt.beside:
        inputs["input_points"] = [[[list(click) for click in (*prompt.clicks, *prompt.beside)]]]
        inputs["input_labels"] = [[[1] * len(prompt.clicks) + [0] * len(prompt.beside)]]
    if prompt.box is not None:
        inputs["input_boxes"] = [[list(prompt.box)]]
    return inputs
