"""Find out by the parallax of the clip what the values of given depth are: depth or disparity, near or far.

Files of depth seldom say what their numbers mean, and what is read the wrong way turns near and far round. So points are matched
between some frames and triangulated with the cameras; that inverse depth is compared with what each reading of the values says,
after the scale (of disparities also the shift) that fits best. The two ways round differ much where the scene has depth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.progress import report
from flowsplat.priors.background.monocular_maps import METRIC_SHIFT_SIGMA, RELATIVE_SHIFT_SIGMA, Monocular, fit_line
from flowsplat.priors.given.camera_check import Matches, match_frames
from flowsplat.priors.given.depth import DEPTH, DISPARITY, INVERTED, GivenDepth
from flowsplat.scenes import Scene

MAX_OFF_LINE, MIN_PARALLAX = 1.0, 2.0
"""Pixels of the matched images from its epipolar line up to which a match rests, and parallax of a pair of frames at its median
depth from which it tells distances. Chosen by eye."""
MIN_POINTS = 60
"""Points of a pair at least. Chosen by eye."""
CLEAR_SHARE = 0.5
"""Share of the misfit of the other way round that the misfit of a reading has at most where it is clear. Of true depth in eight
forms, on the four rig scenes and six of ten random worlds, it is .11 at most, on a seventh .66 to .99 (docs/given.md)."""
MAX_UNITS_MISFIT = 0.2
"""Misfit of depth that is in the units of the cameras, as it stands; true depth has at most .08 (docs/given.md). Chosen by eye."""

WAYS = (DEPTH, INVERTED), (DISPARITY,)
"""Readings by which large values are far, and by which they are near."""
HOW_TO_SAY = (
    "say it with --given.depth-kind: depth (large is far), disparity (large is near) or inverted-disparity (white minus disparity)"
)


@dataclass(frozen=True)
class Triangulated:
    """Points of one frame: where, as shares of width and height [N, 2], and their inverse depth [N] in units of the cameras."""

    frame: int
    places: np.ndarray
    inverse: np.ndarray


def match_training_frames(scene: Scene) -> list[Matches]:
    """Return what is matched between some training frames; nothing where the camera stands still."""
    return match_frames(scene, scene.train_frames, "Depth against images")


def triangulate(scene: Scene, matches: Sequence[Matches]) -> list[Triangulated]:
    """Return the points that rest, of the pairs of frames that have enough parallax."""
    found = [_triangulate_pair(scene, each) for each in matches]
    return [each for each in found if len(each.inverse) >= MIN_POINTS]


def _triangulate_pair(scene: Scene, matches: Matches) -> Triangulated:
    a, b = (scene.cameras[i].resize(*matches.size) for i in (matches.first, matches.second))
    pose = b.pose_from(a)
    # A point at inverse depth w is seen in b at (turned + w shift), so that w (shift_xy - q shift_z) = q turned_z - turned_xy.
    turned = np.concatenate([matches.before, np.ones((len(matches.before), 1))], 1) @ (b.K @ pose[:3, :3] @ np.linalg.inv(a.K)).T
    shift = b.K @ pose[:3, 3]
    slope, target = shift[:2] - matches.after * shift[2], matches.after * turned[:, 2:] - turned[:, :2]
    square = (slope**2).sum(1)
    inverse = (slope * target).sum(1) / np.maximum(square, 1e-18)
    depth = np.maximum(turned[:, 2], 1e-9)
    off = np.linalg.norm(target - inverse[:, None] * slope, axis=1) / depth
    rests = (off < MAX_OFF_LINE) & (inverse > 0) & (turned[:, 2] > 1e-9)
    places = matches.before / matches.size
    if scene.has_mask(matches.first):
        rests &= _sample(scene.mask(matches.first), places) == 0
    if rests.any():
        rests &= np.sqrt(square) / depth * np.median(inverse[rests]) >= MIN_PARALLAX
    return Triangulated(matches.first, places[rests], inverse[rests])


def _sample(values: np.ndarray, places: np.ndarray) -> np.ndarray:
    height, width = values.shape
    columns, rows = (places * [width, height]).astype(int).T
    return values[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)]


def compute_misfit(points: Sequence[Triangulated], given: GivenDepth, kind: str, as_it_is: bool = False) -> float | None:
    """Return the median error of inverse depth, over it (over the median of what is further away); None where nothing tells.

    Args:
        points: with which the values are compared.
        kind: how these are read.
        as_it_is: take them in the units of the cameras, and fit nothing.
    """
    misfits = []
    for each in points:
        nearness, confidence = (_sample(values, each.places).astype(np.float64) for values in given.inverse(each.frame, kind))
        x, y = nearness[confidence > 0], each.inverse[confidence > 0]
        if len(x) >= MIN_POINTS:
            size = np.maximum(y, np.median(y))
            loose = METRIC_SHIFT_SIGMA if kind == DEPTH else RELATIVE_SHIFT_SIGMA
            scale, shift = (1.0, 0.0) if as_it_is else fit_line(x, y, size**-2, loose)
            misfits.append(float(np.median(np.abs(scale * x + shift - y) / size)))
    return float(np.median(misfits)) if misfits else None


def is_in_units(scene: Scene, given: GivenDepth, matches: Sequence[Matches]) -> bool | None:
    """Return whether depth is as its layout says and in the units of the cameras; None where nothing tells."""
    misfit = compute_misfit(triangulate(scene, matches), given, given.kind, as_it_is=True) if matches else None
    return None if misfit is None else misfit <= MAX_UNITS_MISFIT


def choose_kind(scene: Scene, given: GivenDepth, matches: Sequence[Matches], path: Path, asked: str | None) -> tuple[str, str]:
    """Return what the values are, and a sentence about it. Needs cameras.

    Args:
        asked: what they are said to be, which is taken.

    Raises:
        InputError: nothing is said, and the images do not tell.
    """
    points = triangulate(scene, matches) if matches else []
    misfits = {kind: compute_misfit(points, given, kind) for way in WAYS for kind in way}
    known = {kind: misfit for kind, misfit in misfits.items() if misfit is not None}
    if len(known) < len(misfits):
        return asked or _ask(path, "the camera hardly travels, so that nothing tells"), f"read as {asked}"
    told = ", ".join(f"as {kind} by {misfit:.1%}" for kind, misfit in known.items())
    far, near = (min(way, key=known.__getitem__) for way in WAYS)
    best, other = (far, near) if known[far] <= known[near] else (near, far)
    is_clear = known[best] <= CLEAR_SHARE * known[other]
    if asked is None and not is_clear:
        _ask(path, f"the images do not tell ({told} off the parallax)")
    kind = asked or best
    if is_clear and not any({kind, best} <= set(way) for way in WAYS):
        report(f"{path} is read as {kind}, as it is said to be, but as {best} it would fit far better: {told} off the parallax.")
    return kind, f"read as {kind} (off the parallax {told})"


def monocular_of(scene: Scene, depth: GivenDepth, matches: Sequence[Matches], path: Path, told: str | None, said: str) -> Monocular:
    """Return given depth that is to be fitted to the cameras, by the kind that ``choose_kind`` finds.

    Args:
        told: what it is said to be.
        said: where it comes from, for people.

    Raises:
        InputError: as of ``choose_kind``.
    """
    kind, sentence = choose_kind(scene, depth, matches, path, told)
    return Monocular("given", f"{said}, {sentence}", kind != DEPTH, partial(depth.inverse, kind=kind))


def _ask(path: Path, why: str) -> str:
    raise InputError(f"{path}: is what has large values near or far? Here {why}: {HOW_TO_SAY}.")


def require_told(scene: Scene, path: Path, matches: Sequence[Matches]) -> None:
    """Refuse what nobody says the kind of, where the camera stands still.

    Raises:
        InputError: it does.
    """
    if not matches and all(map(scene.has_frame, scene.train_frames)):
        _ask(path, "the camera stands still, so that nothing tells")
