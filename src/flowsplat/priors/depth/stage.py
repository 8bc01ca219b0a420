"""The depth stage: planar depth for every training frame, without learned weights (docs/method/depth.md)."""

from __future__ import annotations

import numpy as np

from flowsplat.common.progress import track
from flowsplat.common.threads import in_threads, thread_count
from flowsplat.images.edge_smoothing import one_thread
from flowsplat.priors.background.fill import upsample
from flowsplat.priors.background.longflow import FLOW_STRIDES
from flowsplat.priors.background.matched_clip import MatchedClip
from flowsplat.priors.background.refined import RefinedDepth
from flowsplat.priors.background.static_depth import MAX_DEPTH, MIN_DEPTH, StaticDepth, camera_reach, static_depth
from flowsplat.priors.flow import FlowEstimator, dis_estimator
from flowsplat.priors.objects import SceneObjects, load_objects
from flowsplat.priors.objects.areas import large_objects
from flowsplat.priors.objects.description import sureness
from flowsplat.scenes import Depth, Scene

FRONT_MARGIN, KNOWN_FRONT_MARGIN = 1.03, 1.02
"""How much nearer than all that is known to be behind it an object is at least: where nothing tells its distance, and where
something does. A foot is as far away as the ground that it stands on. Chosen by eye."""
MAX_TIED_SIGMA = 0.14
"""Standard deviation of ln distance up to which an object counts as tied to the still scene. Chosen by eye."""
PLACES = {"contact", "bounce", "pivot", "contact_hint", "same_depth_hint"}
"""Standard deviation of an object's ln distance up to which it may stand behind what is only filled in, and the cues that tie it
to a place of the still scene, with which it may do so, too."""
OBJECT_CONFIDENCE = 0.6
"""Confidence of all depth on objects. Chosen by eye."""
MIN_TRUSTED_SHARE = 0.6
"""Share of trusted pixels from which depth is called known. Chosen by eye."""
TRUSTED_WEIGHT = 5.0
"""Weight at which a static pixel has a confidence of one half. Chosen by eye."""


def depth_stage(
    scene: Scene, estimate: FlowEstimator = dis_estimator, static: tuple[MatchedClip, StaticDepth] | None = None
) -> None:
    """Depth with confidence for every training frame that has none. Needs cameras and flow, and uses masks if there are any.

    Static pixels come from their matches in other frames of the same piece of the clip, objects from the object stage; what that
    does not know stands just in front of what it hides. A clip whose camera does not move (or only turns) gets a guess, and the
    verdict says so.

    Args:
        estimate: finds the flow between frames that are no neighbors.
        static: the clip and its static scene, where they are at hand.
    """
    has_masks = all(scene.has_mask(i) for i in scene.train_frames)
    clip = static[0] if static else MatchedClip(scene, estimate)
    background = static[1] if static else static_depth(clip, has_masks)
    objects = load_objects(scene)
    refined = RefinedDepth(clip, background, has_masks)

    def written(k: int) -> None:
        scene.write_depth(scene.train_frames[k], _frame_depth(clip, background, objects, refined, has_masks, k))

    missing = [k for k, i in enumerate(scene.train_frames) if not scene.has_depth(i)]
    if missing:
        work = list(refined.walk(written, missing))
        with one_thread():
            for _ in in_threads(lambda do: do(), track(work, "Depth"), thread_count()):
                pass
    method = "multi-view" if clip.has_parallax else "guess"
    share, static_share = measure_trusted_shares(scene)
    if clip.has_parallax:
        verdict = f"{static_share:.0%} of the still scene trusted"
        if static_share < MIN_TRUSTED_SHARE:
            verdict += ": the rest is filled in, and new views from aside will show it"
        large = large_objects(scene) if objects.objects else set()
        counted = [obj for obj in objects.objects if obj.number in large]
        if counted:
            tied = [obj.sigma for obj in counted if obj.cues]
            verdict += f"; distances of objects: {sureness(tied, len(counted) - len(tied))}"
    else:
        travels = camera_reach(clip) > 1e-9
        little = f"travels too little within {FLOW_STRIDES[-1]} frames" if travels else "does not travel"
        verdict = f"the camera {little}, so depth is a guess: new views from aside will be wrong"
        if travels and len(clip) > 2 * FLOW_STRIDES[-1]:
            verdict += "; --every takes frames further apart, which may show it"
    scene.finish_prior(
        "depth", method=method, verdict=verdict, trusted=round(share, 4), trusted_static=round(static_share, 4),
        parallax=round(clip.mean_parallax, 3), objects=len(objects.objects),
    )  # fmt: skip


def measure_trusted_shares(scene: Scene) -> tuple[float, float]:
    """Return which share of the pixels of the training frames has trusted depth: of all of them, and of those where nothing
    moves."""
    shares = []
    for i in scene.train_frames:
        trusted = scene.depth(i).trusted
        still = trusted[scene.mask(i) == 0] if scene.has_mask(i) else trusted
        shares.append((trusted.mean(), still.mean() if still.size else 0.0))
    of_all, of_still = np.mean(shares, axis=0)
    return float(of_all), float(of_still)


def _frame_depth(
    clip: MatchedClip, background: StaticDepth, objects: SceneObjects, refined: RefinedDepth, has_masks: bool, k: int
) -> Depth:
    scene = clip.scene
    frame = scene.frame(scene.train_frames[k])
    mask = scene.mask(scene.train_frames[k]) if has_masks else np.zeros((scene.height, scene.width), np.uint8)
    size = (scene.width, scene.height)
    moving = mask > 0
    static, weight, share = refined(k)
    if moving.any():
        front = upsample(background.compute_foremost(k), np.zeros_like(frame), *size)
        sure = upsample(background.compute_confirmed(k), np.zeros_like(frame), *size)
        known = objects.depth(k, mask, frame, scene.cameras[scene.train_frames[k]])
        nearness = np.where(known > 0, 1 / np.maximum(known, 1e-9), 0)
        # Nothing lies behind what other frames are sure of; what nothing ties stays just in front of what is filled in, too.
        tied = np.isin(
            mask, [obj.number for obj in objects.objects if obj.sigma <= MAX_TIED_SIGMA or not PLACES.isdisjoint(obj.cues)]
        )
        static = np.where(moving, np.maximum(nearness, np.where(tied, KNOWN_FRONT_MARGIN * sure, FRONT_MARGIN * front)), static)
    limits = background.median / MAX_DEPTH, background.median / MIN_DEPTH
    depth = 1 / np.clip(static, *limits)
    confidence = np.where(moving, OBJECT_CONFIDENCE, share * weight / (weight + TRUSTED_WEIGHT))
    return Depth(depth.astype(np.float32), confidence.astype(np.float32))
