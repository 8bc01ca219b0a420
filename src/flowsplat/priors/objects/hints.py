"""Apply what the user knows of an object's distance: where it touches what is still, and what is as far away as it.

``--contact x,y@frame``: what is seen there touches the still scene, or the ground, right behind it. ``--same-depth
x,y@frame=x2,y2``: it is as far away as the still point seen at x2,y2 of that frame. One hint places its object over the whole clip,
for its depth trajectory over time is known up to one factor.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.progress import report
from flowsplat.geometry import Camera
from flowsplat.priors.background.ground import Ground
from flowsplat.priors.background.matched_clip import MatchedClip
from flowsplat.priors.background.static_depth import StaticDepth
from flowsplat.priors.objects.distance import Cue
from flowsplat.priors.objects.solving import DynamicObject
from flowsplat.priors.objects.storage import SceneObjects
from flowsplat.priors.prompts import FrameNumbers, parse_place

HINT_SIGMA = {"contact_hint": 0.02, "same_depth_hint": 0.03}
"""Standard deviation of ln distance that one hint leaves where the depth of what it names is sure."""
SUPPOSED_SIGMA, UNSEEN_SIGMA = 0.06, 0.15
"""The same of a contact where the ground is only supposed to go on, and where no frame saw what is behind the object: there the
depth is filled in from around, and on a car's shadow it was .15 to .28 too near."""
TOUCH_DEPTH_SHARE = 0.3
"""Of an object's half width: standard deviation of how much nearer than its middle the place is where it touches. A cart's near
wheel stands before it: such a hint was -.07 off and called itself sure to 2 %; those of a car, a walker and a hoop were +.02, .00
and +.01 off (docs/notebook/2026-11.md, "Contact, counted")."""
WARN_DIFFERENCE = 0.05
"""In ln: from here on a warning says that ground and depth behind a contact differ. Chosen by eye."""
HINT_ERROR_RATE = 0.02
"""Chance that a hint is a slip of the hand. Chosen by eye."""
SURFACE_TOLERANCE = 0.15
"""In ln: where the ground is this close to the still scene behind a pixel, it is what is touched, and the surer of both.
Chosen by eye."""
HINT_REACH = 0.02
"""Share of the image's long side within which a hint that misses an object still means it. Chosen by eye."""


@dataclass(frozen=True)
class Hint:
    """One hint.

    Attributes:
        text: as it was given.
        kind: ``contact_hint`` or ``same_depth_hint``.
        frame: of the clip.
        place: x, y in pixels of the frames, on the object.
        still: x, y of the still point that is as far away; None for a contact.
    """

    text: str
    kind: str
    frame: int
    place: tuple[float, float]
    still: tuple[float, float] | None = None


def parse_hints(contact: Sequence[str], same_depth: Sequence[str], scene: FrameNumbers) -> list[Hint]:
    """Hints as they are typed: ``x,y@frame`` and ``x,y@frame=x2,y2``; values of at most 1 are shares of width and height.

    Raises:
        InputError: not of that form, outside the image, or on a frame that is held out or does not exist.
    """
    found = []
    for text in contact:
        frame, (x, y) = parse_place(text, "--contact", 2, scene)
        found.append(Hint(f"contact {text}", "contact_hint", frame, (x, y)))
    for text in same_depth:
        match = re.fullmatch(r"\s*([^=]+)=([^=@]+)\s*", text)
        if match is None or match[2].count(",") != 1:
            raise InputError(
                f"--same-depth {text} cannot be understood: give x,y@frame=x2,y2, for example --same-depth 320,180@0=400,200, "
                "where "
                "x2,y2 shows something still that is as far away."
            )
        frame, (x, y) = parse_place(match[1], "--same-depth", 2, scene)
        _, (u, v) = parse_place(f"{match[2]}@{frame}", "--same-depth", 2, scene)
        found.append(Hint(f"same_depth {text}", "same_depth_hint", frame, (x, y), (u, v)))
    return found


def with_hints(
    clip: MatchedClip, background: StaticDepth, grounds: Mapping[int, Ground | None], found: SceneObjects, hints: Sequence[Hint]
) -> SceneObjects:
    """Return the objects, those of hints where the hints say.

    Args:
        grounds: of every piece of the clip.

    Raises:
        InputError: nothing moves where a hint says, or something does where the still scene is meant.
    """
    told: dict[int, list[tuple[str, float, float]]] = {}
    for hint in hints:
        number, offset, sigma = _offset(clip, background, grounds, found, hint)
        told.setdefault(number, []).append((hint.kind, offset, sigma))
    objects = [_place(obj, told[obj.number]) if obj.number in told else obj for obj in found.objects]
    return replace(found, objects=objects)


def _place(obj: DynamicObject, told: Sequence[tuple[str, float, float]]) -> DynamicObject:
    weights = np.array([1 / sigma**2 for _, _, sigma in told])
    offsets = np.array([offset for _, offset, _ in told])
    offset = float(np.average(offsets, weights=weights))
    # Hints that differ tell that the depth trajectory between them is off, or a hint.
    sigma = float(np.hypot(1 / np.sqrt(weights.sum()), np.std(offsets)))
    cues = {kind: Cue(offset, sigma, HINT_ERROR_RATE) for kind in sorted({kind for kind, _, _ in told})}
    points = replace(obj.points, log_depth=obj.points.log_depth + offset)
    return replace(obj, log_depth=obj.log_depth + offset, sigma=sigma, cues=cues, points=points)


def _offset(
    clip: MatchedClip, background: StaticDepth, grounds: Mapping[int, Ground | None], found: SceneObjects, hint: Hint
) -> tuple[int, float, float]:
    """Return which object a hint is about, by how much in ln it is farther away than it was placed, and how sure that is."""
    scene, k = clip.scene, clip.scene.train_frames.index(hint.frame)
    mask, camera = scene.mask(hint.frame), scene.cameras[hint.frame]
    x, y = _on_object(mask, found, k, hint, HINT_REACH * max(scene.width, scene.height))
    number = int(mask[y, x])
    obj = next(each for each in found.objects if each.number == number)
    inside = mask == number
    depths = np.zeros(mask.shape)
    depths[inside] = obj.depth(k, inside, scene.frame(hint.frame), camera, found.normal)
    size = (scene.width, scene.height)
    if hint.still is None:
        ground = grounds[int(np.asarray(clip.continuity.pieces)[k])]
        depth, sigma = _contact_depth(background, ground, camera, k, (x + 0.5, y + 0.5), size, hint)
        half_width = float(np.ptp(np.nonzero(inside.any(0))[0])) / 2 / float(camera.K[0, 0])
        sigma = float(np.hypot(sigma, TOUCH_DEPTH_SHARE * half_width))
    else:
        u, v = hint.still
        if mask[min(int(v), mask.shape[0] - 1), min(int(u), mask.shape[1] - 1)]:
            raise InputError(f"--{hint.text}: something moves at {u:.0f},{v:.0f}; give a place of the still scene behind the =.")
        depth, sigma = 1 / max(_at(background.plate(k), u, v, size), 1e-9), HINT_SIGMA[hint.kind]
    return number, float(np.log(depth / depths[y, x])), sigma


def _contact_depth(
    background: StaticDepth, ground: Ground | None, camera: Camera, k: int, place: tuple[float, float], size: tuple[int, int],
    hint: Hint,
) -> tuple[float, float]:  # fmt: skip
    """Return (planar depth, sigma of its logarithm) of what an object touches at ``place`` in training frame k.

    That is the ground where its map is known there, unless other frames saw something there that stands on it; else what other
    frames saw there; else the ground as it is supposed to go on; else what is filled in from around.
    """
    inverse, weight = background.compute_uncovered(k)
    filled = 1 / max(_at(background.plate(k), *place, size), 1e-9)
    seen = 1 / max(_at(inverse, *place, size), 1e-9) if _at(weight, *place, size) > 0 else None
    below, known = np.inf, False
    if ground is not None:
        depths, knowns = ground.depth(camera, np.array([place]))
        below, known = float(depths[0]), bool(knowns[0])
    sigma = HINT_SIGMA[hint.kind]
    if known and (seen is None or np.log(seen / below) > -SURFACE_TOLERANCE):
        depth = below
    elif seen is not None:
        depth = seen
    elif np.isfinite(below):
        depth, sigma = below, SUPPOSED_SIGMA
    else:
        depth, sigma = filled, UNSEEN_SIGMA
    beside = filled if seen is None else seen
    if np.isfinite(below) and abs(np.log(beside / below)) > WARN_DIFFERENCE:
        taken = "the ground" if depth == below else "what other frames saw there"
        other = "what was seen there" if seen is not None else "what is filled in there, which no frame saw,"
        percent = 100 * abs(np.expm1(np.log(beside / below)))
        side = "nearer" if beside < below else "farther"
        report(f"--{hint.text}: {other} is {percent:.0f}% {side} than the ground; {taken} is taken.")
    return depth, sigma


def _at(values: np.ndarray, u: float, v: float, size: tuple[int, int]) -> float:
    """Return the value of a map [h, w] of any size at a place in pixels of frames of ``size`` (width, height)."""
    row, column = int(v * values.shape[0] / size[1]), int(u * values.shape[1] / size[0])
    return float(values[min(row, values.shape[0] - 1), min(column, values.shape[1] - 1)])


def _on_object(mask: np.ndarray, found: SceneObjects, k: int, hint: Hint, reach: float) -> tuple[int, int]:
    """Column and row of the pixel of an object that a hint means.

    Raises:
        InputError: no object is near.
    """
    here = [m.number for m in found.objects if np.isfinite(m.log_depth[k])]
    y, x = np.nonzero(np.isin(mask, here))
    if len(x) == 0:
        raise InputError(f"--{hint.text}: nothing moves in frame {hint.frame}.")
    away = np.hypot(x + 0.5 - hint.place[0], y + 0.5 - hint.place[1])
    best = int(away.argmin())
    if away[best] > max(reach, 1.0):
        numbers = mask[y, x]
        places = [f"{n} about {np.median(x[numbers == n]):.0f},{np.median(y[numbers == n]):.0f}" for n in np.unique(numbers)]
        raise InputError(f"--{hint.text}: nothing moves there; in frame {hint.frame} there are objects {', '.join(places)}.")
    return int(x[best]), int(y[best])
