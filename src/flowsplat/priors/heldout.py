"""Flow to and from held-out frames, for the final fit: computed after the measurement, in a folder that nothing else reads."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from flowsplat.common.progress import track
from flowsplat.priors.continuity import Continuity
from flowsplat.priors.flow import FlowEstimator, dis_estimator, forward_backward_confidence
from flowsplat.scenes import Flow, Scene
from flowsplat.scenes.layers import Layers
from flowsplat.scenes.overlay import hide_overlay


def heldout_flow(scene: Scene, layers: Layers, estimate: FlowEstimator = dis_estimator) -> None:
    """Flow between every held-out frame and its neighbors in time, both ways; existing pairs are kept.

    Args:
        scene: is read and not written.
        layers: where the flow goes: never the scene's own folder.
    """
    assert layers.folder.resolve() != scene.folder.resolve()
    done, continuity, heldout = set(layers.flow_pairs), Continuity(scene), set(scene.heldout_frames)
    pairs = [pair for pair in pairwise(range(scene.num_frames)) if heldout & set(pair)]
    for i, j in track(pairs, "Flow of held-out frames"):
        if {(i, j), (j, i)} <= done:
            continue
        # A cut beside a held-out frame is known by the training frames around it only: flow on both sides then counts for nothing.
        before = max((k for k, t in enumerate(scene.train_frames) if t <= i), default=None)
        after = min((k for k, t in enumerate(scene.train_frames) if t >= j), default=None)
        joined = before is None or after is None or continuity.are_joined(before, after)
        a, b = (scene.heldout_frame(t) if t in heldout else scene.frame(t) for t in (i, j))
        flows = {(i, j): estimate(a, b), (j, i): estimate(b, a)}
        for s, t in flows:
            confidence = hide_overlay(scene.overlay, flows[s, t], forward_backward_confidence(flows[s, t], flows[t, s]))
            layers.write_flow(Flow(s, t, flows[s, t], confidence if joined else np.zeros_like(confidence)))
