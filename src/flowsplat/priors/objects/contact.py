"""Find where an object's lowest pixels meet the ground: at most that far away is it, and just so far if it stands there."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from flowsplat.geometry import Camera
from flowsplat.priors.background.ground import Ground

LOWEST_PIXELS = 0.15
"""Pixels that count as its lowest, in units of the root of its area: fewer may be a leak of the mask. Chosen by eye."""
MIN_PIXELS = 24
"""Pixels of an object in a frame below which its lowest ones tell nothing. Chosen by eye."""
MIN_HIDING = 0.06
"""How much nearer than the ground the static scene just below its lowest pixels must be to hide its feet. Chosen by eye."""

MIN_BESIDE = 6
"""Pixels beside its lowest ones that must tell. Chosen by eye."""
CONTACT_DEPTH = 0.2
"""By how much, in ln, what touches the ground under an object is farther at one end than at the other, at most: the wheels of a
car, two feet. Above .1 it hardly matters (docs/notebook/2026-11.md, "Contact, counted")."""
MAX_BEYOND_GROUND = 0.15
"""How much farther the static scene is seen than the ground is supposed to be, so that it ends before. Chosen by eye."""


@dataclass(frozen=True)
class Bound:
    """What one frame says.

    Attributes:
        log_depth: logarithm of the planar depth of the billboard's middle at which it would touch the ground, below its middle.
        lowest_log_depth: the same if its lowest pixels touched the ground right below its middle.
        visible: whether its lowest pixels are in the image and nothing stands before them; nor another object, where the ground was
            not seen.
        seen: whether the ground was seen there, and is not only supposed to go on.
        lowest: [n, 2] int, (column, row) of its lowest pixels.
    """

    log_depth: float
    lowest_log_depth: float
    visible: bool
    seen: bool
    lowest: np.ndarray


def upright_ratio(camera: Camera, normal: np.ndarray, middle: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return [N] depth at pixels [N, 2] of an upright billboard that faces the camera, relative to that at its ``middle`` [2].

    The billboard holds the ground's normal [3]. A camera that looks down sees its foot farther than its head in planar depth.
    """
    rays = camera.unproject(np.concatenate([middle[None], pixels]), np.ones(len(pixels) + 1)) - camera.center
    facing = rays[0] - (rays[0] @ normal) * normal
    along = rays @ facing
    # A camera that looks straight down sees no upright billboard: it faces the image then.
    if along[0] < 0.05 * float(rays[0] @ rays[0]):
        return np.ones(len(pixels))
    return along[0] / np.maximum(along[1:], 0.2 * along[0])


def middle_of(mask: np.ndarray) -> np.ndarray:
    """Return [2] median pixel of a mask [H, W]."""
    y, x = np.nonzero(mask)
    return np.array([np.median(x), np.median(y)]) + 0.5


def compute_ground_bound(mask: np.ndarray, others: np.ndarray, camera: Camera, ground: Ground, static: np.ndarray) -> Bound | None:
    """Return the bound of one frame.

    Args:
        mask: bool [h, w], of one object; others: of all others that move.
        camera: of the frame, at that size.
        static: planar depth of the static scene, of any size; inf where it is not sure.

    Returns:
        None where the object is too small, all of it is above the horizon, or the ground below it was not seen.
    """
    height, width = mask.shape
    if mask.sum() < MIN_PIXELS:
        return None
    x, y, (column, row), lowest = _lower_rim(mask, camera, ground.normal)
    pixels = np.stack([x + 0.5 + 0.5 * column, y + 0.5 + 0.5 * row], 1)
    count = max(3, int(LOWEST_PIXELS * np.sqrt(mask.sum())))
    depth, seen = ground.depth(camera, pixels)
    middle = middle_of(mask)
    log_depth = np.log(depth) - np.log(upright_ratio(camera, ground.normal, middle, pixels))
    known = np.isfinite(log_depth)
    if known[lowest].mean() < 0.5:
        return None
    bound = float(np.sort(log_depth[known])[min(count, int(known.sum())) - 1])
    side = np.array([-row, column])
    below_middle = _bound_below(pixels[known] @ side, np.maximum(log_depth[known], bound), float(middle @ side))
    reach = 2 + height // 90
    below_x, below_y = x[lowest] + reach * column, y[lowest] + reach * row
    inside = (below_x >= 0) & (below_y >= 0) & (below_x < width) & (below_y < height)
    inside &= known[lowest]
    was_seen = bool(seen[lowest].mean() > 0.5)
    visible = bool(inside.mean() > 0.5 and (below_y < height).mean() > 0.9)
    if _ground_ends(mask, camera, ground, static, np.stack([x, y], 1)[lowest], np.array([column, row]), reach):
        return None
    if visible:
        rows, columns = (below_y * static.shape[0]) // height, (below_x * static.shape[1]) // width
        ahead = float(np.median(np.log(static[rows[inside], columns[inside]]) - np.log(depth[lowest][inside])))
        visible = ahead > -MIN_HIDING
        # Neither ground nor feet are seen: it is a part of what it ends on, or stands behind it.
        visible &= was_seen or float(others[below_y[inside], below_x[inside]].mean()) <= 0.5
        if not was_seen and np.isfinite(ahead) and ahead > MAX_BEYOND_GROUND:
            return None
    touching = np.argsort(np.where(known, log_depth, np.inf), kind="stable")[: min(count, int(known.sum()))]
    return Bound(below_middle, bound, visible, was_seen, np.stack([x, y], 1)[touching])


def _lower_rim(mask: np.ndarray, camera: Camera, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray, tuple[int, int], np.ndarray]:
    """Return x, y [n] of the pixels on an object's lower rim, the step (columns, rows) down from there, and which of them are its
    lowest [m].

    The rim is on the side where the ground comes nearer; a camera may be rolled, so the side is that of the image's "down".
    """
    height, width = mask.shape
    down = camera.viewmat[:3, :3] @ -normal
    column, row = (round(float(v)) for v in down[:2] / max(float(np.abs(down[:2]).max()), 1e-9))
    shifted = cv2.warpAffine(
        mask.astype(np.uint8), np.array([[1.0, 0, -column], [0, 1.0, -row]]), (width, height), flags=cv2.INTER_NEAREST
    )
    y, x = np.nonzero(mask & (shifted == 0))
    pixels = np.stack([x + 0.5 + 0.5 * column, y + 0.5 + 0.5 * row], 1)
    # The lowest pixels are those nearest to the camera's foot on the ground, whether the ground is known there or not.
    rays = camera.unproject(pixels, np.ones(len(pixels))) - camera.center
    order = np.argsort(rays @ normal, kind="stable")
    return x, y, (column, row), order[: max(3, int(LOWEST_PIXELS * np.sqrt(mask.sum())))]


def find_below(mask: np.ndarray, number: int, camera: Camera, normal: np.ndarray) -> tuple[int, np.ndarray]:
    """Return the number of the object that lies right below most of the lowest pixels of another, 0 where none does, and these
    pixels [n, 2] int (column, row).

    Args:
        mask: [h, w], numbers of objects; ``number``: of the upper one.
        normal: [3] up.
    """
    height, width = mask.shape
    x, y, (column, row), lowest = _lower_rim(mask == number, camera, normal)
    reach = 2 + height // 90
    below_x, below_y = x[lowest] + reach * column, y[lowest] + reach * row
    inside = (below_x >= 0) & (below_y >= 0) & (below_x < width) & (below_y < height)
    found = np.zeros(len(lowest), int)
    found[inside] = mask[below_y[inside], below_x[inside]]
    found[found == number] = 0
    most = int(np.bincount(found).argmax()) if len(found) else 0
    return (most if (found == most).mean() > 0.5 else 0), np.stack([x, y], 1)[lowest]


def _bound_below(across: np.ndarray, bounds: np.ndarray, middle: float) -> float:
    """Return the bound below an object's ``middle``, between what touches the ground to its left and to its right.

    A car touches it with its near wheels and its far ones, who walks with two feet: the nearest alone is nearer than its middle.
    The lower convex hull of all bounds joins them.

    Args:
        across: [n] where along its width the pixels of its lower rim are; ``bounds`` [n] theirs.
    """
    touching = bounds <= bounds.min() + CONTACT_DEPTH
    order = np.lexsort((bounds[touching], across[touching]))
    columns, nearest = np.unique(across[touching][order], return_index=True)
    hull: list[tuple[float, float]] = []
    for u, bound in zip(columns.tolist(), bounds[touching][order][nearest].tolist(), strict=True):
        while len(hull) > 1 and _turns_down(hull[-2], hull[-1], (u, bound)):
            hull.pop()
        hull.append((u, bound))
    corners = np.array(hull)
    return float(np.interp(middle, corners[:, 0], corners[:, 1]))


def _turns_down(first: tuple[float, float], second: tuple[float, float], third: tuple[float, float]) -> bool:
    return (second[0] - first[0]) * (third[1] - first[1]) <= (second[1] - first[1]) * (third[0] - first[0])


def _ground_ends(
    mask: np.ndarray, camera: Camera, ground: Ground, static: np.ndarray, lowest: np.ndarray, down: np.ndarray, reach: int
) -> bool:
    """Return whether the ground ends at an object's ``lowest`` pixels [n, 2]: beside them what is seen is far beyond it.

    What stands behind the edge of a terrace hides its feet behind the ground itself.
    """
    height, width = mask.shape
    side = np.array([-down[1], down[0]])
    along, middle = (lowest - lowest.mean(0)) @ side, lowest.mean(0)
    beside = np.concatenate([along.min() - reach * np.arange(1, 7), along.max() + reach * np.arange(1, 7)])
    above = reach * np.arange(1, 5)
    places = middle + beside[:, None, None] * side / (side @ side) - above[:, None] * down + 0.5
    x, y = places.reshape(-1, 2).astype(int).T
    inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    inside[inside] &= ~mask[y[inside], x[inside]]
    x, y = x[inside], y[inside]
    if len(x) == 0:
        return False
    depth, _ = ground.depth(camera, np.stack([x, y], 1) + 0.5)
    with np.errstate(invalid="ignore"):  # Neither is known where both are inf.
        beyond = np.log(static[(y * static.shape[0]) // height, (x * static.shape[1]) // width]) - np.log(depth)
    beyond = beyond[np.isfinite(beyond)]
    return len(beyond) >= MIN_BESIDE and float(np.median(beyond)) > MAX_BEYOND_GROUND
