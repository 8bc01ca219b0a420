"""Rewrites the object numbers of stored masks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from flowsplat.priors.continuity import Continuity
from flowsplat.priors.objects.areas import describe_count, large_objects
from flowsplat.priors.objects.identity.clusters import identify_tracks
from flowsplat.priors.objects.identity.masked_tracks import MaskedTracks
from flowsplat.priors.objects.identity.painting import paint
from flowsplat.scenes import Scene

OWN = ("motion", "clicks")
"""Methods of masks whose numbers are ours to change."""

COLOR_EVERY, COLOR_BLUR = 3, 2.0
"""Every how many frames the colors of tracks are looked up, and the blur of the images, in pixels."""


def has_own_numbers(scene: Scene) -> bool:
    """Return whether something is masked whose numbers are ours to change: masks of our own, and given ones of one number."""
    numbers = _list_numbers(scene)
    method = (scene.prior("masks") or {}).get("method")
    return len(numbers) > 0 and method != "truth" and (method in OWN or len(numbers) == 1)


def identify_objects(scene: Scene) -> int:
    """Rewrite the object numbers of the stored masks by common motion; what is masked stays the same.

    Needs tracks over the training frames. True masks keep their numbers, and so do masks that came with several.

    Returns:
        How many objects there are.
    """
    frames = scene.train_frames
    if not has_own_numbers(scene):
        return len(_list_numbers(scene))
    tracks, pieces = scene.tracks, Continuity(scene).pieces
    highest = 0
    for piece in np.unique(pieces):
        chosen = [frames[k] for k in np.flatnonzero(pieces == piece)]
        clip = MaskedTracks(tracks.points[:, chosen, :2], tracks.visible[:, chosen], [scene.mask(i) for i in chosen])
        owners = identify_tracks(clip, track_colors(scene, chosen, clip))

        def motion(k: int, chosen: list[int] = chosen) -> np.ndarray | None:
            """Of the pixels of a frame, per frame ahead."""
            if len(chosen) == 1:
                return None
            j = k + 1 if k + 1 < len(chosen) else k - 1
            return scene.flow(chosen[k], chosen[j]).flow * (j - k)

        def write(k: int, mask: np.ndarray, chosen: list[int] = chosen) -> None:
            scene.write_mask(chosen[k], mask)

        highest = paint(clip, owners, motion, write, highest)
    how = scene.prior("masks")
    if how is not None:
        counted: dict[str, Any] = {"objects": highest}
        if how.get("method") == "motion" and "share" in how:
            count = len(large_objects(scene))
            counted["verdict"] = f"{describe_count(count, highest - count)} on {how['share']:.1%} of the image"
        scene.amend_prior("masks", **counted)
    return highest


def _list_numbers(scene: Scene) -> np.ndarray:
    """Return the numbers in the masks of the training frames, but for 0."""
    numbers = np.unique(np.concatenate([np.unique(scene.mask(i)) for i in scene.train_frames]))
    return numbers[numbers > 0]


def track_colors(scene: Scene, frames: Sequence[int], clip: MaskedTracks) -> np.ndarray:
    """CIE L*a*b* of all tracks [P, 3], each component from 0 to 255, the mean over some of the frames in which they are seen.

    Args:
        frames: those of the clip.
    """
    total, count = np.zeros((len(clip.points), 3)), np.zeros((len(clip.points), 1))
    for k in range(0, len(frames), COLOR_EVERY):
        image = cv2.GaussianBlur(scene.frame(frames[k]), (0, 0), COLOR_BLUR)
        lab = cv2.cvtColor(image, cv2.COLOR_RGB2LAB)
        seen, places = clip.find_visible(k)
        total[seen] += lab[places[:, 1], places[:, 0]]
        count[seen] += 1
    return total / np.maximum(count, 1)
