"""Each numbered mover of a clip: its course over time, its distance, and the depth of its pixels."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from flowsplat.geometry import Camera
from flowsplat.priors.background.ground import Ground
from flowsplat.priors.objects.contact import Bound, ground_bound, middle_of, upright_ratio
from flowsplat.priors.objects.distance import Cue, Distance, combine
from flowsplat.priors.objects.path import Law, WorldPath, constant_height, pivot, smooth
from flowsplat.priors.objects.relief import DEEPEST, ReliefPoints, place_points, relief
from flowsplat.priors.objects.rigid import Observations, RigidMotion, longest, solve_rigid

FEWEST_TRACKS, FEWEST_FRAMES = 24, 10
SHORTEST_TRACK = 5
INSIDE = 0.7
"""Share of a track that must lie inside a mover to be on it."""
SPLIT_HALF = 0.04
"""Standard deviation over time between ln z of two solutions from halves of the tracks, above which none is believed."""
INLIERS = 0.85
HALF_PER_FRAME = 25
FLOOR = {"pivot": 0.02, "height": 0.03, "smooth": 0.03, "contact": 0.025}
WRONG = {"pivot": 0.05, "height": 0.05, "smooth": 0.1, "contact": 0.07}
FLAT = 0.07
"""Range of the bounds, from the 10th to the 60th percentile over time, up to which a mover stands on the ground."""
FEWEST_BOUNDS = 8
BOUND_SLACK = 0.03


@dataclass(frozen=True)
class Mover:
    """One mover.

    Attributes:
        number: in the masks.
        log_course: [T] logarithm of the depth of its middle over time, up to one constant; NaN where it is not seen.
        middles: [T, 2] the pixel that belongs to.
        distance: ln s and its standard deviation.
        cues: those that were accepted.
        laws: what every law of motion said, accepted or not.
        bounds: [T] ln s at which it would touch the ground; NaN where nothing is known.
        motion: of a rigid mover that is believed.
        points: its relief.
        why: what speaks for its distance, or why nothing does.
    """

    number: int
    log_course: np.ndarray
    middles: np.ndarray
    distance: Distance
    cues: Mapping[str, Cue]
    laws: Mapping[str, Law] = field(default_factory=dict)
    bounds: np.ndarray = field(default_factory=lambda: np.zeros(0))
    motion: RigidMotion | None = None
    points: ReliefPoints | None = None
    why: str = ""

    def depth(self, t: int, mask: np.ndarray, picture: np.ndarray, camera: Camera, normal: np.ndarray) -> np.ndarray:
        """Planar depth [H, W] float32 of its pixels ``mask`` [H, W] in frame t."""
        y, x = np.nonzero(mask)
        result = np.zeros(mask.shape, np.float32)
        pixels = np.stack([x, y], 1) + 0.5
        middle = self.middles[t] if np.isfinite(self.middles[t]).all() else middle_of(mask)
        log_depth = self.log_course[t] + self.distance.log_scale + np.log(upright_ratio(camera, normal, middle, pixels))
        if self.points is not None and self.motion is not None:
            here = self.points.frame_of == t
            if here.any():
                places = self.points.pixels[here]
                card = np.log(upright_ratio(camera, normal, middle, places)) + self.log_course[t]
                stands_out = relief(
                    mask, picture, places, self.points.log_depth[here] - card, self.points.sigma[here], DEEPEST * self.motion.size
                )
                log_depth = log_depth + stands_out[y, x]
        result[y, x] = np.exp(log_depth)
        return result


def tracks_of_movers(
    positions: np.ndarray, visible: np.ndarray, mask_of: Callable[[int], np.ndarray], frames: Sequence[int]
) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Which tracks lie on which mover.

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
        chosen = np.flatnonzero((count >= SHORTEST_TRACK) & (count >= INSIDE * seen_often))
        found[int(number)] = chosen, inside[chosen]
    return found


def rigid_motion(positions: np.ndarray, inside: np.ndarray, K: np.ndarray) -> RigidMotion | None:
    """The motion of a mover from its tracks, if both halves of them tell the same; None where it is not believed."""
    if len(inside) < FEWEST_TRACKS or inside.any(0).sum() < FEWEST_FRAMES:
        return None

    def solved(rows: np.ndarray, most: int) -> RigidMotion | None:
        chosen = rows[longest(inside[rows], most)]
        return solve_rigid(Observations.of_tracks(positions[chosen], inside[chosen], K))

    whole = solved(np.arange(len(inside)), 45)
    if whole is None or whole.inliers < INLIERS:
        return None
    halves = [solved(np.arange(len(inside))[start::2], HALF_PER_FRAME) for start in (0, 1)]
    if halves[0] is None or halves[1] is None:
        return None
    differences = halves[0].log_depths() - halves[1].log_depths()
    known = np.isfinite(differences)
    if known.sum() < FEWEST_FRAMES or float(np.std(differences[known])) > SPLIT_HALF:
        return None
    return whole


def accepted_laws(path: WorldPath, normal: np.ndarray | None) -> tuple[dict[str, Cue], dict[str, Law]]:
    """The laws of motion that pass their gates, as cues; and what every law said."""
    laws: dict[str, Law] = {"pivot": pivot(path)}
    if normal is not None:
        laws["height"] = constant_height(path, normal)
    even = smooth(path)
    if even is not None:
        laws["smooth"] = even
    p, passed = laws["pivot"], {}
    passed["pivot"] = (
        p.fit <= 3 and p.measures["rest"] <= 0.6 and p.measures["turned"] >= 30 and p.measures["lever"] <= 8
    )
    passed["height"] = "height" in laws and laws["height"].measures["explained"] >= 0.3
    passed["smooth"] = "smooth" in laws and laws["smooth"].measures["gain"] >= 1.5
    cues = {
        name: Cue(-float(np.log(law.nearness)), float(np.hypot(law.sigma, FLOOR[name])), WRONG[name])
        for name, law in laws.items()
        if law.usable and passed[name]
    }
    # They share the poses of one solution, so only the surest speaks.
    if cues:
        best = min(cues, key=lambda name: cues[name].sigma)
        cues = {best: cues[best]}
    return cues, laws


def contact_cue(bounds: np.ndarray, visible: np.ndarray) -> Cue | None:
    """That a mover stands on the ground: its bounds [T] hardly change over time."""
    seen = np.sort(bounds[visible & np.isfinite(bounds)])
    if len(seen) < FEWEST_BOUNDS or len(seen) < 0.3 * np.isfinite(bounds).sum():
        return None
    low, middle, high = np.percentile(seen, [10, 30, 60])
    if high - low > FLAT:
        return None
    return Cue(float(middle), float(np.hypot(FLOOR["contact"], 0.5 * (high - low))), WRONG["contact"])


def solve_mover(
    number: int, positions: np.ndarray, inside: np.ndarray, masks: Sequence[np.ndarray], cameras: Sequence[Camera],
    ground: Ground | None, statics: Sequence[np.ndarray], log_cards: np.ndarray, normal: np.ndarray,
) -> Mover:  # fmt: skip
    """One mover.

    Args:
        positions: [N, T, 2] pixels of its tracks over the training frames, where ``inside`` [N, T].
        masks: [T] bool [H, W].
        statics: [T] planar depth [H, W] of the static scene.
        log_cards: [T] logarithm of the depth of today's card, NaN where it is not seen: a guess, and a course where its motion is
            not believed.
        normal: [3] up.
    """
    K, T = cameras[0].K, len(cameras)
    middles = np.array([middle_of(mask) if mask.any() else [np.nan, np.nan] for mask in masks])
    motion = rigid_motion(positions, inside, K)
    course, why = log_cards - np.nanmean(log_cards), "growth"
    points, cues, laws = None, {}, {}
    if motion is not None:
        points = place_points(motion, Observations.of_tracks(positions, inside, K), K)
        solved = motion.log_depths()
        for t in range(T):
            here = (points.frame_of == t) & (points.sigma < np.inf)
            if here.sum() >= 3 and np.isfinite(middles[t]).all():
                card = np.log(upright_ratio(cameras[t], normal, middles[t], points.pixels[here]))
                solved[t] = np.median(points.log_depth[here] - card)
        seen = np.isfinite(log_cards)
        known = np.isfinite(solved)
        filled = np.interp(np.arange(T), np.flatnonzero(known), solved[known])
        course, why = np.where(seen, filled, np.nan), "rigid"
        cues, laws = accepted_laws(WorldPath.of(motion, cameras), ground.normal if ground else None)
    guess = float(np.nanmedian(log_cards - course))
    bounds, visible = np.full(T, np.nan), np.zeros(T, bool)
    if ground is not None:
        for t in range(T):
            bound: Bound | None = ground_bound(masks[t], cameras[t], ground, statics[t]) if np.isfinite(course[t]) else None
            if bound is not None:
                bounds[t], visible[t] = bound.log_depth - course[t], bound.visible
    stands = contact_cue(bounds, visible)
    if stands is not None:
        cues = {**cues, "contact": stands}
    known = np.isfinite(bounds)
    far = [float(np.percentile(bounds[known], 5)) + BOUND_SLACK] if known.sum() >= FEWEST_BOUNDS else []
    return Mover(
        number, course, middles, combine(guess, cues, far), cues, laws, bounds, motion, points, why,
    )  # fmt: skip
