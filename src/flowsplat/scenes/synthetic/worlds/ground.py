"""The ground of random worlds: flat, sloped, or with steps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from flowsplat.scenes.synthetic.worlds.parts import UP, Placed, box, frame

GroundKind = Literal["flat", "slope", "steps", "none"]
"""``none``: there is one, but it is not in sight."""

HALF_WIDTH, BOX_HALF_HEIGHT = 60.0, 1.5
"""Meters to either side, and half the height of its boxes. Chosen by eye."""

ROOM_FOR_FOOT = 0.2
"""Meters that a foot keeps from the edge of a step. Chosen by eye."""


@dataclass(frozen=True)
class WorldGround:
    """A plane z = gradient . (x, y), or steps along a direction.

    Attributes:
        kind: what is seen of it.
        gradient: [2] of the plane.
        direction: [2] unit vector in which steps rise.
        tread: meters from step to step.
        rise: meters by which each step is higher.
        first: place of the first edge along ``direction``.
        count: how many steps.
        front: y before which there is no ground at all.
    """

    kind: GroundKind
    gradient: np.ndarray
    direction: np.ndarray
    tread: float = 1.0
    rise: float = 0.0
    first: float = 0.0
    count: int = 0
    front: float = -HALF_WIDTH

    @property
    def normal(self) -> np.ndarray:
        """[3] unit normal of the treads, or of the plane."""
        normal = np.array([-self.gradient[0], -self.gradient[1], 1.0])
        return normal / np.linalg.norm(normal)

    @property
    def boxes(self) -> int:
        """Of how many parts it consists."""
        return self.count + 1

    def step(self, places: np.ndarray) -> np.ndarray:
        """Return [...] number of the step at places [..., 2]."""
        along = places @ self.direction - self.first
        return np.clip(np.floor(along / self.tread) + 1, 0, self.count)

    def height(self, places: np.ndarray) -> np.ndarray:
        """Return [...] meters at places [..., 2]."""
        return places @ self.gradient + self.rise * self.step(places)

    def off_edges(self, places: np.ndarray, distance: float = ROOM_FOR_FOOT) -> np.ndarray:
        """Places [..., 2] moved along ``direction`` so that none is near an edge."""
        if self.count == 0:
            return places
        along, number = places @ self.direction, self.step(places)
        low = np.where(number > 0, self.first + (number - 1) * self.tread + distance, -np.inf)
        high = np.where(number < self.count, self.first + number * self.tread - distance, np.inf)
        return places + (np.clip(along, low, high) - along)[..., None] * self.direction

    def middle_of_tread(self, place: np.ndarray, half: float) -> np.ndarray:
        """Place [2] moved to where ``half`` meters to both sides along ``direction`` have one height, as far as treads allow."""
        return self.off_edges(place, min(half, 0.499 * self.tread))

    def tangent(self, heading: np.ndarray) -> np.ndarray:
        """Return [..., 3] the way on the plane that has (cos, sin) of ``heading`` [...] in x and y; not of unit length."""
        flat = np.stack([np.cos(heading), np.sin(heading)], -1)
        return np.concatenate([flat, (flat @ self.gradient)[..., None]], -1)

    def parts(self, material: np.ndarray) -> list[Placed]:
        """Its boxes."""
        if self.count == 0:
            turn = frame(self.tangent(np.array(0.0)), self.normal)[0]
            half, middle = np.array([HALF_WIDTH, HALF_WIDTH, BOX_HALF_HEIGHT]), np.zeros(3)
            if self.front > -HALF_WIDTH:
                half, middle = np.array([HALF_WIDTH, HALF_WIDTH, 10.0]), np.array([0.0, self.front + HALF_WIDTH, 0.0])
            return [Placed(box(half, material), turn, middle - half[2] * self.normal)]
        turn = frame(np.append(self.direction, 0.0), UP)[0]
        placed = []
        for k in range(self.count + 1):
            start = self.first + (k - 1) * self.tread if k else -HALF_WIDTH
            end = self.first + k * self.tread if k < self.count else HALF_WIDTH
            center = np.append(0.5 * (start + end) * self.direction, k * self.rise - BOX_HALF_HEIGHT)
            placed.append(Placed(box([0.5 * (end - start), HALF_WIDTH, BOX_HALF_HEIGHT], material), turn, center))
        return placed
