"""Masks with the numbers of the objects that their tracks are on."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from scipy.spatial import cKDTree

from flowsplat.priors.objects.identity.masked_tracks import MaskedTracks

FLOW_WEIGHT = 3.0
"""Pixels of distance that one pixel of a difference in motion counts, where a part is divided."""
VOTES = 5
AROUND = 5
"""Frames before and after, in which a number that no track knows is looked up."""
CLOSE = 0.04
"""Share of the long side up to which what no track is on is close to an object."""


def paint(
    clip: MaskedTracks, owners: np.ndarray, motion: Callable[[int], np.ndarray | None], write: Callable[[int, np.ndarray], None],
    highest: int = 0,
) -> int:  # fmt: skip
    """Masks with the numbers of the objects that their tracks are on.

    A part with tracks of one object is its own. In one with tracks of several, every pixel goes with those that are nearest and
    move like it. A part without tracks goes where the number that it had goes in the frames around it, else to an object that it is
    mostly close to, or keeps a number of its own.

    Args:
        owners: [P] from 1, 0 = of no object.
        motion: of the pixels of a frame [H, W, 2] per frame ahead, or None where it is unknown.
        write: takes the position of a frame and its mask [H, W] uint8.
        highest: the highest number that is taken.

    Returns:
        The highest number that is taken now; 255 at most, which all further objects share.
    """
    painted = [_paint(clip, owners, k, motion) for k in range(len(clip.masks))]
    most = int(owners.max(initial=0))
    _fill_unknown(clip, painted, most)
    _give_to_neighbors(clip, painted, most)
    numbers: dict[int, int] = {0: 0}
    for k, labels in enumerate(painted):
        present, area = np.unique(labels, return_counts=True)
        for label in present[np.argsort(-area, kind="stable")]:
            if int(label) not in numbers:
                highest = min(highest + 1, 255)
                numbers[int(label)] = highest
        table = np.zeros(max(numbers) + 1, np.uint8)
        table[list(numbers)] = list(numbers.values())
        write(k, table[labels])
    return highest


def _paint(clip: MaskedTracks, owners: np.ndarray, k: int, motion: Callable[[int], np.ndarray | None]) -> np.ndarray:
    """[H, W] int32 owners of the pixels of frame k, -1 where none is known and 0 outside the mask."""
    count, labels = clip.parts(k)
    result = np.where(labels > 0, -1, 0).astype(np.int32)
    seen, places = clip.find_visible(k)
    owned = (clip.part[seen, k] > 0) & (owners[seen] > 0)
    seen, places = seen[owned], places[owned]
    part, owner = clip.part[seen, k].astype(int), owners[seen]
    if len(seen) == 0:
        return result
    held = np.bincount(part * (owner.max() + 1) + owner, minlength=count * (owner.max() + 1)).reshape(count, -1)
    # Single tracks may have slipped from one object to another.
    present = (held >= 3) & ((held >= 0.1 * held.sum(1, keepdims=True)) | (held >= 0.3 * held.sum(0)))
    flow: np.ndarray | None = None
    for here in np.flatnonzero(held.any(1)):
        valid = np.flatnonzero(present[here])
        if len(valid) < 2:
            result[labels == here] = held[here].argmax()
            continue
        if flow is None:
            found = motion(k)
            flow = np.zeros((*labels.shape, 2), np.float32) if found is None else found
        y, x = np.nonzero(labels == here)
        mine = np.flatnonzero((part == here) & present[here][owner])
        at_tracks = np.concatenate([places[mine], FLOW_WEIGHT * flow[places[mine, 1], places[mine, 0]]], 1)
        at_pixels = np.concatenate([np.stack([x, y], 1), FLOW_WEIGHT * flow[y, x]], 1)
        _, near = cKDTree(at_tracks).query(at_pixels, k=min(VOTES, len(mine)))
        votes = owner[mine][near.reshape(len(y), -1)]
        counts = np.stack([(votes == number).sum(1) for number in valid], 1)
        result[y, x] = valid[counts.argmax(1)]
    return result


def _fill_unknown(clip: MaskedTracks, painted: list[np.ndarray], most: int) -> None:
    """Owners of the pixels that have none, in place: by the number that they had, else ``most`` and that number."""
    votes = np.zeros((len(painted), 256, most + 1), np.int64)
    for k, labels in enumerate(painted):
        known = labels > 0
        codes = clip.masks[k][known].astype(np.int64) * (most + 1) + labels[known]
        votes[k] = np.bincount(codes, minlength=256 * (most + 1)).reshape(256, most + 1)
    for k, labels in enumerate(painted):
        unknown = labels < 0
        if not unknown.any():
            continue
        near = votes[max(0, k - AROUND) : k + AROUND + 1].sum(0)
        goes = np.where(near.any(1), near.argmax(1), most + np.arange(256))
        labels[unknown] = goes[clip.masks[k][unknown]]


def _give_to_neighbors(clip: MaskedTracks, painted: list[np.ndarray], most: int) -> None:
    """Give what no track is on, numbers above ``most``, to the object that it is mostly close to, in place."""
    nearest: dict[int, list[tuple[int, float]]] = {}
    for labels in painted:
        unknown = [int(number) for number in np.unique(labels) if number > most]
        if not unknown:
            continue
        known = (labels > 0) & (labels <= most)
        away, site = cv2.distanceTransformWithLabels(
            (~known).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
        )  # fmt: skip
        owner = np.zeros(int(site.max()) + 1, int)
        owner[site[known]] = labels[known]
        for number in unknown:
            y, x = np.nonzero(labels == number)
            at = int(away[y, x].argmin())
            distance = float(away[y, x][at]) if known.any() else np.inf
            nearest.setdefault(number, []).append((int(owner[site[y[at], x[at]]]), distance))
    for number, found in nearest.items():
        owners, distances = np.array([o for o, _ in found]), np.array([d for _, d in found])
        best = int(np.bincount(owners).argmax())
        close = (owners == best) & (distances <= CLOSE * clip.long_side)
        if best > 0 and 2 * close.sum() > len(found):
            for labels in painted:
                labels[labels == number] = best
