"""Each numbered mover of a clip: its course over time, its distance, and the depth of its pixels."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d

from flowsplat.geometry import Camera
from flowsplat.priors.background.ground import Ground
from flowsplat.priors.objects.contact import Bound, upright_ratio
from flowsplat.priors.objects.distance import Cue, combine
from flowsplat.priors.objects.path import Law, WorldPath, bounce_frames, constant_height, pivot
from flowsplat.priors.objects.relief import DEEPEST, ReliefPoints, place_points, relief, roundness
from flowsplat.priors.objects.rematch import MoverPictures, rematched
from flowsplat.priors.objects.rigid import Observations, RigidMotion, longest, solve_rigid

FEWEST_TRACKS, FEWEST_FRAMES = 16, 10
SHORTEST_TRACK = 5
INSIDE = 0.7
"""Share of a track that must lie inside a mover to be on it."""
SPLIT_HALF = 0.04
"""Standard deviation over time between ln z of two solutions from halves of the tracks, above which none is believed."""
INLIERS = 0.7
RIGID_SHARE = 0.85
"""Share of all observations on a mover that its motion explains from which it does not bend, so that its points have one shape."""
PER_FRAME = (50, 180)
"""Tracks in a frame that the motion is solved from, the longest first; half of them for either half. Both are tried."""
FLOOR = {"pivot": 0.02, "height": 0.03, "contact": 0.025, "bounce": 0.03}
WRONG = {"pivot": 0.05, "height": 0.05, "contact": 0.07, "bounce": 0.1}
FLAT, FLAT_LOW, FLAT_HIGH = 0.1, 10, 70
"""Range of the bounds between two percentiles over time up to which a mover stands on the ground."""
CONTRADICTED = 0.15
"""Standard deviation over time between ln z by motion and by growth from which the ground decides which of them is right."""
MOSTLY = 0.5
"""Share of the frames in which a mover is seen in which its feet must be seen, too: what swings hides where it is high."""
FEWEST_BOUNDS = 8
STEPS = 5.0
"""Frames: standard deviation over time of what feet say about a course; steps are shorter."""
SUPPOSED_SIGMA, SUPPOSED_WRONG = 0.06, 0.25
"""What is added to the error of a contact with ground that was not seen, and its chance to be wrong."""
BOUNCE_SPAN = 2
"""Frames to either side over which the second difference of the bounds is taken."""
BOUNCE, BOUNCE_NOISE = 0.1, 4.0
"""Second difference of the bounds from which a minimum may be a bounce, and how many times their usual spread that must be."""
BOUNCE_WIDTH, BOUNCE_ELSEWHERE = 4, 0.25
"""So many frames from a bounce the second difference is at most this share of that at it: a smooth minimum is wider."""
THROWN_SIGMA = 0.03
"""Standard deviation of the nearest bound at several bounces; of a single one it is half as much more."""
FOOT = 0.15
"""Standard deviation of the distance, in the picture, at which points of a mover tell of its foot: of the root of its area."""
GUESS_PERCENTILE, ABOVE_GROUND = 10, 0.15
"""What does not touch the ground is guessed to be this much nearer, in ln, than where it would."""
BOUND_PERCENTILE, BOUND_SLACK = 5, 0.03
"""Over time, of where a mover would touch the ground: it is not farther than this in any frame, but for errors of its outline."""


@dataclass(frozen=True)
class Mover:
    """One mover.

    Attributes:
        number: in the masks.
        log_depth: [T] logarithm of the planar depth of its middle in the training frames; NaN where it is not seen.
        middles: [T, 2] the pixel that belongs to; NaN likewise.
        sigma: standard deviation of its distance, of ln s.
        rigid: whether its motion was found and explains all of it, so that it does not bend.
        cues: what speaks for its distance.
        points: depth of points on it, with its distance.
        expected: standard deviation of ln depth that its relief is expected to have.
    """

    number: int
    log_depth: np.ndarray
    middles: np.ndarray
    sigma: float
    rigid: bool
    cues: Mapping[str, Cue]
    points: ReliefPoints
    expected: float

    def depth(self, k: int, mask: np.ndarray, picture: np.ndarray, camera: Camera, normal: np.ndarray) -> np.ndarray:
        """Planar depth [N] of its pixels ``mask`` [H, W] in training frame k, in the order of ``np.nonzero``."""
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
            log_depth = log_depth + relief(mask, picture, places, offsets, self.points.sigma[here], self.expected)[y, x]
        return np.exp(log_depth)


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


def rigid_motions(positions: np.ndarray, inside: np.ndarray, K: np.ndarray) -> tuple[RigidMotion | None, list[RigidMotion]]:
    """The motion of a mover from its tracks, if both halves of them tell the same, else None; and all that was found."""
    if len(inside) < FEWEST_TRACKS or inside.any(0).sum() < FEWEST_FRAMES:
        return None, []

    def solved(rows: np.ndarray, most: int) -> RigidMotion | None:
        chosen = rows[longest(inside[rows], most)]
        return solve_rigid(Observations.of_tracks(positions[chosen], inside[chosen], K).in_pieces())

    every = np.arange(len(inside))
    found = [(whole, most) for most in PER_FRAME if (whole := solved(every, most)) is not None]
    motions = [whole for whole, _ in found]
    # More tracks make a rigid body surer. In what bends they are limbs that move on their own, and disagree.
    for whole, most in sorted(found, key=lambda each: each[0].noise):
        if whole.inliers < INLIERS:
            continue
        halves = [solved(every[start::2], most // 2) for start in (0, 1)]
        if halves[0] is None or halves[1] is None:
            continue
        differences = halves[0].log_depths() - halves[1].log_depths()
        known = np.isfinite(differences)
        if known.sum() >= FEWEST_FRAMES and float(np.std(differences[known])) <= SPLIT_HALF:
            return whole, motions
    return None, motions


def accepted_laws(path: WorldPath, normal: np.ndarray | None) -> tuple[dict[str, Cue], dict[str, Law]]:
    """The laws of motion that pass their gates, as cues; and what every law said."""
    laws: dict[str, Law] = {"pivot": pivot(path)}
    if normal is not None:
        laws["height"] = constant_height(path, normal)
    p, passed = laws["pivot"], {}
    passed["pivot"] = p.measures["rest"] <= 0.6 and p.measures["turned"] >= 30 and p.measures["lever"] <= 8
    passed["height"] = "height" in laws and laws["height"].measures["explained"] >= 0.3
    cues = {
        name: Cue(-float(np.log(law.nearness)), float(np.hypot(law.sigma, FLOOR[name])), WRONG[name])
        for name, law in laws.items()
        if law.usable and law.holds and passed[name]
    }
    return cues, laws


def unevenness(bounds: np.ndarray, visible: np.ndarray, frames: int) -> float:
    """How much the bounds [T] of a mover change over time; inf where its feet are seen in too few of the ``frames``."""
    seen = bounds[visible & np.isfinite(bounds)]
    if len(seen) < max(FEWEST_BOUNDS, MOSTLY * frames):
        return np.inf
    low, high = np.percentile(seen, [FLAT_LOW, FLAT_HIGH])
    return float(high - low)


def contact_cue(bounds: np.ndarray, visible: np.ndarray, frames: int) -> Cue | None:
    """That a mover stands on the ground: its bounds [T] hardly change over time.

    Args:
        visible: [T] whether its feet are.
        frames: in how many it is seen.
    """
    if unevenness(bounds, visible, frames) > FLAT:
        return None
    low, middle, high = np.percentile(bounds[visible & np.isfinite(bounds)], [FLAT_LOW, 35, FLAT_HIGH])
    return Cue(float(middle), float(np.hypot(FLOOR["contact"], 0.5 * (high - low))), WRONG["contact"])


def settled(above: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """[T] what brings the course of a mover that stands to the ground over time.

    A course that only its size tells is some percent off over time, where feet are seen to one or two.

    Args:
        above: [T] in ln, how much farther than its course each frame's feet would be on the ground.
        visible: [T] whether they are seen.
    """
    seen = visible & np.isfinite(above)
    weight = gaussian_filter1d(seen.astype(float), STEPS, mode="nearest")
    value = gaussian_filter1d(np.where(seen, np.clip(above, -FLAT, FLAT), 0), STEPS, mode="nearest")
    return np.where(weight > 1e-3, value / np.maximum(weight, 1e-3), 0)


def unsurer(cue: Cue) -> Cue:
    """The same on ground that was not seen."""
    return Cue(cue.log_scale, float(np.hypot(cue.sigma, SUPPOSED_SIGMA)), SUPPOSED_WRONG)


def thrown_cue(bounds: np.ndarray, thrown: np.ndarray) -> Cue | None:
    """That a mover touched the ground in the frames in which its own path was thrown up.

    Thin tips of a mask and feet that something hides put a bound too far, so the nearest of them speaks.

    Args:
        bounds: [T] at its lowest pixels (``foot_offset``), NaN where they are not seen.
        thrown: [B] frames.
    """
    levels = [float(np.nanmin(around)) for k in thrown if np.isfinite(around := bounds[max(k - 1, 0) : k + 2]).any()]
    if not levels:
        return None
    return Cue(min(levels), THROWN_SIGMA if len(levels) > 1 else 1.5 * THROWN_SIGMA, WRONG["bounce"])


def foot_offset(lowest: np.ndarray, front: np.ndarray, pixels: np.ndarray, offsets: np.ndarray, sigma: np.ndarray) -> float:
    """By how much, in ln, the lowest pixels of a mover are farther than its upright card in one frame.

    They lie on its rim, where a round body is farther than its front; its points correct that.

    Args:
        lowest: [n, 2] int (column, row).
        front: ``roundness`` [H, W] of its mask.
        pixels: [N, 2] of points that stand out of card and front by offsets [N], with standard deviation sigma [N].
    """
    rim = float(np.median(front[lowest[:, 1], lowest[:, 0]]))
    reach = max(6.0, FOOT * float(np.sqrt((front != 0).sum())))
    near = np.exp(-0.5 * ((pixels - lowest.mean(0) - 0.5) ** 2).sum(1) / reach**2)
    if near.sum() <= 1:
        return rim
    weight = near / (sigma**2 + 0.01**2)
    return rim + float((weight * offsets).sum() / weight.sum())


def bounce_cue(bounds: np.ndarray) -> Cue | None:
    """That a mover touched the ground for moments: its bounds [T] have sharp minima, where it bounced.

    Between bounces what is thrown falls towards the ground ever faster, so the bounds are concave there. What swings or flies
    past has a smooth minimum.
    """
    n, levels = BOUNCE_SPAN, []
    curved = np.full(len(bounds), np.nan)
    curved[n:-n] = bounds[2 * n :] - 2 * bounds[n:-n] + bounds[: -2 * n]
    known = curved[np.isfinite(curved)]
    if len(known) < FEWEST_BOUNDS:
        return None
    least = max(BOUNCE, BOUNCE_NOISE * 1.5 * float(np.median(np.abs(known - np.median(known)))))
    for k in range(2 * n, len(bounds) - 2 * n):
        around = curved[max(k - BOUNCE_WIDTH, 0) : k + BOUNCE_WIDTH + 1]
        if not (np.isfinite(curved[k - n : k + n + 1]).all() and curved[k] >= least and curved[k] >= np.nanmax(around)):
            continue
        beyond = np.array([curved[j] for j in (k - BOUNCE_WIDTH, k + BOUNCE_WIDTH) if 0 <= j < len(curved)])
        if np.isfinite(beyond).any() and np.nanmax(beyond) <= BOUNCE_ELSEWHERE * curved[k]:
            # It touched between two frames: where the lines through both flanks meet.
            left, right = bounds[k - 1] - bounds[k - 2], bounds[k + 2] - bounds[k + 1]
            if left < 0 < right:
                meet = np.clip((bounds[k + 1] - right - bounds[k - 1] - left) / (left - right), -1, 1)
                level = min(bounds[k - 1] + left * (meet + 1), float(bounds[k - 1 : k + 2].min()))
                levels.append(max(level, float(bounds[k - 1 : k + 2].min()) - 0.05))
    if not levels:
        return None
    middle, spread = float(np.median(levels)), float(np.ptp(levels))
    if spread > FLAT:
        return None  # It is the same ground each time.
    few = len(levels) == 1
    return Cue(middle, float(np.hypot(0.05 if few else FLOOR["bounce"], 0.5 * spread)), 0.2 if few else WRONG["bounce"])


def solve_mover(
    number: int, positions: np.ndarray, inside: np.ndarray, middles: np.ndarray, bounds: Sequence[Bound | None],
    cameras: Sequence[Camera], ground: Ground | None, log_cards: np.ndarray, normal: np.ndarray,
    front: Callable[[int], np.ndarray], pictures: MoverPictures | None = None,
) -> Mover:  # fmt: skip
    """One mover.

    Args:
        positions: [N, T, 2] pixels of its tracks over the training frames, where ``inside`` [N, T].
        middles: [T, 2] its middle pixels, NaN where it is not seen.
        bounds: [T] where it would touch the ground.
        cameras: [T].
        log_cards: [T] logarithm of the depth of its card, NaN where it is not seen: a guess, and a course where its motion is not
            believed.
        normal: [3] up.
        front: gives the ``roundness`` [H, W] of its mask in training frame k.
        pictures: to match its points anew in; None: tracks are all there is.
    """
    K = cameras[0].K
    seen = np.isfinite(log_cards) & np.isfinite(middles).all(1)
    on_ground = np.array([np.nan if bound is None else bound.log_depth for bound in bounds])
    visible = np.array([bound is not None and bound.visible for bound in bounds])
    motion, motions = rigid_motions(positions, inside, K)
    course = np.where(seen, log_cards - np.mean(log_cards[seen]), np.nan)
    points, cues, path, bends = ReliefPoints.none(), {}, None, True

    placed = None if motion is None else course_of(motion, positions, inside, K, middles, cameras, normal)
    again = rematched(motion, positions, inside, pictures) if motion is not None and pictures is not None else None
    if placed is not None and again is not None:
        refined, matched, counts = again
        every, used = np.concatenate([matched, positions]), np.concatenate([counts, inside])
        surer = course_of(refined, every, used, K, middles, cameras, normal)
        # Two solutions that differ by more than two halves of the tracks may are not of one body.
        if surer is not None and float(np.std((surer[0] - placed[0])[seen])) <= SPLIT_HALF:
            # Points that were chosen because they match say nothing of how much of it bends.
            motion, placed = refined, (surer[0], surer[1], placed[2])
    if placed is not None and float(np.nanstd(placed[0] - course)) > CONTRADICTED:
        by_growth, by_motion = (unevenness(on_ground - each, visible, int(seen.sum())) for each in (course, placed[0]))
        if by_growth <= FLAT < by_motion:
            placed = None
    if placed is not None and motion is not None:
        course, points, share = placed
        course = np.where(seen, course, np.nan)
        try:
            path = WorldPath.of(motion, cameras)
            cues = accepted_laws(path, ground.normal if ground else None)[0]
        except np.linalg.LinAlgError:
            cues, path = {}, None  # Poses that the tracks hardly tell have no covariance: then no law does either.
        bends = share < RIGID_SHARE
        if bends:
            points = ReliefPoints.none()  # Limbs of it are placed wrongly.
    else:
        # A motion that explains only part of what bends may still tell its course: if by it the feet keep to the ground.
        motion = None
        for weak in motions if unevenness(on_ground - course, visible, int(seen.sum())) > FLAT else []:
            placed = course_of(weak, positions, inside, K, middles, cameras, normal)
            if placed is not None and unevenness(on_ground - placed[0], visible, int(seen.sum())) <= FLAT:
                course = np.where(seen, placed[0], np.nan)
                break
    at_ground = on_ground - course

    def at_foot(touched: np.ndarray, thrown: Sequence[int] | np.ndarray) -> np.ndarray:
        """The bounds [T] of its lowest pixels in the frames about those in which it was thrown up."""
        result = touched.copy()
        for k in {int(j) for i in thrown for j in (i - 1, i, i + 1) if 0 <= j < len(touched) and np.isfinite(touched[j])}:
            bound, here = bounds[k], points.frame_of == k
            assert bound is not None  # where it touches is finite only there
            before, pixels = front(k), points.pixels[here]
            column, row = np.clip(pixels.astype(int), 0, [before.shape[1] - 1, before.shape[0] - 1]).T
            card = course[k] + np.log(upright_ratio(cameras[k], normal, middles[k], pixels)) + before[row, column]
            result[k] -= foot_offset(bound.lowest, before, pixels, points.log_depth[here] - card, points.sigma[here])
        return result

    stands = contact_cue(at_ground, visible, int(seen.sum()))
    touched = np.where(visible, at_ground, np.nan)
    bounces = None
    if stands is None:
        thrown = np.zeros(0, int)
        if path is not None and ground is not None:
            thrown = bounce_frames(path, ground.normal, float(np.exp(np.median((log_cards - course)[seen]))))
        bounces = thrown_cue(at_foot(touched, thrown), thrown) or bounce_cue(touched)
        if bounces is not None and len(thrown) == 0:
            lowest = int(np.nanargmin(touched))
            bounces = replace(bounces, log_scale=bounces.log_scale + float((at_foot(touched, [lowest]) - touched)[lowest]))
    # Ground that is only supposed may drop: it says less, and bounds nothing.
    seen_ground = np.array([bound is not None and bound.seen for bound in bounds])
    supposed = float(seen_ground[np.isfinite(at_ground)].mean()) < 0.5 if np.isfinite(at_ground).any() else False
    known, far = at_ground[np.isfinite(at_ground) & seen_ground], []
    if supposed:
        stands, bounces = (None if cue is None else unsurer(cue) for cue in (stands, bounces))
    # Where it touches is what bounds it; else no frame may put it below the ground.
    if stands is not None and motion is None:
        course = course + settled(at_ground - stands.log_scale, visible)
    if stands is not None:
        cues = {**cues, "contact": stands}
    elif bounces is not None:
        cues = {**cues, "bounce": bounces}
    elif len(known) >= FEWEST_BOUNDS:
        far = [float(np.percentile(known, BOUND_PERCENTILE)) + BOUND_SLACK]
    near_ground = float(np.percentile(known, GUESS_PERCENTILE)) - ABOVE_GROUND if len(known) >= FEWEST_BOUNDS else None
    # Laws of motion and contact rest on the same course, so their errors are not independent: only the surest speaks.
    if len(cues) > 1:
        surest = min(cues, key=lambda name: cues[name].sigma)
        cues = {surest: cues[surest]}
    # What hides behind a mover that touches the ground says nothing that its feet do not say better.
    touches = [cue for cue in (stands, bounces) if cue is not None and cue in cues.values()]
    guess = touches[0].log_scale if touches else float(np.median((log_cards - course)[seen]))
    distance = combine(guess, cues, far, None if touches else near_ground)
    moved = replace(points, log_depth=points.log_depth + distance.log_scale)
    expected = DEEPEST * motion.size if motion is not None else 0.0
    return Mover(
        number, course + distance.log_scale, middles, distance.sigma, not bends, cues, moved, expected
    )  # fmt: skip


def course_of(
    motion: RigidMotion, positions: np.ndarray, inside: np.ndarray, K: np.ndarray, middles: np.ndarray, cameras: Sequence[Camera],
    normal: np.ndarray,
) -> tuple[np.ndarray, ReliefPoints, float] | None:  # fmt: skip
    """[T] logarithm of the depth of a mover's middle by a motion of its own, but for its distance; its points; ``place_points``'s
    share. None where it tells of no frame."""
    points, share = place_points(motion, Observations.of_tracks(positions, inside, K), K)
    found = middle_depths(points, middles, cameras, normal)
    known = np.isfinite(found)
    if not known.any():
        return None
    return np.interp(np.arange(len(cameras)), np.flatnonzero(known), found[known]), points, share


def middle_depths(points: ReliefPoints, middles: np.ndarray, cameras: Sequence[Camera], normal: np.ndarray) -> np.ndarray:
    """[T] logarithm of the depth of a mover's middle: of an upright card through its points; NaN of fewer than three."""
    result = np.full(len(cameras), np.nan)
    for t in range(len(cameras)):
        here = points.frame_of == t
        if here.sum() >= 3 and np.isfinite(middles[t]).all():
            card = np.log(upright_ratio(cameras[t], normal, middles[t], points.pixels[here]))
            result[t] = np.median(points.log_depth[here] - card)
    return result
