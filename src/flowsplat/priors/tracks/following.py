"""Points that are followed from frame to frame by their own texture, and by what their neighbors do.

A point is expected where its velocity, or else the flow, leads; the patch of its first frame is aligned there. One that moves
unlike its neighbors, or no longer looks like itself, goes with its neighbors, unseen, until it is found again. So a point
survives short occlusions and wrong flow, and does not drift: it is its first patch that has to be there, or a later one that
was taken while that was so.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowsplat.geometry.interpolation import sample_map
from flowsplat.priors.tracks.agreement import compute_agreed_motion
from flowsplat.priors.tracks.patches import Patches, align
from flowsplat.scenes import Flow
from flowsplat.scenes.layers import TRUSTED_CONFIDENCE

MIN_SIMILARITY = 0.6
"""Likeness (structural similarity) to its patch from which a point counts as found. Chosen by eye."""
SIMILARITY_PENALTY = 0.1
"""Of likeness for every pixel from where the neighbors lead, and for every pixel by which they disagree. Chosen by eye."""
RENEW_SIMILARITY = 0.75
"""Likeness below which a patch is taken anew. Chosen by eye."""
MIN_RENEW_SIMILARITY = 0.6
"""Likeness to the patch before it from which a faded one is taken anew. Chosen by eye."""
MAX_RENEW_SLIP = 0.2
"""Pixels that a point may slip then, beside half of what speaks against it. Chosen by eye."""
MIN_SEEN_SIMILARITY, MAX_SEEN_SLIP = 0.55, 1.0
"""Likeness less penalties from which, and pixels of slipping up to which, a point that was found counts as seen. Chosen by eye."""
FLOW_ADVANTAGE = 0.15
"""Likeness by which the place that the flow leads to must beat the one that the velocity leads to. Chosen by eye."""
CLEAR_SIMILARITY = 0.85
"""Likeness from which the flow is not asked at all. Chosen by eye."""
MAX_NEIGHBOR_DIFFERENCE = 1.0
"""Pixels from its neighbors' motion, beside twice their spread, from which a point is taken back to them. Chosen by eye."""
MAX_GAP = 12
"""Frames after which a point that was not seen is given up. Chosen by eye."""
NEIGHBOR_REACH, MIN_NEIGHBOR_REACH = 0.07, 32.0
"""Share of the image's diagonal, and pixels at least, within which neighbors are asked. Chosen by eye."""
MIN_VELOCITY_FRAMES = 2
"""Frames from which a point has a velocity. Chosen by eye."""
OUTSIDE_PIXELS = 20
"""Pixels that an unseen point may be outside the image. Chosen by eye."""


@dataclass
class _Living:
    """The points that are followed; arrays [N, ...]. Places count pixels from 0 at the center of the first one."""

    ids: np.ndarray
    places: np.ndarray
    moves: np.ndarray  # since the frame before
    shapes: np.ndarray
    older_shapes: np.ndarray  # from the older patch to the present one
    ages: np.ndarray
    missed: np.ndarray  # frames since it was seen
    labels: np.ndarray
    trust: np.ndarray
    drift: np.ndarray  # pixels that it may have slipped when patches were taken anew

    def select(self, rows: np.ndarray) -> None:
        """Keep only these."""
        for name, array in vars(self).items():
            setattr(self, name, array[rows])

    def add(self, **fresh: np.ndarray) -> None:
        """Append points."""
        for name, array in vars(self).items():
            setattr(self, name, np.concatenate([array, fresh[name].astype(array.dtype)]))


class Follower:
    """Follows points through images that are given one after the other. Points are pixels with centers at +0.5."""

    def __init__(self) -> None:
        zero, pair = np.zeros(0, np.float32), np.zeros((0, 2), np.float32)
        count, turn = np.zeros(0, np.int64), np.zeros((0, 2, 2), np.float32)
        self._living = _Living(count, pair, pair, turn, turn, count, count, count, zero, zero)
        self._patches: Patches | None = None
        self._older: Patches | None = None  # those that were there before they were taken anew

    @property
    def ids(self) -> np.ndarray:
        """[N] what the points were called when they were added, the oldest first."""
        return self._living.ids

    @property
    def points(self) -> np.ndarray:
        """[N, 2] float32."""
        return self._living.places + np.float32(0.5)

    @property
    def seen(self) -> np.ndarray:
        """[N] bool: whether each was found in the last image; the others are only supposed to be there."""
        living = self._living
        return (living.missed == 0) & (living.trust >= MIN_SEEN_SIMILARITY) & (living.drift <= MAX_SEEN_SLIP)

    @property
    def confidence(self) -> np.ndarray:
        """[N] between one half and 1 where seen, else 0."""
        return np.where(
            self.seen, 0.5 + 0.5 * np.clip((self._living.trust - MIN_SEEN_SIMILARITY) / (1 - MIN_SEEN_SIMILARITY), 0, 1), 0
        ).astype(np.float32)

    def keep(self, rows: np.ndarray) -> None:
        """Give up all points but these."""
        self._living.select(rows)
        self._patches = None if self._patches is None else self._patches[rows]
        self._older = None if self._older is None else self._older[rows]

    def add(self, ids: np.ndarray, points: np.ndarray, image: np.ndarray, labels: np.ndarray) -> None:
        """Follow more points [N, 2], from gray ``image`` [H, W] on; ``labels`` [H, W] tells objects apart."""
        count, (height, width) = len(points), image.shape
        if count == 0:
            return
        places = points.astype(np.float32) - np.float32(0.5)
        column, row = np.clip(np.rint(places).astype(int), 0, [width - 1, height - 1]).T
        none, upright = np.zeros(count), np.tile(np.eye(2), (count, 1, 1))
        self._living.add(
            ids=ids, places=places, moves=np.zeros((count, 2)), shapes=upright, older_shapes=upright,
            ages=none, missed=none, labels=labels[row, column], trust=none + 1, drift=none,
        )  # fmt: skip
        cut = Patches.cut(image.astype(np.float32), labels, places)
        self._patches = cut if self._patches is None else self._patches.join(cut)
        self._older = cut if self._older is None else self._older.join(cut)

    def step(self, image: np.ndarray, labels: np.ndarray, flow: Flow, pace: float = 1.0) -> None:
        """Go to the next image.

        Args:
            image: [H, W] gray.
            labels: [H, W] of its objects.
            flow: from the image before.
            pace: how long this step takes, relative to the one before.
        """
        if self._patches is None or len(self.ids) == 0:
            return
        living, pixels = self._living, image.astype(np.float32)
        reach = max(MIN_NEIGHBOR_REACH, NEIGHBOR_REACH * float(np.hypot(*image.shape)))
        places, shapes, likeness, led = self._first_guess(pixels, flow, pace, reach)
        elders = living.ages >= MIN_VELOCITY_FRAMES
        believed = (likeness >= MIN_SIMILARITY) & (elders | (led >= TRUSTED_CONFIDENCE))
        weight = (
            np.clip(living.ages, 0.25, 4) * (likeness - MIN_SIMILARITY + 0.05) * np.where(living.missed == 0, 1, 0.3) * believed
        )
        motion, gradient, spread = compute_agreed_motion(living.places, places - living.places, weight, living.labels, reach)
        asked = np.isfinite(spread)
        away = np.where(asked, np.linalg.norm(places - living.places - motion, axis=1), 0)
        spread = np.where(asked, np.minimum(spread, 5), 0)
        stray = np.flatnonzero(asked & ((away > MAX_NEIGHBOR_DIFFERENCE + 2 * spread) | (likeness < MIN_SIMILARITY)))
        expected = living.places[stray] + motion[stray]
        turned = ((np.eye(2, dtype=np.float32) + gradient[stray]) @ living.shapes[stray]).astype(np.float32)
        found, shape, like = align(self._patches[stray], pixels, expected, turned)
        off = np.linalg.norm(found - expected, axis=1)
        back = (like >= MIN_SIMILARITY) & (off <= MAX_NEIGHBOR_DIFFERENCE + 2 * spread[stray])
        places[stray] = np.where(back[:, None], found, expected)
        shapes[stray] = np.where(back[:, None, None], shape, turned)
        likeness[stray], away[stray] = np.where(back, like, 0), off
        alone = np.flatnonzero(~asked & elders & (likeness < MIN_SIMILARITY))
        places[alone] = living.places[alone] + living.moves[alone] * np.float32(pace)
        self._arrive(pixels, labels, places, shapes, likeness, np.minimum(away, 5) + spread, asked)

    def _first_guess(
        self, image: np.ndarray, flow: Flow, pace: float, reach: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Places, shapes and likeness where velocity or flow lead, and the confidence of the flow."""
        living = self._living
        assert self._patches is not None
        by_flow = living.places + sample_map(flow.flow, self.points)
        led = sample_map(flow.confidence, self.points)[:, 0]
        elders = living.ages >= MIN_VELOCITY_FRAMES
        moves = living.moves * np.float32(pace)
        weight = np.where(elders & (living.missed == 0), np.clip(living.trust - MIN_SIMILARITY, 0.01, 1), 0)
        motion, gradient, spread = compute_agreed_motion(living.places, moves, weight, living.labels, reach)
        expected = living.places + np.where(elders[:, None], moves, by_flow - living.places)
        # Where the flow of a young point contradicts its elders, it goes with them; and so does who was not seen.
        away = np.linalg.norm(by_flow - living.places - motion, axis=1)
        misled = ~elders & ((led < TRUSTED_CONFIDENCE) | (away > 2 + 2 * spread)) | (living.missed > 0)
        misled &= np.isfinite(spread)
        expected[misled] = (living.places + motion)[misled]
        turned = ((np.eye(2, dtype=np.float32) + gradient) @ living.shapes).astype(np.float32)
        places, shapes, likeness = align(self._patches, image, expected, turned)
        doubted = np.flatnonzero(elders & (likeness < CLEAR_SIMILARITY) & (led >= TRUSTED_CONFIDENCE))
        other, shape, like = align(self._patches[doubted], image, by_flow[doubted], turned[doubted])
        better = like > likeness[doubted] + FLOW_ADVANTAGE
        chosen = doubted[better]
        places[chosen], shapes[chosen], likeness[chosen] = other[better], shape[better], like[better]
        return places, shapes, likeness, led

    def _arrive(
        self, image: np.ndarray, labels: np.ndarray, places: np.ndarray, shapes: np.ndarray, likeness: np.ndarray,
        doubt: np.ndarray, asked: np.ndarray,
    ) -> None:  # fmt: skip
        """Note where the points are, take faded patches anew, and give up what is lost."""
        living, (height, width) = self._living, image.shape
        assert self._patches is not None
        inside = (places >= -0.5).all(1) & (places[:, 0] <= width - 0.5) & (places[:, 1] <= height - 0.5)
        upright = np.linalg.det(shapes) > 0.15
        found = (likeness >= MIN_SIMILARITY) & inside & upright
        trust = likeness - SIMILARITY_PENALTY * doubt
        living.moves, living.places, living.shapes = (places - living.places).astype(np.float32), places, shapes
        living.ages, living.missed, living.trust = living.ages + 1, np.where(found, 0, living.missed + 1), trust.astype(np.float32)
        self._renew(np.flatnonzero(found & (likeness < RENEW_SIMILARITY)), image, labels, doubt)
        near = (
            (places > -OUTSIDE_PIXELS).all(1) & (places[:, 0] < width + OUTSIDE_PIXELS) & (places[:, 1] < height + OUTSIDE_PIXELS)
        )
        self.keep(np.flatnonzero(near & (found | ((asked | (living.ages > MIN_VELOCITY_FRAMES)) & (living.missed <= MAX_GAP)))))

    def _renew(self, rows: np.ndarray, image: np.ndarray, labels: np.ndarray, doubt: np.ndarray) -> None:
        """Take faded patches anew where the ones before them are still there, too; else something else is before the point."""
        living = self._living
        assert self._patches is not None
        assert self._older is not None
        turned = (living.shapes[rows] @ living.older_shapes[rows]).astype(np.float32)
        places, _, likeness = align(self._older[rows], image, living.places[rows], turned)
        there = (likeness >= MIN_RENEW_SIMILARITY) & (
            np.linalg.norm(places - living.places[rows], axis=1) <= MAX_NEIGHBOR_DIFFERENCE + MAX_RENEW_SLIP
        )
        rows, places = rows[there], places[there]
        living.moves[rows] += places - living.places[rows]
        living.places[rows], living.older_shapes[rows] = places, living.shapes[rows]
        self._older.replace(rows, self._patches[rows])
        self._patches.replace(rows, Patches.cut(image, labels, places))
        living.shapes[rows] = np.eye(2, dtype=np.float32)
        living.drift[rows] += MAX_RENEW_SLIP + 0.5 * doubt[rows]
