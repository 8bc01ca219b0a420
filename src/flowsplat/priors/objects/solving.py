"""Each numbered object of a clip: its depth trajectory over time, its distance, and the depth of its pixels."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from flowsplat.geometry import Camera
from flowsplat.priors.background.ground import Ground
from flowsplat.priors.objects.contact import Bound, upright_ratio
from flowsplat.priors.objects.contact_cues import (
    MAX_BOUND_RANGE,
    MAX_UNEVEN_RANGE,
    MIN_BOUNDS,
    Feet,
    contact_cue,
    find_jumps,
    foot_offset,
    make_thrown_cue,
    settle_on_ground,
    unevenness,
    unsurer,
)
from flowsplat.priors.objects.depth_trajectory import DepthTrajectory, ObjectTracks, solve_depth_trajectory
from flowsplat.priors.objects.distance import Cue, Distance, combine
from flowsplat.priors.objects.monocular_cue import MonocularDistances
from flowsplat.priors.objects.path import bounce_frames
from flowsplat.priors.objects.rematching import ObjectImages
from flowsplat.priors.objects.shape_offset import EXPECTED_OFFSET_SIGMA, ShapePoints, interpolate_shape_offset, roundness

MAX_MONOCULAR_SIGMA_SHARE = 0.5
"""Of the standard deviation without it: that of monocular depth which may speak, too. Of two poor networks, on workshop and garden,
seven objects of seven then stay where they are; with 1 one moved by .04 (docs/notebook/2026-11.md, "Monocular depth as a cue")."""
MIN_TRACK_FRAMES = 5
"""Frames in which a track must be seen to tell of an object. Chosen by eye."""
MIN_INSIDE_SHARE = 0.7
"""Share of a track that must lie inside an object to be on it. Chosen by eye."""
GUESS_PERCENTILE, ABOVE_GROUND_LEAD = 10, 0.15
"""What does not touch the ground is guessed to be this much nearer, in ln, than where it would. Chosen by eye."""
BOUND_PERCENTILE, BOUND_SLACK = 5, 0.03
"""Over time, of where an object would touch the ground: it is not farther than this in any frame, but for errors of its outline.
Chosen by eye."""


@dataclass(frozen=True)
class DynamicObject:
    """One object.

    Attributes:
        number: in the masks.
        log_depth: [T] logarithm of the planar depth of its middle in the training frames; NaN where it is not seen.
        middles: [T, 2] the pixel that belongs to; NaN likewise.
        sigma: standard deviation of its distance, of ln s.
        rigid: whether its motion was found and explains all of it, so that it does not bend.
        cues: what speaks for its distance.
        points: depth of points on it, with its distance.
        expected: standard deviation of ln depth that its shape offset is expected to have.
    """

    number: int
    log_depth: np.ndarray
    middles: np.ndarray
    sigma: float
    rigid: bool
    cues: Mapping[str, Cue]
    points: ShapePoints
    expected: float

    def depth(self, k: int, mask: np.ndarray, image: np.ndarray, camera: Camera, normal: np.ndarray) -> np.ndarray:
        """Return planar depth [N] of its pixels ``mask`` [H, W] in training frame k, in the order of ``np.nonzero``."""
        y, x = np.nonzero(mask)
        middle, pixels = self.middles[k], np.stack([x, y], 1) + 0.5
        front = roundness(mask, float(camera.K[0, 0]))
        log_depth = self.log_depth[k] + np.log(upright_ratio(camera, normal, middle, pixels)) + front[y, x]
        here = self.points.frame_of == k
        if here.any():
            places = self.points.pixels[here]
            column, row = np.clip(places.astype(int), 0, [mask.shape[1] - 1, mask.shape[0] - 1]).T
            expected = self.log_depth[k] + np.log(upright_ratio(camera, normal, middle, places)) + front[row, column]
            offsets = self.points.log_depth[here] - expected
            log_depth = (
                log_depth + interpolate_shape_offset(mask, image, places, offsets, self.points.sigma[here], self.expected)[y, x]
            )
        return np.exp(log_depth)


def tracks_of_objects(
    positions: np.ndarray, visible: np.ndarray, mask_of: Callable[[int], np.ndarray], frames: Sequence[int]
) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Return which tracks lie on which object.

    Args:
        positions: [P, T, 2] pixels over the whole clip, where visible [P, T].
        mask_of: object numbers [H, W] of a frame.
        frames: training frames.

    Returns:
        By number: indices [N] of the tracks, and where over the training frames they lie on it [N, len(frames)].
    """
    labels = np.zeros((len(visible), len(frames)), np.uint8)
    for k, t in enumerate(frames):
        mask = mask_of(t)
        seen = np.flatnonzero(visible[:, t])
        x, y = np.clip(positions[seen, t].astype(int), 0, [mask.shape[1] - 1, mask.shape[0] - 1]).T
        labels[seen, k] = mask[y, x]
    seen_often = visible[:, list(frames)].sum(1)
    found = {}
    for number in np.unique(labels[labels > 0]):
        inside = labels == number
        count = inside.sum(1)
        chosen = np.flatnonzero((count >= MIN_TRACK_FRAMES) & (count >= MIN_INSIDE_SHARE * seen_often))
        found[int(number)] = chosen, inside[chosen]
    return found


def solve_object(
    number: int, positions: np.ndarray, inside: np.ndarray, middles: np.ndarray, bounds: Sequence[Bound | None],
    cameras: Sequence[Camera], ground: Ground | None, log_billboards: np.ndarray, normal: np.ndarray,
    front: Callable[[int], np.ndarray], images: ObjectImages | None = None, monocular: MonocularDistances | None = None,
) -> DynamicObject:  # fmt: skip
    """Return one object.

    Args:
        positions: [N, T, 2] pixels of its tracks over the training frames, where ``inside`` [N, T].
        middles: [T, 2] its middle pixels, NaN where it is not seen.
        bounds: [T] where it would touch the ground.
        cameras: [T].
        log_billboards: [T] logarithm of the depth of its billboard, NaN where it is not seen: a guess, and a depth trajectory
            where its motion is not believed.
        normal: [3] up.
        front: gives the ``roundness`` [H, W] of its mask in training frame k.
        images: to match its points anew in; None: tracks are all there is.
        monocular: what monocular depth says of its distance.
    """
    seen = np.isfinite(log_billboards) & np.isfinite(middles).all(1)
    tracks, feet = ObjectTracks(positions, inside, middles, cameras, normal), Feet.of(bounds, int(seen.sum()))
    found = solve_depth_trajectory(tracks, log_billboards, feet, ground, images)
    guess = float(np.median((log_billboards - found.log_depth)[seen]))
    at_ground = feet.log_depth - found.log_depth
    jumps = find_jumps(at_ground, feet.visible, feet.frames)
    # Who needs the excuse that some frames jump must stand still in all others: jumps and changes together are no contact.
    excused = unevenness(at_ground, feet.visible, feet.frames) > MAX_UNEVEN_RANGE
    most = MAX_BOUND_RANGE if excused else MAX_UNEVEN_RANGE
    feet = replace(feet, visible=feet.visible & ~jumps)
    stands = contact_cue(at_ground, feet.visible, feet.frames, most)
    if stands is not None and not found.bends:
        # What is deep, and its shadow, touches the ground before its middle: its own points tell by how much.
        touched = _at_feet(np.flatnonzero(feet.visible), found, tracks, feet, front)
        stands = contact_cue(touched, feet.visible, feet.frames, most) or stands
    bounces = None
    if feet.unevenness(found.log_depth) > MAX_BOUND_RANGE:  # it may touch the ground for moments only
        bounces = _bounces(found, tracks, feet, ground, float(np.exp(guess)), front)
        stands = stands if bounces is None else None
    if feet.is_supposed(found.log_depth):  # ground that is not seen may drop: it says less
        stands, bounces = (None if cue is None else unsurer(cue) for cue in (stands, bounces))
    depth_trajectory = found.log_depth
    if stands is not None and found.motion is None:
        depth_trajectory = depth_trajectory + settle_on_ground(at_ground - stands.log_scale, feet.visible)
        guess = float(np.median((log_billboards - depth_trajectory)[seen]))
    at_ground = at_ground[np.isfinite(at_ground) & feet.ground_seen & ~jumps]
    network = None if monocular is None else monocular.cue(number, depth_trajectory)
    distance, cues = _distance(guess, found.cues, stands, bounces, at_ground, network)
    points = replace(found.points, log_depth=found.points.log_depth + distance.log_scale)
    expected = EXPECTED_OFFSET_SIGMA * found.motion.size if found.motion is not None else 0.0
    return DynamicObject(
        number, depth_trajectory + distance.log_scale, middles, distance.sigma, not found.bends, cues, points, expected
    )


def _bounces(
    found: DepthTrajectory,
    tracks: ObjectTracks,
    feet: Feet,
    ground: Ground | None,
    scale: float,
    front: Callable[[int], np.ndarray],
) -> Cue | None:
    """That an object touched the ground for moments: where its path was thrown up.

    Args:
        scale: a guess of its distance, as a factor of its depth trajectory.
        front: as ``solve_object``.
    """
    if found.path is None or ground is None:
        return None
    thrown = bounce_frames(found.path, ground.normal, scale)
    return make_thrown_cue(_at_feet(thrown, found, tracks, feet, front), thrown)


def _at_feet(
    thrown: Sequence[int] | np.ndarray, found: DepthTrajectory, tracks: ObjectTracks, feet: Feet,
    front: Callable[[int], np.ndarray],
) -> np.ndarray:  # fmt: skip
    """Return [T] the bounds of its lowest pixels, NaN where they are not seen; about the frames in which it was ``thrown`` up by
    how much they are farther than its middle."""
    result = np.where(feet.visible, feet.lowest_log_depth - found.log_depth, np.nan)
    for k in {int(j) for i in thrown for j in (i - 1, i, i + 1) if 0 <= j < len(result) and np.isfinite(result[j])}:
        bound, here = feet.bounds[k], found.points.frame_of == k
        assert bound is not None  # where it touches is finite only there
        before, pixels = front(k), found.points.pixels[here]
        column, row = np.clip(pixels.astype(int), 0, [before.shape[1] - 1, before.shape[0] - 1]).T
        ratio = upright_ratio(tracks.cameras[k], tracks.normal, tracks.middles[k], pixels)
        billboard = found.log_depth[k] + np.log(ratio) + before[row, column]
        result[k] -= foot_offset(bound.lowest, before, pixels, found.points.log_depth[here] - billboard, found.points.sigma[here])
    return result


def _distance(
    guess: float, laws: Mapping[str, Cue], stands: Cue | None, bounces: Cue | None, known: np.ndarray, network: Cue | None = None
) -> tuple[Distance, Mapping[str, Cue]]:
    """Return how far away an object is, and the cue that says so, by its name.

    Args:
        guess: ln of its distance if it touches nothing.
        laws: what laws of motion say.
        stands: what its feet say that stand on the ground; ``bounces``: that touch it for moments.
        known: [n] where it would touch the ground, of the frames that see that.
        network: what monocular depth says. What is hardly surer than all else together changes nothing.
    """
    cues, far = dict(laws), []
    # Where it touches is what bounds it; else no frame may put it below the ground. Ground that is only supposed bounds nothing.
    touch = stands if stands is not None else bounces
    if touch is not None:
        cues["contact" if stands is not None else "bounce"] = touch
    elif len(known) >= MIN_BOUNDS:
        far = [float(np.percentile(known, BOUND_PERCENTILE)) + BOUND_SLACK]
    # Laws of motion and contact rest on the same depth trajectory, so their errors are not independent: only the surest speaks.
    if len(cues) > 1:
        surest = min(cues, key=lambda name: cues[name].sigma)
        cues = {surest: cues[surest]}
    near_ground = float(np.percentile(known, GUESS_PERCENTILE)) - ABOVE_GROUND_LEAD if len(known) >= MIN_BOUNDS else None
    if touch is not None and touch in cues.values():
        # What hides behind an object that touches the ground says nothing that its feet do not say better.
        guess, near_ground = touch.log_scale, None
    distance = combine(guess, cues, far, near_ground)
    if network is None or network.sigma > MAX_MONOCULAR_SIGMA_SHARE * distance.sigma:
        return distance, cues
    cues = {**cues, "monocular": network}
    return combine(guess, cues, far, near_ground), cues
