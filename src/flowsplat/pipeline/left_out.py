"""Say how many frames of the input a run does without, and what all of them would cost."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from flowsplat.common.spread import spread
from flowsplat.pipeline.config import RunConfig
from flowsplat.pipeline.speed import ESTIMATE_FACTOR, Speed, TimeEstimate, estimate_memory, estimate_seconds, estimate_seconds_with
from flowsplat.scenes import Scene
from flowsplat.scenes.clip import MAX_FRAMES

LOOKED_FRAMES = 8
"""Frames in which it is measured how far what moves goes. Chosen by eye."""
MIN_OBJECT_PIXELS = 20
"""Pixels of what moves from which a frame tells. Chosen by eye."""


def word_left_out(scene: Scene, config: RunConfig, speed: Speed) -> str | None:
    """Return a sentence on the frames that were thinned out, before the run: its time is estimated; None where none were."""
    count = scene.info.input_frames
    return None if count is None else _word(scene, config, count, speed.estimate(estimate_seconds_with(scene, config, count)), "")


def word_left_out_after(scene: Scene, config: RunConfig, metrics: Mapping[str, Any]) -> str | None:
    """Return the same of a measured run: all frames take as many times what it took as they do by the estimate.

    Args:
        metrics: as in ``metrics.json``.
    """
    count, took = scene.info.input_frames, sum((metrics.get("seconds") or {}).values())
    if count is None or took <= 0:
        return None
    longer = sum(estimate_seconds_with(scene, config, count).values()) / sum(estimate_seconds(scene, config).values())
    step = measure_object_step(scene)
    moves = "" if step is None else f"; what moves goes {step:.0f} pixels from one to the next"
    return _word(scene, config, count, TimeEstimate(took * longer, ESTIMATE_FACTOR), moves)


def measure_object_step(scene: Scene) -> float | None:
    """Return how many pixels what moves goes from a training frame to the next, relative to what rests: of a tenth of its pixels at
    least so many, the median over some frames. The farther that is, the more all frames are worth (docs/tutorial.md).

    Returns:
        None where nothing moves, or masks or flow are not there.
    """
    frames, pairs, steps = scene.train_frames, set(scene.flow_pairs), []
    for k in spread(len(frames) - 1, LOOKED_FRAMES):
        i, j = frames[k], frames[k + 1]
        if not (scene.has_mask(i) and (i, j) in pairs):
            return None
        moving = scene.mask(i) > 0
        if MIN_OBJECT_PIXELS <= moving.sum() < moving.size:
            flow = scene.flow(i, j).flow
            steps.append(np.percentile(np.linalg.norm(flow[moving] - np.median(flow[~moving], 0), axis=1), 90))
    return float(np.median(steps)) if steps else None


def _word(scene: Scene, config: RunConfig, count: int, time: TimeEstimate, moves: str) -> str:
    rate = (scene.num_frames - 1) / float(scene.timestamps[-1] - scene.timestamps[0])
    used = f"Used {scene.num_frames} of {count} frames, {rate:.2g} a second{moves}"
    if count > MAX_FRAMES:
        return f"{used}."
    heldout = round(count * len(scene.heldout_frames) / scene.num_frames)
    gib = estimate_memory(scene.width, scene.height, count - heldout)
    option = f"{'' if config.input.every is None else '--every 1 '}--max-frames {count}"
    return f"{used}: {option} takes {time} and {gib:.1f} GiB here."
