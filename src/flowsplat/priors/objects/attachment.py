"""Parts that nothing ties to the still scene, and that end on an object that is tied: a head that moves otherwise than its body, a
load."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from flowsplat.geometry import Camera
from flowsplat.priors.objects.contact import upright_ratio
from flowsplat.priors.objects.contact_cues import MAX_UNEVEN_RANGE, MIN_BOUNDS, MIN_FEET_SHARE
from flowsplat.priors.objects.solving import DynamicObject

Below = Mapping[int, Sequence[tuple[int, np.ndarray] | None]]
"""For each object [T] what ``find_below`` returned, None where it is not seen."""


def attach_parts(
    objects: Sequence[DynamicObject], below: Below, cameras: Sequence[Camera], normal: np.ndarray
) -> list[DynamicObject]:
    """Return the same objects, with parts at the distance of what they end on.

    An object without a cue is guessed to be where the still scene behind it ends. If its lowest pixels lie right on another object
    in most frames, it is a part of that, stands on it, or stands behind it: it is at least that far away, and there is the better
    guess. It stays a guess: its sigma and its cues are as they were.

    Args:
        cameras: [T] of the training frames.
        normal: [3] up.
    """
    tied = {obj.number: obj for obj in objects if obj.cues}
    return [obj if obj.cues else _attach(obj, tied, below.get(obj.number, ()), cameras, normal) for obj in objects]


def _attach(
    obj: DynamicObject, tied: Mapping[int, DynamicObject], below: Sequence[tuple[int, np.ndarray] | None],
    cameras: Sequence[Camera], normal: np.ndarray,
) -> DynamicObject:  # fmt: skip
    numbers = np.array([0 if found is None else found[0] for found in below], int)
    seen = int(np.isfinite(obj.log_depth).sum())
    if not numbers.any():
        return obj
    holder = tied.get(int(np.bincount(numbers[numbers > 0]).argmax()))
    if holder is None:
        return obj
    offsets = []
    for k in np.flatnonzero(numbers == holder.number).tolist():
        found = below[k]
        if found is not None and np.isfinite(obj.log_depth[k]) and np.isfinite(holder.log_depth[k]):
            pixels = found[1] + 0.5
            own, other = (
                each.log_depth[k] + np.log(upright_ratio(cameras[k], normal, each.middles[k], pixels)) for each in (obj, holder)
            )
            offsets.append(float(np.median(other - own)))
    if len(offsets) < max(MIN_BOUNDS, MIN_FEET_SHARE * seen) or np.diff(np.percentile(offsets, [10, 90]))[0] > MAX_UNEVEN_RANGE:
        return obj
    step = float(np.median(offsets))
    return replace(obj, log_depth=obj.log_depth + step, points=replace(obj.points, log_depth=obj.points.log_depth + step))
