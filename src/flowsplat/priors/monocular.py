"""The depth stage with monocular depth (``MonocularMaps``), fitted to the cameras.

Where the scene rests and its matches are trusted, what they say stays; elsewhere, and on objects above all, the fitted monocular
depth is taken.
"""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np

from flowsplat.common.progress import track
from flowsplat.geometry.cameras import pixel_grid
from flowsplat.geometry.interpolation import sample_map
from flowsplat.priors.background.fill import fill, upsample
from flowsplat.priors.background.matched_clip import MatchedClip
from flowsplat.priors.background.monocular_maps import HALF_TRUST_MISFIT, MIN_STATIC_PIXELS, Monocular, MonocularMaps, measure_lines
from flowsplat.priors.background.static_depth import MAX_DEPTH, MIN_DEPTH, Background, compute_far_inverse
from flowsplat.priors.depth.stage import FRONT_MARGIN, TRUSTED_WEIGHT, measure_trusted_shares
from flowsplat.priors.flow import FlowEstimator, dis_estimator
from flowsplat.scenes import Depth, Scene
from flowsplat.scenes.layers import TRUSTED_CONFIDENCE

FURTHEST_INVERSE_RATIO = 0.1
"""Without parallax: inverse depth of the furthest percent of the clip over its median, where infinity is not known.
Chosen by eye."""


def monocular_stage(
    scene: Scene, source: Monocular, estimate: FlowEstimator = dis_estimator, clip: MatchedClip | None = None
) -> None:
    """Depth with confidence for every training frame from monocular depth. Needs cameras and flow, uses masks if there are any.

    Without parallax nothing measures scale and shift: the frames are then fitted to each other, the whole clip gets an
    arbitrary scale, and the verdict says so.

    Args:
        estimate: finds the flow between frames that are no neighbors.
        clip: the matched clip, where it is at hand.
    """
    clip = clip or MatchedClip(scene, estimate)
    maps = MonocularMaps(clip, source)
    write = _write_measured if clip.has_parallax else _write_free
    figures = write(maps, source)
    trusted, still = measure_trusted_shares(scene)
    verdict = f"{source.source}, {figures.pop('verdict')}, {still:.0%} of the still scene trusted"
    scene.finish_prior(
        "depth", method=source.method, verdict=verdict, trusted=round(trusted, 4), trusted_static=round(still, 4), **figures
    )
    maps.remove()


def _write_measured(maps: MonocularMaps, source: Monocular) -> dict[str, object]:
    """Fit every frame to the static scene that the matches show, and write it."""
    clip = maps.clip
    background = Background(clip, maps.has_masks)
    lines, misfits = measure_lines(maps, background)
    for k in track(range(len(clip)), "Depth"):
        _write_frame(maps, background, k, lines[k], misfits[k])
    return {
        "verdict": "scale and shift of every frame fitted to the cameras",
        "misfit": round(float(np.median(misfits)), 4), "parallax": round(clip.mean_parallax, 3),
    }  # fmt: skip


def _write_frame(maps: MonocularMaps, background: Background, k: int, line: np.ndarray, misfit: float) -> None:
    clip, scene = maps.clip, maps.scene
    i = scene.train_frames[k]
    frame, moving, size = scene.frame(i), maps.read_objects(k), (scene.width, scene.height)
    inverse, known = maps[k]
    floor, ceiling = clip.median / MAX_DEPTH, clip.median / MIN_DEPTH
    measured, weight = background.fill(k)
    weight = np.where(background.mask(k) > 0, 0, weight).astype(np.float32)
    plate = upsample(background.plate(k), np.zeros_like(frame), *size)
    behind = np.where(moving, plate, upsample(measured, frame, *size))
    aligned = np.where(known >= TRUSTED_CONFIDENCE, line[0] * inverse + line[1], behind)
    aligned = np.clip(aligned, floor, ceiling).astype(np.float32)
    # What is measured bends the monocular depth towards it, and what lies between two measurements bends along.
    small = cv2.resize(aligned, (clip.width, clip.height), interpolation=cv2.INTER_AREA)
    trusted = np.where(weight > TRUSTED_WEIGHT, weight, 0)
    bend = fill(measured - small, trusted, clip.image(k))[0] if trusted.any() else np.zeros_like(small)
    static = np.clip(aligned + upsample(bend, frame, *size), floor, ceiling)
    front = upsample(background.compute_foremost(k), np.zeros_like(frame), *size)
    depth = 1 / np.clip(np.where(moving, np.maximum(aligned, FRONT_MARGIN * front), static), floor, ceiling)
    own = np.float32(1 / (1 + (misfit / HALF_TRUST_MISFIT) ** 2)) * known
    seen = np.maximum(upsample(weight, np.zeros_like(frame), *size), 0)
    confidence = np.where(moving, own, np.maximum(own, seen / (seen + TRUSTED_WEIGHT)))
    scene.write_depth(i, Depth(depth.astype(np.float32), confidence.astype(np.float32)))


def _write_free(maps: MonocularMaps, source: Monocular) -> dict[str, object]:
    """Without parallax: fit the frames to each other, scale the clip so that its cameras see no parallax, and write it."""
    clip, scene = maps.clip, maps.scene
    lines = _chain_lines(maps, source.relative)
    samples = np.concatenate([
        (lines[k, 0] * maps.small(k)[0] + lines[k, 1]).ravel()[::17] for k in range(0, len(clip), max(1, len(clip) // 16))
    ])  # fmt: skip
    middle, far = float(np.median(samples)), float(np.percentile(samples, 1))
    shift = 0.0
    if source.relative or far <= 0:
        shift = (FURTHEST_INVERSE_RATIO * middle - far) / (1 - FURTHEST_INVERSE_RATIO)
    scale = compute_far_inverse(clip) / max(middle + shift, 1e-9)
    floor, ceiling = scale * (middle + shift) / MAX_DEPTH, scale * (middle + shift) / MIN_DEPTH
    for k, i in enumerate(track(scene.train_frames, "Depth")):
        inverse, known = maps[k]
        aligned = np.clip(scale * (lines[k, 0] * inverse + lines[k, 1] + shift), floor, ceiling)
        scene.write_depth(i, Depth((1 / aligned).astype(np.float32), np.float32(0.6) * known))
    return {
        "verdict": "the camera does not travel, so scale and shift are free and the same for the whole clip: "
        "new views from aside keep the order of things, not their distance",
        "parallax": round(clip.mean_parallax, 3),
    }  # fmt: skip


def _chain_lines(maps: MonocularMaps, relative: bool) -> np.ndarray:
    """Return (scale, shift) [T, 2] that make every frame's inverse depth agree with that of the frame before where nothing moves.

    Median and spread are made equal and no line is fitted: a fit would flatten the clip, a little with every frame.

    Args:
        relative: whether frames differ by a shift too, and not only by their scale.
    """
    clip = maps.clip
    lines = np.tile([1.0, 0.0], (len(clip), 1))
    grid = pixel_grid(clip.width, clip.height)
    for before, k in pairwise(range(len(clip))):
        flow, confidence = clip.step_flow(k, before)
        landed = (grid + flow).reshape(-1, 2)
        moves_there = sample_map(maps.read_objects_small(before), landed)[:, 0].reshape(confidence.shape)
        chosen = (maps.read_objects_small(k) == 0) & (moves_there == 0) & (confidence >= TRUSTED_CONFIDENCE)
        lines[k] = lines[before]
        if not clip.continuity.same_piece(k, before):
            # Nothing is known across a cut; what comes after it is as far away as what came before.
            middle = lines[before, 0] * float(np.median(maps.small(before)[0])) + lines[before, 1]
            here = float(np.median(maps.small(k)[0]))
            lines[k] = (lines[before, 0], middle - lines[before, 0] * here) if relative else (middle / max(here, 1e-9), 0.0)
        elif chosen.sum() >= MIN_STATIC_PIXELS:
            here = maps.small(k)[0][chosen]
            there = sample_map(maps.small(before)[0], landed[chosen.ravel()])[:, 0]
            middles = float(np.median(there)), float(np.median(here))
            # Without a shift of its own a frame differs by its scale alone.
            sizes = [np.subtract(*np.percentile(values, [80, 20])) for values in (there, here)] if relative else middles
            ratio = sizes[0] / sizes[1] if min(sizes) > 1e-9 else 1.0
            shift = middles[0] - ratio * middles[1]
            lines[k] = lines[before, 0] * ratio, lines[before, 0] * shift + lines[before, 1]
    return lines
