"""The mask stage of clicks and boxes: what was shown is followed along the flow, and its outline is what moves
(docs/method/masks.md)."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from itertools import groupby
from typing import Any

import numpy as np

from flowsplat.common.progress import track
from flowsplat.priors.background.matched_clip import MatchedClip
from flowsplat.priors.flow import FlowEstimator, dis_estimator
from flowsplat.priors.masks.stage import compute_evidence
from flowsplat.priors.prompts.parsing import Prompt
from flowsplat.priors.prompts.propagation import MaskPart, Walk
from flowsplat.scenes import Scene

SAME_OBJECT_OVERLAP = 0.5
"""Share of the smaller one by which two masks overlap if they show one object. Chosen by eye."""


def prompt_stage(scene: Scene, prompts: Sequence[Prompt], estimate: FlowEstimator = dis_estimator) -> None:
    """Masks with object numbers for the training frames. Needs cameras and flow.

    Args:
        prompts: as ``parse_prompts`` gives them.
        estimate: finds the flow between frames that are no neighbors.
    """
    frames = scene.train_frames
    objects = [list(group) for _, group in groupby(prompts, lambda prompt: prompt.number)]
    # Along the flow alone first: what a clip shows behind what moves is only known where that is known. What was said to be beside
    # one object must not change the evidence of the others.
    positive = [[replace(prompt, beside=()) for prompt in each if prompt.clicks or prompt.box] for each in objects]
    rough = [Walk(scene, each).parts() for each in positive]
    shown = [np.any([walk[k].mask for walk in rough], axis=0) for k in range(len(frames))]
    del rough
    evidence = compute_evidence(MatchedClip(scene, estimate), shown)
    walks = [Walk(scene, each, evidence).parts() for each in track(objects, "Masks")]
    numbers = _numbers(walks, [frames.index(each[0].frame) for each in objects])
    pixels, sure = 0, []
    masks = [np.zeros((scene.height, scene.width), np.uint8) for _ in frames]
    for walk, number in zip(walks, numbers, strict=True):
        for mask, part in zip(masks, walk, strict=True):
            mask[part.mask & (mask == 0)] = number
            sure.append(part.sure)
    for i, mask in zip(frames, masks, strict=True):
        scene.write_mask(i, mask)
        pixels += int((mask > 0).sum())
    share = pixels / (len(frames) * scene.width * scene.height)
    scene.finish_prior(
        "masks", method="clicks", verdict=f"{max(numbers)} object(s) from clicks and boxes on {share:.1%} of the image",
        objects=max(numbers), share=round(share, 5), confidence=round(float(np.mean(sure)), 4), prompts=plain(prompts),
    )  # fmt: skip


def shows(scene: Scene, prompts: Sequence[Prompt]) -> bool:
    """Return whether the masks that are there are of these prompts, as far as that was written down."""
    return (scene.prior("masks") or {}).get("prompts", plain(prompts)) == plain(prompts)


def plain(prompts: Sequence[Prompt]) -> list[dict[str, Any]]:
    """Prompts as JSON holds them."""
    plain: list[dict[str, Any]] = json.loads(json.dumps([asdict(prompt) for prompt in prompts]))
    return plain


def _numbers(walks: list[list[MaskPart]], starts: list[int]) -> list[int]:
    """Object numbers 1, 2, ... of the walks: one where a later one starts on what an earlier one shows."""
    numbers: list[int] = []
    for n, (walk, start) in enumerate(zip(walks, starts, strict=True)):
        own = walk[start].mask
        for earlier in range(n):
            other = walks[earlier][start].mask
            if (own & other).sum() > SAME_OBJECT_OVERLAP * min(own.sum(), other.sum()):
                numbers.append(numbers[earlier])
                break
        else:
            numbers.append(max(numbers, default=0) + 1)
    return numbers
