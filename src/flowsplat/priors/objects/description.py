"""Describe what is known about each object, for people and for ``metrics.json``: how far away it is, what tells it, and how sure it
is."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from flowsplat.priors.objects.areas import large_objects
from flowsplat.priors.objects.solving import DynamicObject
from flowsplat.priors.objects.storage import SceneObjects
from flowsplat.scenes import Scene

HALF_PIXEL = 0.5
"""Pixels that an object may be off when it is seen from aside. Chosen by eye."""

WORDS = {
    "contact": "stands on the ground",
    "bounce": "touches the ground when it bounces",
    "pivot": "swings about a fixed point",
    "height": "keeps its height over the ground",
    "monocular": "monocular depth",
    "contact_hint": "a hint: it touches what is still",
    "same_depth_hint": "a hint: as far away as a place of the still scene",
}
"""What speaks for a distance, by the name of its cue."""

GUESS = "nothing: a guess"

HINT_BORDER = 3
"""Pixels from the image's border within which the lowest pixel of an object is not suggested: its foot may lie outside.
Chosen by eye."""


@dataclass(frozen=True)
class ObjectDescription:
    """One object.

    Attributes:
        number: in the masks.
        frames: how many training frames it is seen in.
        depth: median planar depth of its middle, in the units of the cameras.
        sigma: standard deviation of the natural logarithm of its depth.
        cues: names of what speaks for its depth; none = a guess.
        rigid: whether its motion was found and explains all of it.
        largest_step: how far aside it may be seen from, in those units, until sigma makes half a pixel: Z / (2 f sigma).
        hint: ``x,y@frame`` of its lowest pixel in the frame in which it is largest, as ``--contact`` takes it, where its distance
            is a guess; None where it is not, or its lower end is never seen inside the image.
    """

    number: int
    frames: int
    depth: float
    sigma: float
    cues: Sequence[str]
    rigid: bool
    largest_step: float
    hint: str | None = None

    @property
    def words(self) -> str:
        """What speaks for its distance."""
        return " and ".join(WORDS.get(cue, cue) for cue in self.cues) or GUESS


def sureness(sigmas: Sequence[float], guesses: int = 0) -> str:
    """Return how sure the distances of objects are, behind "the distances of objects are": "sure to 7%", "sure to 7% to 15%, 2
    guesses".

    Args:
        sigmas: of the natural logarithm of the distances that something speaks for.
        guesses: how many more there are.
    """
    least, most = (f"{100 * np.expm1(sigma):.0f}%" for sigma in (min(sigmas), max(sigmas))) if sigmas else ("", "")
    known = f"sure to {least}" if least == most else f"sure to {least} to {most}"
    if not guesses:
        return known
    return f"{known}, {guesses} of them a guess" if sigmas else "a guess"


def describe_objects(scene: Scene, found: SceneObjects) -> list[ObjectDescription]:
    """Describe every object that is seen in a training frame, in the order of their numbers."""
    focal = float(scene.cameras[scene.train_frames[0]].K[0, 0])
    objects = [obj for obj in sorted(found.objects, key=lambda each: each.number) if _find_visible(obj).any()]
    hints = suggest_contacts(scene, found.normal, {obj.number for obj in objects if not obj.cues})
    return [_describe(obj, focal, hints.get(obj.number)) for obj in objects]


def suggest_contacts(scene: Scene, normal: np.ndarray, numbers: Collection[int]) -> dict[int, str]:
    """For objects the place, as ``--contact`` takes it, at which each most likely touches what is under it.

    Args:
        normal: [3] unit vector, up.
        numbers: of the objects; those whose lower end is never seen inside the image are left out.
    """
    best: dict[int, tuple[int, str]] = {}
    for i in filter(scene.has_mask, scene.train_frames) if numbers else ():
        mask, camera = scene.mask(i), scene.cameras[i]
        for number in numbers:
            y, x = np.nonzero(mask == number)
            if len(x) <= best.get(number, (0, ""))[0]:
                continue
            pixels = np.stack([x, y], 1) + 0.5
            rays = camera.unproject(pixels, np.ones(len(pixels))) - camera.center
            # Of the lowest row, which may be long, the middle.
            fall = rays @ normal
            low = np.flatnonzero(fall <= fall.min() + 0.5 / camera.K[1, 1])
            column, row = pixels[low[np.argsort(x[low], kind="stable")[len(low) // 2]]].astype(int)
            inner = HINT_BORDER <= column < scene.width - HINT_BORDER and HINT_BORDER <= row < scene.height - HINT_BORDER
            if inner:
                best[number] = len(x), f"{column},{row}@{i}"
    return {number: hint for number, (_, hint) in best.items()}


def word_hint(number: int, hint: str) -> str:
    """Return what a user can do about an object whose distance is a guess: ``hint`` as of ``ObjectDescription``."""
    guess = word_guess(number, hint)
    return f"{guess}, the same command with --contact {hint} makes it sure, and keeps cameras, flow, masks and tracks."


def word_guess(number: int, hint: str) -> str:
    """Return that the distance of an object is a guess, and the beginning of what makes it sure: ``hint`` as of
    ``ObjectDescription``."""
    place, _, frame = hint.partition("@")
    return f"The distance of object {number} is a guess. If it touches the ground, or anything still, at {place} in frame {frame}"


def _find_visible(obj: DynamicObject) -> np.ndarray:
    return np.isfinite(obj.log_depth)


def _describe(obj: DynamicObject, focal: float, hint: str | None) -> ObjectDescription:
    seen = _find_visible(obj)
    depth, sigma = float(np.exp(np.median(obj.log_depth[seen]))), float(obj.sigma)
    step = HALF_PIXEL * depth / (focal * max(sigma, 1e-6))
    return ObjectDescription(obj.number, int(seen.sum()), depth, sigma, sorted(obj.cues), obj.rigid, step, hint)


def object_figures(scene: Scene, found: SceneObjects) -> list[dict[str, object]]:
    """Return the same as JSON: depth and step both in the units of the cameras and in median depths of the scene; ``small``: a
    part."""
    unit, large = scene.similarity.scale, large_objects(scene)
    return [
        {
            "number": m.number, "small": m.number not in large, "frames": m.frames,
            "depth": m.depth, "depth_in_scenes": m.depth * unit, "sigma": m.sigma,
            "cues": list(m.cues), "rigid": m.rigid, "largest_step": m.largest_step, "largest_step_in_scenes": m.largest_step * unit,
            "hint": m.hint,
        }
        for m in describe_objects(scene, found)
    ]  # fmt: skip
