"""The final fit: a trained scene goes on for a few steps with its held-out frames, after it was measured without them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from flowsplat.gaussians.observations import Observation, Observations
from flowsplat.scenes import Flow, Scene, StoredFlow
from flowsplat.scenes.layers import Layers
from flowsplat.training.config import TrainConfig

STEPS_A_HELDOUT_FRAME = 20
"""Steps of the final fit for each held-out frame, no more than ``MAX_FINAL_FIT_SHARE`` of those of the training: then no held-out
frame stays behind by more than .3 dB, of bear and camel, on which it was chosen, and of train
(docs/notebook/2026-11.md, "How long the final fit is")."""
MAX_FINAL_FIT_SHARE = 0.25
"""Of the steps of the training, those of the final fit at most. Chosen by eye."""
FIRST_RATES = 0.8
"""Where in their fall from the beginning to the end of a training the rates of the final fit begin (docs/method/training.md)."""
AVERAGED_SHARE = 0.5
"""Of the steps with which a trained scene goes on, the share over which the result is the mean, where training has such a mean
(docs/method/training.md)."""
NEIGHBOR_VISITS = 2
"""How often a training frame beside a held-out one is drawn where others are drawn once: what is fitted to a frame is seen in the
frames beside it, too, and they would lose what the held-out frame gains (docs/method/training.md)."""


def count_final_steps(iterations: int, heldout: int) -> int:
    """Return how many steps the final fit takes after ``iterations`` of training, for ``heldout`` frames."""
    return max(1, min(STEPS_A_HELDOUT_FRAME * heldout, math.ceil(MAX_FINAL_FIT_SHARE * iterations)))


def final_config(config: TrainConfig, heldout: int) -> tuple[TrainConfig, int]:
    """Return the settings of the final fit for ``heldout`` frames, and the step that it begins with."""
    return continuation_config(config, count_final_steps(config.iterations, heldout), FIRST_RATES)


def continuation_config(config: TrainConfig, steps: int, first_rates: float) -> tuple[TrainConfig, int]:
    """Return the settings with which a trained scene goes on for ``steps``, and the step that it begins with.

    It is the end of a training that is so long that rates begin ``first_rates`` of the way down. Gaussians are neither added nor
    removed, and none begins to move or comes to rest.
    """
    iterations = round(steps / (1 - first_rates))
    settings = replace(
        config,
        iterations=iterations,
        gaussians=0,
        average=min(config.average, AVERAGED_SHARE * steps / iterations),
        density=replace(config.density, every=0, reset_every=0, gradient=0.0, revise=False, prune_change=0.0),
    )
    return settings, iterations - steps


def with_heldout(observations: Observations, scene: Scene, layers: Layers) -> Observations:
    """Return the observations of all frames in order. Depth and masks of held-out frames are unknown, which is: trusted nowhere,
    empty. Flow leads forwards only: backwards it is of use to a start alone, and here one is there.

    Args:
        observations: of the training frames.
        scene: of all frames.
        layers: the flow from and to held-out frames (``priors.heldout``).
    """
    known = {frame.frame: frame for frame in observations.frames}
    size, pairs = (scene.height, scene.width), set(layers.flow_pairs)

    def flow(i: int, j: int) -> Flow | StoredFlow | None:
        if i in known and j in known:
            near = known[i].forward
            return near if near is not None and near.j == j else None
        return layers.read_stored_flow(i, j) if (i, j) in pairs else None

    frames = []
    for i in range(scene.num_frames):
        frame = known.get(i) or Observation(
            frame=i,
            time=float(scene.times[i]),
            camera=observations.similarity.camera(scene.cameras[i]),
            image=scene.heldout_frame(i),
            depth=np.ones(size, np.float32),
            depth_trusted=np.zeros(size, bool),
            object_ids=np.zeros(size, np.uint8),
            forward=None,
            backward=None,
        )
        frames.append(replace(frame, forward=flow(i, i + 1), backward=None))
    return Observations(frames, observations.similarity, observations.overlay)


def final_visits(scene: Scene) -> list[int]:
    """Return how often every frame is drawn in a round of the final fit: the few held-out frames about as often as all others
    together."""
    heldout = set(scene.heldout_frames)
    often = max(1, round(len(scene.train_frames) / max(len(heldout), 1)))
    beside = {i + side for i in heldout for side in (-1, 1)}
    return [often if i in heldout else NEIGHBOR_VISITS if i in beside else 1 for i in range(scene.num_frames)]
