"""The object stage: how each object moves, and how far away it is (docs/method/objects.md)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from flowsplat.common.progress import track
from flowsplat.common.spread import spread
from flowsplat.priors.background.ground import Ground, find_ground, static_points, up_direction
from flowsplat.priors.background.matched_clip import MatchedClip
from flowsplat.priors.background.monocular_maps import Monocular, MonocularMaps
from flowsplat.priors.background.static_depth import Background, StaticDepth, static_depth
from flowsplat.priors.flow import FlowEstimator, dis_estimator
from flowsplat.priors.objects.areas import large_objects
from flowsplat.priors.objects.attachment import attach_parts
from flowsplat.priors.objects.billboards import make_billboards
from flowsplat.priors.objects.contact import Bound, compute_ground_bound, find_below, middle_of
from flowsplat.priors.objects.hints import Hint, with_hints
from flowsplat.priors.objects.identity import has_own_numbers, identify_objects
from flowsplat.priors.objects.monocular_cue import MonocularDistances
from flowsplat.priors.objects.rematching import ObjectImages, gray
from flowsplat.priors.objects.returns import describe_returns, find_returns, join_returns
from flowsplat.priors.objects.shape_offset import roundness
from flowsplat.priors.objects.solving import solve_object, tracks_of_objects
from flowsplat.priors.objects.storage import SceneObjects, save_objects
from flowsplat.scenes import Scene

MIN_PIXELS = 20
"""Pixels of an object from which a frame tells of it. Chosen by eye."""
GROUND_FRAMES = 16
"""Frames of a piece that the ground is found in. Chosen by eye."""


def objects_stage(
    scene: Scene, estimate: FlowEstimator = dis_estimator, static: tuple[MatchedClip, StaticDepth] | None = None,
    hints: Sequence[Hint] = (), monocular: Callable[[], Monocular] | None = None,
) -> None:  # fmt: skip
    """Depth trajectory, shape offset and distance of every numbered object. Needs cameras, flow, masks and tracks.

    The numbers of masks of our own are rewritten first, by common motion; and at the end those of objects that left and came back.

    Args:
        estimate: finds the flow between frames that are no neighbors.
        static: the clip and its static scene, where they are at hand.
        hints: what the user knows of distances.
        monocular: gives monocular depth that tells of distances, too, where the clip has parallax.

    Raises:
        InputError: a hint does not fit the clip.
    """
    own_numbers = has_own_numbers(scene)
    identify_objects(scene)
    clip = static[0] if static else MatchedClip(scene, estimate)
    background = static[1] if static else static_depth(clip, has_masks=True)
    source = monocular() if monocular is not None else None
    maps = MonocularMaps(clip, source) if source is not None and isinstance(background, Background) else None
    found = find_objects(clip, background, hints, maps)
    if own_numbers:
        found = join_returns(scene, found, find_returns(scene))
    save_objects(scene, found)
    large = large_objects(scene)
    objects = [obj for obj in found.objects if obj.number in large]
    rigid, tied = sum(obj.rigid for obj in objects), sum(bool(obj.cues) for obj in objects)
    count, small = len(objects), len(found.objects) - len(objects)
    verdict = f"{count} object{'s' if count != 1 else ''}, {rigid} of them rigid, {tied} tied to the still scene"
    if small:
        verdict += f"; {small} small part{'s' * (small > 1)}"
    if told := describe_returns(scene.prior("masks") or {}):
        verdict += f"; {told}"
    if maps is not None:
        maps.remove()
        helped = sum("monocular" in obj.cues for obj in objects)
        verdict += f"; {maps.source.source} helps to place {helped} of them"
    scene.finish_prior(
        "objects", method="motion", verdict=verdict, objects=count, small=small, rigid=rigid, tied=tied,
        hints=[hint.text for hint in hints], **({"monocular": source.method} if source is not None else {}),
    )  # fmt: skip


def find_objects(
    clip: MatchedClip, background: StaticDepth, hints: Sequence[Hint] = (), monocular: MonocularMaps | None = None
) -> SceneObjects:
    """Return the objects of a clip.

    Args:
        monocular: depth that tells of distances, too, where the clip has parallax.

    Raises:
        InputError: a hint does not fit it.
    """
    scene = clip.scene
    frames = scene.train_frames
    cameras = [scene.cameras[i] for i in frames]
    pieces = np.asarray(clip.continuity.pieces)
    grounds = {int(piece): _estimate_ground(clip, background, np.flatnonzero(pieces == piece)) for piece in np.unique(pieces)}
    any_ground = next((ground for ground in grounds.values() if ground is not None), None)
    normal = any_ground.normal if any_ground is not None else up_direction(cameras)
    billboards = make_billboards(clip, background)
    middles = {number: np.full((len(frames), 2), np.nan) for number in billboards}
    bounds: dict[int, list[Bound | None]] = {number: [None] * len(frames) for number in billboards}
    below: dict[int, list[tuple[int, np.ndarray] | None]] = {number: [None] * len(frames) for number in billboards}
    network = MonocularDistances(monocular, background) if monocular is not None and isinstance(background, Background) else None
    for k, i in enumerate(track(frames, "Contact with the ground")):
        mask, ground = scene.mask(i), grounds[int(pieces[k])]
        seen_here = []
        static = _sure_depth(background, k)
        for number in billboards:
            inside = mask == number
            if inside.sum() < MIN_PIXELS:
                continue
            middles[number][k] = middle_of(inside)
            seen_here.append(number)
            below[number][k] = find_below(mask, number, cameras[k], normal)
            if ground is not None:
                bounds[number][k] = compute_ground_bound(inside, (mask > 0) & ~inside, cameras[k], ground, static)
        if network is not None:
            network.look(k, mask, seen_here, cameras[k], normal)
    tracks = scene.tracks
    on_objects = tracks_of_objects(tracks.points, tracks.visible, scene.mask, frames)
    grays = np.stack([gray(scene.frame(i)) for i in track(frames, "Images of objects")])
    objects = []
    for number, values in track(list(billboards.items()), "Motion of objects"):
        seen = np.isfinite(values) & np.isfinite(middles[number]).all(1)
        if not seen.any():
            continue
        chosen, inside = on_objects.get(number, (np.zeros(0, int), np.zeros((0, len(frames)), bool)))
        log_billboards = np.where(seen, -np.log(np.where(seen, values, 1)), np.nan)
        home = int(np.bincount(pieces[seen]).argmax())
        positions = tracks.points[chosen][:, frames]

        def front(k: int, number: int = number) -> np.ndarray:
            return roundness(scene.mask(frames[k]) == number, float(cameras[k].K[0, 0]))

        shown = ObjectImages(grays, np.stack([scene.mask(i) == number for i in frames]), middles[number], cameras, normal)
        obj = solve_object(
            number,
            positions,
            inside,
            middles[number],
            bounds[number],
            cameras,
            grounds[home],
            log_billboards,
            normal,
            front,
            shown,
            network,
        )
        objects.append(obj)
    found = SceneObjects(attach_parts(objects, below, cameras, normal), normal, any_ground is not None)
    return with_hints(clip, background, grounds, found, hints) if hints else found


def _sure_depth(background: StaticDepth, k: int) -> np.ndarray:
    """Return planar depth [h, w] of the static scene in a training frame; inf where it is not sure."""
    if not isinstance(background, Background):
        return np.full((1, 1), np.inf)
    return background.compute_sure_depth(k)


def _estimate_ground(clip: MatchedClip, background: StaticDepth, frames: np.ndarray) -> Ground | None:
    """Return the ground of one piece of the clip, given by positions of its frames."""
    if not isinstance(background, Background):
        return None
    chosen = frames[spread(len(frames), GROUND_FRAMES)]
    depths = [1 / np.maximum(background.sure(int(k))[0], 1e-9) for k in chosen]
    sure = [np.isfinite(background.compute_sure_depth(int(k))) for k in chosen]
    points, normals, found = static_points(depths, sure, [clip.cameras[int(k)] for k in chosen])
    return find_ground(points, normals, found, [clip.cameras[int(k)] for k in frames]) if len(points) else None
