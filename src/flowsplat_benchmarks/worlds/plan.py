"""Plan what a random world is about: its ground, its camera and the kinds of its objects, from the seed alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowsplat.scenes.synthetic.worlds.cameras import CameraKind
from flowsplat.scenes.synthetic.worlds.ground import GroundKind
from flowsplat.scenes.synthetic.worlds.parts import KINDS, Kind
from flowsplat_benchmarks.worlds.cameras import CAMERAS

GROUNDS: tuple[GroundKind, ...] = ("flat", "slope", "steps", "none")

PAIRS = ("crossing", "touching")
"""Pairs of objects, as frequent as single ones of each kind where a world has two or more."""

CROSSING: tuple[Kind, ...] = ("walker", "carrier", "vehicle", "rolling")
CROWD: tuple[Kind, ...] = ("walker", "walker", "walker", "carrier", "vehicle", "animal")
"""What a crowd is drawn from: half of it walks with free hands, as on a street."""
CROWD_SIZES = (3, 6)
"""From how many to less than how many objects a crowd has. Chosen by eye."""
TOUCHING: tuple[tuple[Kind, Kind], ...] = (("walker", "walker"), ("walker", "vehicle"), ("rolling", "rolling"))


@dataclass(frozen=True)
class WorldPlan:
    """What a world is about.

    Attributes:
        ground: what is seen of the ground.
        camera: how the camera moves.
        kinds: of the objects, in order.
        pair: ``crossing`` or ``touching`` where the first two objects are such a pair.
        raised: where no ground is in sight: whether it lies above the eye, or below the image.
        crowd: whether objects pass one another at several depths, in plain clothes and with contact shadows.
    """

    ground: GroundKind
    camera: CameraKind
    kinds: tuple[Kind, ...]
    pair: str | None
    raised: bool
    crowd: bool = False


def draw_plan(seed: int, dancers: bool = False, crowd: bool = False) -> WorldPlan:
    """Return what the world of a seed is about.

    Args:
        dancers: one or two of them, instead of all other objects, and no steps.
        crowd: three to five of ``CROWD``, instead of all other objects, on a ground in sight without steps.
    """
    block, place = divmod(seed, len(GROUNDS) * len(CAMERAS))
    order = np.random.default_rng([block, 1]).permutation(len(GROUNDS) * len(CAMERAS))
    ground, camera = divmod(int(order[place]), len(CAMERAS))
    rng = np.random.default_rng([seed, 0])
    count = int(rng.integers(1, 5))
    kinds: list[Kind] = []
    pair: str | None = None
    while len(kinds) < count:
        # A pair comes first, and only where there is room for it.
        chosen = int(rng.integers(len(KINDS) + (len(PAIRS) if not kinds and count > 1 else 0)))
        if chosen < len(KINDS):
            kinds.append(KINDS[chosen])
            continue
        pair = PAIRS[chosen - len(KINDS)]
        if pair == "crossing":
            kinds = [CROSSING[k] for k in rng.integers(0, len(CROSSING), 2)]
        else:
            kinds = list(TOUCHING[int(rng.integers(len(TOUCHING)))])
    raised = bool(rng.random() < 0.5) or bool({"rolling", "bouncing"} & set(kinds))
    if crowd:
        kinds = [CROWD[k] for k in rng.integers(0, len(CROWD), int(rng.integers(*CROWD_SIZES)))]
        seen: GroundKind = "slope" if GROUNDS[ground] in ("slope", "steps") else "flat"
        return WorldPlan(seen, CAMERAS[camera], tuple(kinds), None, raised, crowd=True)
    if dancers:
        level: GroundKind = "flat" if GROUNDS[ground] == "steps" else GROUNDS[ground]
        danced: list[Kind] = ["dancer"] * min(count, 2)
        return WorldPlan(level, CAMERAS[camera], tuple(danced), None, raised)
    return WorldPlan(GROUNDS[ground], CAMERAS[camera], tuple(kinds), pair, raised)
