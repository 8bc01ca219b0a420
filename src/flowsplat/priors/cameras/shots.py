"""Shots of a clip that is no scene yet: where it is cut, fades, or cross-fades, found over all its frames at a small size.

Frames are torn by the rule of the camera stage (``pieces.are_torn``). That stage sees the chosen frames, between which a fast pan
may be as wide as the image; here all frames are there, so that a cut is sudden and a pan is not. Of 90 pairs of frames of ten clips
(DAVIS and rendered) that show different places at most .01 of the points are found again, of neighbors in those clips at least .71.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from flowsplat.common.progress import track
from flowsplat.common.spread import spread
from flowsplat.priors.cameras.following import PATCH_SIDE, coarse_flow
from flowsplat.priors.cameras.pieces import FEW_SURVIVORS, MIN_SURVIVORS, are_torn
from flowsplat.priors.tracks import corner_strength, new_points, refine_points
from flowsplat.scenes.repeats import MIN_STEP, find_fades, measure_changes

COMPARED_POINTS = 400
"""About how many points of a frame are looked for in another. Chosen by eye."""
COMPARED_STEP = 6
"""Frames between two that are compared first: only where they are torn are those between them looked at. Chosen by eye."""
MIN_SHOT_FRAMES = 10
"""Frames of the input below which a shot is no scene."""
MIN_CALM_SURVIVORS, CALM_PAIRS = 0.5, 3
"""Share of points that neighbors share on both sides of a cut, and how many neighbors: in a blurred pan they do not. Of ten clips
the least is .71."""
FLASH_SECONDS = 0.125
"""Seconds of what lies between two shots and belongs to none: a flash, a blended frame. Longer is a pan, or a shot. Chosen by
eye."""
CROSS_FADE_SECONDS, CROSS_FADE_FRAMES = 1.0, (12, 60)
"""Seconds of a cross-fade at most, and the bounds of that in frames."""
MAX_CROSS_FADE_MOTION = 0.1
"""Motion during a cross-fade, relative to the longer side: where points move farther that may be why they are gone. Of cross-fades
of 8 and 12 frames between ten clips 15 of 16 are below .07; where a pan or a turn loses all points within 12 frames it is .12 and
more."""


Kind = Literal["cut", "fade", "cross-fade", "unclear"]


@dataclass(frozen=True)
class Transition:
    """Where one shot ends and another begins, by the numbers of frames.

    Attributes:
        last: frame of the one.
        first: frame of the other. What lies between belongs to none.
        kind: ``unclear``: nothing tells whether it is a transition, so both are one shot.
    """

    last: int
    first: int
    kind: Kind


@dataclass(frozen=True)
class Piece:
    """Frames ``first`` to ``last``, both included, between transitions; ``left_out``: why it is no scene, None where it is."""

    first: int
    last: int
    left_out: str | None


@dataclass(frozen=True)
class _Followed:
    """Points of one frame that were looked for in another.

    Attributes:
        share: of those that were found.
        is_torn: whether the frames show different places.
        motion: median distance in pixels; infinite where none was found.
    """

    share: float
    is_torn: bool
    motion: float


class _Frames:
    """Gray frames [h, w] uint8, any two of which can be compared."""

    def __init__(self, images: Sequence[np.ndarray]):
        self._images = images
        self._known: dict[tuple[int, int], _Followed] = {}

    def __len__(self) -> int:
        return len(self._images)

    @property
    def long_side(self) -> int:
        return max(self._images[0].shape)

    def follow(self, a: int, b: int) -> _Followed:
        if (a, b) not in self._known:
            self._known[a, b] = _follow(self._images[a], self._images[b])
        return self._known[a, b]

    def are_torn(self, a: int, b: int) -> bool:
        return self.follow(a, b).is_torn

    def measure_motion(self, first: int, last: int) -> float:
        """Return pixels that points move from frame to frame, all in all; infinite where too few can be followed."""
        steps = [self.follow(k, k + 1) for k in range(first, last)]
        return sum(each.motion if each.share >= MIN_SURVIVORS else np.inf for each in steps)

    def are_calm(self, first: int, last: int) -> bool:
        """Return whether all neighbors between two frames share many points; so far as there are frames."""
        pairs = range(max(first, 0), min(last, len(self) - 1))
        return all(self.follow(k, k + 1).share >= MIN_CALM_SURVIVORS for k in pairs)


def _follow(a: np.ndarray, b: np.ndarray) -> _Followed:
    spacing = max(4, round((a.size / COMPARED_POINTS) ** 0.5))
    points = new_points(corner_strength(a), np.zeros((0, 2), np.float32), spacing)
    found, ok = refine_points(a, b, points, points + coarse_flow(a, b, points), PATCH_SIDE)
    motion = float(np.median(np.linalg.norm(found[ok] - points[ok], axis=1))) if ok.any() else np.inf
    return _Followed(float(ok.mean()) if len(ok) else 0.0, are_torn(points[ok], found[ok], len(points)), motion)


def find_transitions(images: Sequence[np.ndarray], seconds: np.ndarray) -> list[Transition]:
    """Return where shots end, in order.

    Args:
        images: [N] gray [h, w] uint8 of one size, as ``repeats.look_size`` has it.
        seconds: [N] rising, when they are shown.
    """
    contrasts = np.array([image.std() for image in images])
    shown = np.flatnonzero(~find_fades(contrasts, seconds))
    if len(shown) < 2:
        return []
    frames = _Frames([images[i] for i in shown.tolist()])
    rate = 1 / float(np.median(np.diff(seconds)))
    flash = max(1, round(FLASH_SECONDS * rate))
    clusters = _cluster(_find_torn(frames, shown), flash)
    found: list[tuple[int, int, Kind]] = []
    for a, b in clusters:
        if not frames.are_torn(a, b):  # a flash, or something that passed: it goes on as before
            continue
        is_sudden = b - a - 1 <= flash
        is_blended = not any(frames.are_torn(k, k + 1) for k in range(a, b))
        if is_blended:
            # What moves that far in a frame or two may be gone for that.
            is_sudden &= frames.measure_motion(a, b) < MAX_CROSS_FADE_MOTION * frames.long_side
            # By how many frames is not known.
            a, b = max(a - flash, 0), min(b + flash, len(frames) - 1)
        is_calm = frames.are_calm(a - CALM_PAIRS, a) and frames.are_calm(b, b + CALM_PAIRS)
        is_faded = shown[b] - shown[a] > b - a
        clear: Kind = "fade" if is_faded else "cross-fade" if is_blended else "cut"
        found.append((a, b, clear if is_sudden and is_calm else "unclear"))
    length = int(np.clip(round(CROSS_FADE_SECONDS * rate), *CROSS_FADE_FRAMES))
    found += [(a, b, "cross-fade") for a, b in _find_cross_fades(frames, clusters, length)]
    return [Transition(int(shown[a]), int(shown[b]), kind) for a, b, kind in sorted(found)]


def _find_torn(frames: _Frames, shown: np.ndarray) -> list[tuple[int, int]]:
    """Return pairs of frames, next to each other or with one between them, that show different places."""
    torn = {(k, k + 1) for k in np.flatnonzero(np.diff(shown) > 1).tolist() if frames.are_torn(k, k + 1)}
    for a in track(range(0, len(frames) - 1, COMPARED_STEP), "Looking for cuts"):
        b = min(a + COMPARED_STEP + 2, len(frames) - 1)  # a blended frame is not the last of all in which it is
        if not frames.are_torn(a, b):
            continue
        pairs = [(k, k + 1) for k in range(a, b) if frames.are_torn(k, k + 1)]
        # A change of the frame rate blends the last frame of a shot and the first of the next.
        torn |= set(pairs or [(k, k + 2) for k in range(max(a - 1, 0), min(b, len(frames) - 2)) if frames.are_torn(k, k + 2)])
    return sorted(torn)


def _cluster(pairs: Sequence[tuple[int, int]], near: int) -> list[tuple[int, int]]:
    """Return the spans of pairs with at most ``near`` frames between them."""
    spans: list[tuple[int, int]] = []
    for a, b in pairs:
        if spans and a - spans[-1][1] < near:
            spans[-1] = spans[-1][0], max(b, spans[-1][1])
        else:
            spans.append((a, b))
    return spans


def _find_cross_fades(frames: _Frames, clusters: Sequence[tuple[int, int]], length: int) -> list[tuple[int, int]]:
    """Return spans of at most ``length`` frames in which one image turned into another although hardly anything moved."""
    spans = []
    for a in range(0, len(frames) - length, COMPARED_STEP):
        b = a + length
        if any(a < end and start < b for start, end in clusters):
            continue
        followed = frames.follow(a, b)
        if followed.share < MIN_SURVIVORS and followed.is_torn and _is_settled(frames, a, b):
            spans.append((a, b))
    found = []
    for group in _group_overlapping(spans):
        start, end = max(a for a, _ in group), min(b for _, b in group)
        if start < end:  # else there is no moment at which it changes, but a long time in which nothing can be followed
            found.append(_narrow(frames, start, end, length))
    return found


def _narrow(frames: _Frames, start: int, end: int, longest: int) -> tuple[int, int]:
    """Return the frames before and after a cross-fade whose middle lies between ``start`` and ``end``.

    Half mixed with the other, a shot can still be followed, so the shortest step across which it cannot is half of the whole.
    """
    last = len(frames) - 1
    for length in (2, 4, *range(8, longest, 4)):
        begins = range(max(start - length, 0), min(end, last - length) + 1, max(1, length // 4))
        torn = [a for a in begins if frames.follow(a, a + length).share < MIN_SURVIVORS]
        if torn:
            middle = (torn[0] + torn[-1] + length) // 2
            half = length + length // 4 + 2
            return max(middle - half, 0), min(middle + half, last)
    return max(end - longest, 0), min(start + longest, last)


def _is_settled(frames: _Frames, a: int, b: int) -> bool:
    """Return whether hardly anything moves between two frames, and points can be followed before and after."""
    around = [(a - COMPARED_STEP, a), (b, b + COMPARED_STEP)]
    if any(frames.follow(i, j).share < FEW_SURVIVORS for i, j in around if i >= 0 and j < len(frames)):
        return False
    motion = 0.0
    for start in range(a, b, COMPARED_STEP):
        end = min(start + COMPARED_STEP, b)
        across = frames.follow(start, end)
        # A pan loses points from one step to the next, not from one frame to the next.
        steps = [across] if across.share >= FEW_SURVIVORS else [frames.follow(k, k + 1) for k in range(start, end)]
        motion += sum(each.motion if each.share >= FEW_SURVIVORS else np.inf for each in steps)
    return motion < MAX_CROSS_FADE_MOTION * frames.long_side


def _group_overlapping(spans: Sequence[tuple[int, int]]) -> list[list[tuple[int, int]]]:
    groups: list[list[tuple[int, int]]] = []
    for span in spans:
        if groups and span[0] < groups[-1][-1][1]:
            groups[-1].append(span)
        else:
            groups.append([span])
    return groups


def find_pieces(images: Sequence[np.ndarray], seconds: np.ndarray, transitions: Sequence[Transition]) -> list[Piece]:
    """Return what lies between transitions that are clear, and which of it is no scene: too short, or a still image.

    Args:
        images: as ``find_transitions`` has them; ``seconds`` alike.
    """
    shown = np.flatnonzero(~find_fades(np.array([image.std() for image in images]), seconds))
    clear = [each for each in transitions if each.kind != "unclear"]
    starts = [int(shown[0]), *(each.first for each in clear)]
    ends = [*(each.last for each in clear), int(shown[-1])]
    return [Piece(a, b, _why_left_out(images[a : b + 1])) for a, b in zip(starts, ends, strict=True) if a <= b]


def _why_left_out(images: Sequence[np.ndarray]) -> str | None:
    if len(images) < MIN_SHOT_FRAMES:
        return f"it has fewer than {MIN_SHOT_FRAMES} frames"
    # From the first, not from the one before, which a slow motion hardly changes.
    changes = [measure_changes([images[0], images[k]], 2).steps[1] for k in spread(len(images), 24)]
    return "it is a still image, as a title" if max(changes) < MIN_STEP else None
