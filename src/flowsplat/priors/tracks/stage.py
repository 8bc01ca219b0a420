"""The track stage: points on everything that is seen, denser on moving objects; and tracks of points that are asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from flowsplat.common.progress import track
from flowsplat.geometry.interpolation import sample_map
from flowsplat.priors.continuity import Continuity
from flowsplat.priors.flow import gray
from flowsplat.priors.tracks.following import Follower
from flowsplat.priors.tracks.points import TrackTable, corner_strength, detail, new_points, oldest_of_crowds
from flowsplat.priors.tracks.resting import complete_resting
from flowsplat.scenes import Scene, Tracks
from flowsplat.scenes.layers import MAX_TRACK_PLACES

BACKGROUND_POINTS = 700
"""About how many points are followed at a time in an image. Chosen by eye."""
OBJECT_POINTS = 1500
"""About how many points are followed at a time in an image, and on all its objects. Chosen by eye."""
MIN_TRACK_FRAMES = 3
"""Frames that a kept track was seen in. Chosen by eye."""

Start = Callable[[int, np.ndarray, np.ndarray, Follower], None]
"""Given a training frame, its gray image, its labels and the follower: adds the points that start there."""


def tracks_stage(scene: Scene) -> None:
    """Tracks over the training frames along their stored flow; denser on moving objects, where there are masks.

    They have gaps where a point was hidden, and end at a cut of the clip and at frames that show nothing. Of a long clip in which
    more were followed than a scene may hold, those that were seen longest are kept.
    """
    has_masks = scene.prior("masks") is not None
    seeds = _Seeds(scene, has_masks)
    table = TrackTable(columns=4)  # x, y, how sure it is, whether it is on an object
    for t, labels, follower in _follow(scene, scene.train_frames, seeds.add, "Tracks"):
        seen = np.flatnonzero(follower.seen)
        points, inside = follower.points[seen], np.zeros((len(seen), 1), np.float32)
        if has_masks:
            inside = sample_map((labels > 0).astype(np.float32), points)
        table.add(t, follower.ids[seen], np.concatenate([points, follower.confidence[seen, None], inside], 1))
    table.count = seeds.count
    table.keep_longest(MAX_TRACK_PLACES // scene.num_frames)
    values = table.values(scene.num_frames)
    visible = np.isfinite(values[..., 0])
    values = np.nan_to_num(values)
    moving = values[..., 3].sum(1) > 0.5 * visible.sum(1)
    kept = visible.any(1)
    # Short ones go later: a point that rests gets longer once its depth is known.
    _finish(scene, Tracks(values[kept, :, :2], visible[kept], values[kept, :, 2], moving[kept]), incomplete=True)


def complete_tracks(scene: Scene) -> None:
    """Give points of the background the paths of resting points, as far as depth tells, and drop what was hardly seen.

    The last step of the tracks: depth needs masks, and objects need tracks.
    """
    tracks = scene.tracks
    points, confidence = complete_resting(scene, tracks.points, tracks.confidence, tracks.visible.argmax(1))
    lasting = (confidence > 0).sum(1) >= min(MIN_TRACK_FRAMES, len(scene.train_frames))
    _finish(scene, Tracks(points[lasting], confidence[lasting] > 0, confidence[lasting], tracks.moving[lasting]))


def _finish(scene: Scene, tracks: Tracks, **how: bool) -> None:
    scene.write_tracks(tracks)
    count, objects = len(tracks.points), int(tracks.moving.sum())
    length = int(np.median(tracks.visible.sum(1))) if count else 0
    verdict = f"{count} points, followed over {length} frames (median)" if count else "nothing could be followed"
    if objects:
        verdict += f", {objects} of them on moving objects"
    scene.finish_prior("tracks", method="patches", verdict=verdict, tracks=count, moving=objects, median_length=length, **how)


def follow_queries(scene: Scene, frames: np.ndarray, points: np.ndarray) -> Tracks:
    """Follow given points through the training frames, both ways, among the points that the stage would follow.

    Args:
        frames: [N] the training frame in which each point is given.
        points: [N, 2] pixels (centers at +0.5) in that frame.

    Returns:
        one track for each, visible at least in the frame it is given in; none of them is called moving.
    """
    count = len(points)
    found = np.zeros((count, scene.num_frames, 2), np.float32)
    confidence = np.zeros((count, scene.num_frames), np.float32)
    for order, label in ((scene.train_frames, "Following"), (scene.train_frames[::-1], "Following back")):
        seeds = _Seeds(scene, scene.prior("masks") is not None, count)

        def add(t: int, image: np.ndarray, labels: np.ndarray, follower: Follower, seeds: _Seeds = seeds) -> None:
            asked = np.flatnonzero(frames == t)
            follower.add(asked, points[asked], image, labels)
            seeds.add(t, image, labels, follower)

        for t, _, follower in _follow(scene, order, add, label):
            mine = np.flatnonzero((follower.ids < count) & follower.seen)
            ids = follower.ids[mine]
            found[ids, t], confidence[ids, t] = follower.points[mine], follower.confidence[mine]
    found, confidence = complete_resting(scene, found, confidence, frames)
    return Tracks(found, confidence > 0, confidence, np.zeros(count, bool))


def _follow(scene: Scene, order: list[int], start: Start, label: str) -> Iterator[tuple[int, np.ndarray, Follower]]:
    """Follow points through training frames in this order (rising or falling); after each that shows something, it is yielded."""
    continuity = Continuity(scene)
    has_masks = scene.prior("masks") is not None
    follower, before, took = Follower(), -1, 0.0
    for t in track(order, label):
        k = scene.train_frames.index(t)
        if continuity.is_blank(k):
            before = -1
            continue
        image = detail(gray(scene.frame(t)))
        labels = scene.mask(t).astype(np.int32) if has_masks else np.zeros(image.shape, np.int32)
        if before < 0 or not continuity.are_joined(k, scene.train_frames.index(before)):
            follower, took = Follower(), 0.0
        else:
            takes = float(abs(scene.timestamps[t] - scene.timestamps[before]))
            follower.step(image, labels, scene.flow(before, t), takes / took if took else 1.0)
            took = takes
        start(t, image, labels, follower)
        yield t, labels, follower
        before = t


class _Seeds:
    """Starts points where none are followed, and gives up those in a crowd.

    Attributes:
        count: the number that the next point gets.
    """

    def __init__(self, scene: Scene, has_masks: bool, asked: int = 0):
        self._coarse, self._fine = _spacings(scene, has_masks)
        self._has_masks = has_masks
        self._asked = self.count = asked

    def add(self, t: int, image: np.ndarray, labels: np.ndarray, follower: Follower) -> None:
        """Start points in gray ``image`` of frame ``t``. Numbers below the first ones of this never go."""
        height, width = image.shape
        own = np.flatnonzero(follower.ids >= self._asked)
        kept = own[oldest_of_crowds(follower.points[own], 0.5 * self._fine)]
        follower.keep(np.sort(np.concatenate([np.flatnonzero(follower.ids < self._asked), kept])))
        points = follower.points
        points = points[(points >= 0).all(1) & (points[:, 0] < width) & (points[:, 1] < height)]
        corners = corner_strength(image)
        mask = labels > 0 if self._has_masks else np.ones(image.shape, bool)
        # On objects every cell gets a point, even where nothing is a corner: the flow carries it.
        for strength, spacing in ((np.where(mask, corners + 1e-12, 0), self._fine), (np.where(mask, 0, corners), self._coarse)):
            fresh = new_points(strength, points, spacing)
            follower.add(np.arange(self.count, self.count + len(fresh)), fresh, image, labels)
            self.count += len(fresh)
            points = np.concatenate([points, fresh])


def _spacings(scene: Scene, has_masks: bool) -> tuple[int, int]:
    """Return pixels between points: on the background and on objects (everything may move where there are no masks)."""
    area = float(scene.width * scene.height)
    object_area = area
    if has_masks:
        chosen = scene.train_frames[:: max(1, len(scene.train_frames) // 8)]
        areas = [int((scene.mask(t) > 0).sum()) for t in chosen]
        object_area = float(np.median([a for a in areas if a > 0] or [scene.width * scene.height]))
    coarse = max(3, round((area / BACKGROUND_POINTS) ** 0.5))
    return coarse, int(np.clip(round((object_area / OBJECT_POINTS) ** 0.5), 3, coarse))
