"""The weights by which an object that comes back is known again, fitted where the truth is known, and how often joins are right.

    python -m flowsplat_benchmarks.scripts.returning OUT            # draws and renders the worlds of SEEDS once; then minutes
    python -m flowsplat_benchmarks.scripts.returning OUT --write    # also makes them the package's own

Every world is seen in ``EPISODES`` ways: through a window that goes to and fro, so that objects leave it and come back, past a
pillar, with objects that are in no mask for a while, and with some of another world of its group. Outlines are off, some parts of
masks are nothing, light changes. Where an object was absent it gets another number, and all pairs of numbers, of which one ends
before the other begins, are scored. The weights are fitted to worlds of the first seeds, every one with the same weight; the gate
is the lowest with which, on those of the second ones, hardly any join is wrong; and what they are worth is measured on those of
the third. ``OUT/returning.md`` is the table.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.files import read_npz, write_json, write_npz, write_text
from flowsplat.common.progress import report, track
from flowsplat.geometry import Camera
from flowsplat.priors.objects.identity.appearance import MaskedFrames
from flowsplat.priors.objects.identity.cost import Cost
from flowsplat.priors.objects.identity.returning import (
    FEATURES,
    MIN_ABSENCE,
    WEIGHTS,
    Pair,
    ReturnClassifier,
    compute_features,
    join_pairs,
    list_pairs,
)
from flowsplat_benchmarks.objects.preparation import WorldKind
from flowsplat_benchmarks.scripts.identity import fit_cost
from flowsplat_benchmarks.worlds import draw_world

WIDTH, HEIGHT, FRAMES, FPS = 192, 108, 16, 10.0
MAX_SLOWING = 3.0
"""Episodes last up to so many times as long as the world: objects of longer ones hardly find a place in it. Chosen by eye."""
COUNTS: dict[WorldKind, int] = {"crowd": 14, "any": 3, "dancers": 2}
"""Seeds of every kind in each group."""
GROUPS = {"fitted": 0, "gate": 100, "measured": 1000}
"""First seed of each group."""
PLACING_ATTEMPTS = 16
"""To place the objects of a world: what is hard to place is left out, for the time. Chosen by eye."""
EPISODES = 36
"""How often every world is seen. Chosen by eye."""
LOGISTIC_RIDGE = 1.0
"""Of the logistic regression: the weight of the mean squared weight. On worlds of the first two groups, left out in turn, the log
loss is .18 with .3 and with 1, .21 with 3 and .24 with 10."""
GATES = (0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.93, 0.95, 0.97, 0.98, 0.99)
MAX_WRONG_JOINS = 0.02
"""Share of the joins, on worlds that were not fitted."""
MAYBE_PROBABILITY = 0.5
"""Probability from which it is said that two may be one."""
BANDS = (0.0, 0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.97, 1.0)
"""Of probabilities, within which they are compared with the share that is one object."""

_GUEST_PROBABILITY, _GUESTS = 0.25, 100
_WINDOW, _PILLAR_PROBABILITY, _PILLAR_WIDTH = (0.5, 1.0), 0.4, (0.08, 0.3)
_LOST_PROBABILITY, _LOST_SHARE = 0.4, (0.1, 0.6)
_BLOB_PROBABILITY, _BLOB_RADIUS = 0.4, (0.03, 0.1)
_LIGHT, _CAMERA_ERROR, _RIM_ERROR = 0.12, 0.02, (-1, 2)
"""How episodes are drawn: probability of every object of another world to be among them, and from where those are numbered; share
of the width and height that the window has; of episodes with a pillar, and its share of the width; how often an object is lost, and
for which share of the clip; parts of the mask that are nothing, and their radius as a share of the width; by how much light changes
at most, by how much the camera's rotation is off (radians, over a second), and a mask's outline (pixels). Chosen by eye."""


@dataclass(frozen=True)
class Rendered:
    """A world: images [T, H, W, 3] and masks [T, H, W] uint8, viewmats [T, 4, 4], Ks [T, 3, 3] and times [T] in seconds."""

    images: np.ndarray
    masks: np.ndarray
    viewmats: np.ndarray
    Ks: np.ndarray
    times: np.ndarray


@dataclass(frozen=True)
class Known:
    """The pairs of an episode.

    Attributes:
        pairs: [E, 2] numbers, frames: [E, 2] the last of the one and the first of the other, features: [E, F].
        same: [E] whether the two are one object.
        next: [E] the same, and no other number of it is seen in between.
    """

    pairs: np.ndarray
    frames: np.ndarray
    features: np.ndarray
    same: np.ndarray
    next: np.ndarray


def list_worlds(group: str) -> list[tuple[WorldKind, int]]:
    """Return the kinds and seeds of a group."""
    return [(kind, GROUPS[group] + n) for kind, count in COUNTS.items() for n in range(count)]


def render(kind: WorldKind, seed: int, folder: Path) -> Rendered:
    """Return a world, from ``folder`` if it is there.

    Raises:
        InputError: there is none of that seed.
    """
    path = folder / f"{kind}-{seed}.npz"
    if not path.exists():
        world = draw_world(seed, WIDTH, HEIGHT, FRAMES, FPS, kind == "dancers", kind == "crowd", PLACING_ATTEMPTS)
        cameras = [world.camera(i) for i in range(FRAMES)]
        arrays = {
            "images": np.stack([world.image(i) for i in range(FRAMES)]),
            "masks": np.stack([world.geometry(i)[1] for i in range(FRAMES)]),
            "viewmats": np.stack([each.viewmat for each in cameras]), "K": np.stack([each.K for each in cameras]),
            "times": np.asarray(world.timestamps),
        }  # fmt: skip
        write_npz(path, arrays)
    found = read_npz(path)
    return Rendered(*(found[name] for name in ("images", "masks", "viewmats", "K", "times")))


def draw_episode(world: Rendered, guest: Rendered, rng: np.random.Generator) -> tuple[MaskedFrames, np.ndarray]:
    """Return a way in which a world is seen, and the object [256] that every number is; below 0 of what is none.

    Args:
        guest: another world, whose objects may be among its own.
    """
    count, height, width = world.masks.shape
    masks, times = world.masks.astype(int), world.times * rng.uniform(1, MAX_SLOWING)
    shown = world.images.copy()
    for number in np.unique(guest.masks[guest.masks > 0]).tolist():
        if rng.random() < _GUEST_PROBABILITY:
            inside = guest.masks == number
            masks[inside], shown[inside] = _GUESTS + number, guest.images[inside]
    numbers = np.unique(masks[masks > 0]).tolist()
    for number in numbers:
        if rng.random() < _LOST_PROBABILITY:
            start, lasts = rng.uniform(0, times[-1]), rng.uniform(*_LOST_SHARE) * times[-1]
            lost = (times >= start) & (times < start + lasts)
            masks[lost] = np.where(masks[lost] == number, 0, masks[lost])
    if rng.random() < _PILLAR_PROBABILITY:
        left, wide = rng.uniform(0, width), rng.uniform(*_PILLAR_WIDTH) * width
        masks[:, :, int(left) : int(left + wide)] = 0
    _add_blobs(masks, rng)
    share = rng.uniform(*_WINDOW)
    w, h = int(share * width), int(share * height)
    corners = _draw_way(times, (width - w, height - h), rng)
    gains = 1 + rng.uniform(0, _LIGHT) * np.sin(2 * np.pi * times / rng.uniform(2, 8) + rng.uniform(0, 2 * np.pi))
    turns = np.cumsum(rng.normal(size=(count, 3)) * _CAMERA_ERROR * np.sqrt(times[1] - times[0]), 0)
    images, cut, cameras = [], np.zeros((count, h, w), int), []
    for k, (x, y) in enumerate(corners):
        images.append(np.clip(shown[k, y : y + h, x : x + w] * gains[k], 0, 255).astype(np.uint8))
        cut[k] = _spoil(masks[k, y : y + h, x : x + w], rng)
        K, viewmat = world.Ks[k] - [[0, 0, x], [0, 0, y], [0, 0, 0]], world.viewmats[k].copy()
        viewmat[:3, :3] = cv2.Rodrigues(turns[k])[0] @ viewmat[:3, :3]
        cameras.append(Camera(viewmat, K, w, h))
    labels, owners = _number(cut)
    return MaskedFrames(times, np.zeros(count, int), cameras, lambda k: labels[k], lambda k: images[k]), owners


def _add_blobs(masks: np.ndarray, rng: np.random.Generator) -> None:
    """Add parts of the mask that are nothing, each below 0, in place."""
    count, height, width = masks.shape
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1)
    number = 0
    while rng.random() < _BLOB_PROBABILITY:
        number -= 1
        start, lasts = rng.integers(count), rng.integers(3, count // 2)
        place, speed = rng.uniform(0, [width, height]), rng.normal(size=2) * 0.5
        radii = width * rng.uniform(*_BLOB_RADIUS, 2)
        for k in range(start, min(start + lasts, count)):
            inside = (((pixels - place - speed * (k - start)) / radii) ** 2).sum(-1) <= 1
            masks[k][inside & (masks[k] == 0)] = number


def _draw_way(times: np.ndarray, room: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Return the corner [T, 2] of the window: at rest, or to and fro."""
    middle, phase = rng.uniform(0.2, 0.8, 2), rng.uniform(0, 2 * np.pi)
    reach = np.minimum(middle, 1 - middle) * (rng.uniform(0.5, 1.0) if rng.random() < 0.75 else 0.0)
    swing = np.sin(2 * np.pi * times / times[-1] / rng.uniform(0.5, 1.5) + phase)
    return np.round((middle + reach * [1, 0.3] * swing[:, None]) * room).astype(int)


def _spoil(mask: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a mask [H, W] whose outlines are off."""
    by = int(rng.integers(_RIM_ERROR[0], _RIM_ERROR[1] + 1))
    if by == 0:
        return mask
    square = np.ones((2 * abs(by) + 1,) * 2, np.uint8)
    if by < 0:
        return np.where(cv2.erode((mask != 0).astype(np.uint8), square, borderValue=1) > 0, mask, 0)
    wider = mask.copy()
    for number in np.unique(mask[mask != 0]):
        wider[(cv2.dilate((mask == number).astype(np.uint8), square) > 0) & (wider == 0)] = number
    return wider


def _number(masks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return masks uint8 in which what was absent has another number, and the object [256] of every number."""
    labels, owners, highest = np.zeros(masks.shape, np.uint8), np.zeros(256, int), 0
    for owner in np.unique(masks[masks != 0]):
        inside = masks == owner
        frames = np.flatnonzero(inside.any((1, 2)))
        for spell in np.split(frames, np.flatnonzero(np.diff(frames) > MIN_ABSENCE) + 1):
            highest += 1
            owners[highest] = owner
            labels[spell] = np.where(inside[spell], highest, labels[spell])
    return labels, owners


def read_known(clip: MaskedFrames, owners: np.ndarray) -> Known | None:
    """Return the pairs of an episode; None if there are none."""
    pairs, areas = list_pairs(clip)
    pairs = [(a, b) for a, b in pairs if owners[a] >= 0 or owners[b] >= 0]
    if not pairs:
        return None
    features, frames = compute_features(clip, pairs, areas)
    found = np.array(pairs)
    same = owners[found[:, 0]] == owners[found[:, 1]]
    first = np.array([np.flatnonzero(areas[:, n])[0] if areas[:, n].any() else -1 for n in range(256)])
    between = [
        any(owners[n] == owners[a] and last < first[n] < start for n in np.unique(found))
        for (a, _), (last, start) in zip(pairs, frames, strict=True)
    ]
    return Known(found, frames, features, same, same & ~np.array(between))


def see(worlds: Iterable[tuple[WorldKind, int]], folder: Path, only_rendered: bool) -> dict[str, list[Known]]:
    """Return the episodes of worlds, by their names."""
    rendered: dict[str, Rendered] = {}
    for kind, seed in worlds:
        name = f"{kind}-{seed}"
        if only_rendered and not (folder / f"{name}.npz").exists():
            continue
        try:
            rendered[name] = render(kind, seed, folder)
        except InputError as error:
            report(f"{name}: {error}")
    found: dict[str, list[Known]] = {}
    others = list(rendered.values())
    for place, (name, world) in enumerate(rendered.items()):
        rng = np.random.default_rng([place, 5])
        known = [read_known(*draw_episode(world, others[int(rng.integers(len(others)))], rng)) for _ in range(EPISODES)]
        found[name] = [each for each in known if each is not None]
    return found


def fit(worlds: Iterable[Sequence[Known]]) -> Cost:
    """Return the log odds, every world with the same weight."""
    features, same, weights = [], [], []
    for episodes in worlds:
        count = sum(len(each.same) for each in episodes)
        for each in episodes:
            features.append(each.features)
            same.append(each.same)
            weights.append(np.full(len(each.same), 1 / count))
    return fit_cost(features, same, weights, LOGISTIC_RIDGE)


def classifier(known: Known, cost: Cost) -> list[Pair]:
    """Return the pairs of an episode with their probabilities."""
    probabilities = 1 / (1 + np.exp(-cost(known.features)))
    return [
        Pair(int(a), int(b), int(last), int(first), float(probability))
        for (a, b), (last, first), probability in zip(known.pairs, known.frames, probabilities, strict=True)
    ]


@dataclass(frozen=True)
class Score:
    """Of joins: how many there are, how many are wrong, and how many there could be."""

    joins: int
    wrong: int
    possible: int

    def __str__(self) -> str:
        precision = 1 - self.wrong / max(self.joins, 1)
        recall = (self.joins - self.wrong) / max(self.possible, 1)
        return f"{self.joins} joins, {self.wrong} wrong: precision {precision:.3f}, recall {recall:.3f} of {self.possible}"


def score(worlds: Iterable[Sequence[Known]], cost: Cost, gate: float) -> Score:
    """Return how joins of a gate are. One that leaves out a number of the same object in between is right, too."""
    joins = wrong = possible = 0
    for episodes in worlds:
        for known in episodes:
            truth = {(int(a), int(b)): bool(s) for (a, b), s in zip(known.pairs, known.same, strict=True)}
            joined = join_pairs(classifier(known, cost), gate)
            joins += len(joined)
            wrong += sum(not truth[each.before, each.after] for each in joined)
            possible += int(known.next.sum())
    return Score(joins, wrong, possible)


def choose_gate(worlds: Sequence[Sequence[Known]], cost: Cost) -> float:
    """Return the lowest of ``GATES`` from which on few joins are wrong, a standard error added; else the highest."""
    chosen = GATES[-1]
    for gate in GATES[::-1]:
        found = score(worlds, cost, gate)
        report(f"gate {gate}: {found}")
        share = found.wrong / max(found.joins, 1)
        if share + np.sqrt(share * (1 - share) / max(found.joins, 1)) > MAX_WRONG_JOINS:
            break
        chosen = gate
    return chosen


def tabulate_bands(worlds: Iterable[Sequence[Known]], cost: Cost) -> list[str]:
    """Return lines of a table: mean probability and share of what is one object, by bands of probability; and the Brier score."""
    known = [each for episodes in worlds for each in episodes]
    probability = np.concatenate([1 / (1 + np.exp(-cost(each.features))) for each in known])
    same = np.concatenate([each.same for each in known])
    lines = ["| probability | pairs | mean probability | one object |", "| --- | --- | --- | --- |"]
    for low, high in pairwise(BANDS):
        inside = (probability >= low) & (probability < high)
        if inside.any():
            lines.append(f"| {low} to {high} | {inside.sum()} | {probability[inside].mean():.3f} | {same[inside].mean():.3f} |")
    return [
        *lines,
        "",
        f"Brier score {np.mean((probability - same) ** 2):.4f}; {same.mean():.3f} of {len(same)} pairs are one object.",
    ]


def plain(found: ReturnClassifier, worlds: Iterable[str]) -> dict[str, Any]:
    """Return what ``WEIGHTS`` holds."""
    numbers = {key: [float(f"{x:.9g}") for x in getattr(found.cost, key)] for key in ("mean", "deviation", "weights")}
    return {"fitted on": list(worlds), "gate": found.gate, "maybe": found.maybe, "features": list(FEATURES), **numbers}


def main(arguments: Sequence[str] | None = None) -> None:
    """Fit, write the table, and with ``--write`` the weights."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--write", action="store_true", help="make the weights the package's own")
    parser.add_argument("--only-rendered", action="store_true", help="leave out the worlds that OUT does not hold yet")
    options = parser.parse_args(arguments)
    groups = {
        name: see(track(list_worlds(name), f"Worlds: {name}"), options.out / "worlds", options.only_rendered) for name in GROUPS
    }
    cost = fit(groups["fitted"].values())
    gate = choose_gate(list(groups["gate"].values()), cost)
    found = ReturnClassifier(cost, gate, MAYBE_PROBABILITY)
    lines = []
    for name, worlds in groups.items():
        kinds = ", ".join(f"{sum(w.startswith(kind) for w in worlds)} {kind}" for kind in COUNTS)
        lines += [f"{name} ({kinds}; seeds from {GROUPS[name]}), gate {gate}: {score(worlds.values(), cost, gate)}", ""]
        lines += [*tabulate_bands(worlds.values(), cost), ""]
    write_text(options.out / "returning.md", "\n".join(lines))
    report("\n".join(lines))
    write_json(WEIGHTS if options.write else options.out / WEIGHTS.name, plain(found, groups["fitted"]))


if __name__ == "__main__":
    main()
