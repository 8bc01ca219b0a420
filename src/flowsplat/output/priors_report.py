"""``priors.html``: what was found out about a clip before training, so that ten seconds tell whether training can work."""

from __future__ import annotations

import base64
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from flowsplat.common.run_paths import RunPaths
from flowsplat.common.spread import spread
from flowsplat.images.charts import line_chart
from flowsplat.images.colors import depth_range, depth_to_color, flow_legend, flow_scale, flow_to_color, object_color, tint
from flowsplat.images.html import figure, image_tag, table
from flowsplat.images.sheets import side_by_side, stack, with_rulers
from flowsplat.images.video import write_mp4
from flowsplat.output.camera_path import ObjectPath, path_at_an_angle, path_from_above
from flowsplat.output.page import card, image_row, write_page
from flowsplat.priors.cameras.checks import LARGE_ERROR, MIN_PARALLAX
from flowsplat.priors.cameras.following import WORKING_SIDE
from flowsplat.priors.depth.stage import MIN_TRUSTED_SHARE
from flowsplat.priors.graph import PRIORS
from flowsplat.priors.objects import SceneObjects, load_objects
from flowsplat.priors.objects.areas import describe_count, large_objects
from flowsplat.priors.objects.description import ObjectDescription, describe_objects, sureness
from flowsplat.priors.objects.returns import describe_returns
from flowsplat.scenes import Scene, Tracks

PANEL_SIDE = 400
"""Pixels of the longer side of an image in the strip. Chosen by eye."""
MAX_STRIP_FRAMES = 100
"""Frames of the strip, at most. Chosen by eye."""
STRIP_CRF = 30
"""Quality of the strip: it is to show what was found, not to be beautiful. Chosen by eye."""
STILL_FRAMES = 4
"""Frames that are shown in images, too. Chosen by eye."""
TRACK_TAIL, MAX_TRACKS = 6, 240
"""Training frames that a track is drawn over, and how many tracks are drawn. Chosen by eye."""
SCENE_POINTS = 1500
"""Points of the scene in the drawing of the path. Chosen by eye."""
THUMBNAIL_SIDE = 160
"""Pixels of the longer side of the image of an object. Chosen by eye."""
MAX_PIECES = 3
"""Pieces of a clip with cuts whose paths are drawn. Chosen by eye."""

_STATIC_TRACK, _MOVING_TRACK = (80, 220, 255), (255, 140, 0)
"""Red, green and blue of tracks on what rests and on what moves. Chosen by eye."""


def write_priors_report(folder: Path, scene: Scene, seconds: Mapping[str, float]) -> Path:
    """Write ``priors.html`` into the folder of a run and return its path.

    Args:
        scene: with all of its priors.
        seconds: what the stages took, as far as they ran.

    Raises:
        InputError: a prior is missing or damaged, or the folder cannot be written.
    """
    shown, objects = _Shown(scene), load_objects(scene)
    path = RunPaths(folder).priors_report_path
    write_page(
        path,
        "priors.html.jinja",
        title=scene.name,
        verdict=verdict(scene),
        strip=_strip(shown),
        headline=_headline(scene, shown, objects),
        paths=list(_paths(scene, objects)),
        objects=list(_objects(scene, objects)),
        stages=table(("", "how", "verdict", "time"), list(_rows(scene, seconds))),
        stills=[_still(shown, k) for k in spread(len(shown.frames), STILL_FRAMES)],
        legend=image_tag(flow_legend(), "The color of every direction of flow", None),
        flow_scale=f"{shown.flow_scale:.1f}",
        charts=list(_charts(scene, shown)),
        notes=scene.info.notes,
    )
    return path


# -- words


def verdict(scene: Scene) -> str:
    """In plain words: what was found, and whether training can work.

    Some of "camera path: good; little parallax: depth is a guess; 2 moving objects", and a sentence on what follows.
    """
    cameras, depth = scene.prior("cameras") or {}, scene.prior("depth") or {}
    found = [_camera_words(scene, cameras), _depth_words(cameras, depth), _mask_words(scene)]
    return f"{'; '.join(found)}. {_advice(scene, cameras, depth)}"


def _is_poor(scene: Scene, cameras: Mapping[str, Any]) -> bool:
    pixel = max(1.0, max(scene.width, scene.height) / WORKING_SIDE)
    return cameras.get("motion") in ("free", "rotation") and cameras["reprojection_px"] > LARGE_ERROR * pixel


def _camera_words(scene: Scene, cameras: Mapping[str, Any]) -> str:
    motion = cameras.get("motion")
    if motion is None:
        return f"Camera path: {_source(cameras)}"
    if motion == "unknown":
        return "Camera path: none, nothing could be followed"
    words = {"static": "Camera: stands still", "rotation": "Camera: only turns", "free": "Camera path: good"}[motion]
    if _is_poor(scene, cameras):
        words = "Camera path: poor"
    elif cameras.get("flat"):
        words = "Camera path: one plane, so the focal length is a guess"
    if cameras.get("surrounds"):
        words += "; something that moves fills most of the image"
    breaks = cameras.get("breaks", [])
    if breaks:
        words += f", with a cut before frame {breaks[0]}" if len(breaks) == 1 else f", with {len(breaks)} cuts"
    blank = cameras.get("blank", [])
    if blank:
        words += f"; {len(blank)} blank frame{'s' * (len(blank) > 1)}"
    return words


def _depth_words(cameras: Mapping[str, Any], depth: Mapping[str, Any]) -> str:
    if depth.get("method") == "guess":
        reason = "little parallax" if cameras.get("motion", "free") == "free" else "no parallax"
        return f"{reason}: depth is a guess"
    if depth.get("method") != "multi-view":
        return f"depth: {_source(depth)}"
    if cameras.get("motion") == "free" and cameras["parallax_degrees"] < MIN_PARALLAX:
        return "little parallax: depth is rough"
    trusted = _get_trusted_static(depth)
    if trusted < MIN_TRUSTED_SHARE:
        return f"depth from motion on {trusted:.0%} of the still scene, the rest is filled in"
    return "depth from the camera's motion"


def _get_trusted_static(depth: Mapping[str, Any]) -> float:
    """Return share of the still scene with trusted depth; of everything in scenes from before that was told apart."""
    return float(depth.get("trusted_static", depth["trusted"]))


def _mask_words(scene: Scene) -> str:
    masks, objects = scene.prior("masks") or {}, scene.prior("objects") or {}
    # Objects, where tracks have told which parts belong together.
    count = objects.get("objects", masks.get("objects"))
    if count is None:
        count = len({int(number) for i in scene.train_frames for number in np.unique(scene.mask(i))} - {0})
    words = describe_count(count, objects.get("small", 0))
    words = words if masks.get("method") == "motion" else f"{words} ({_source(masks)} masks)"
    guessed = count - objects.get("tied", count) if count else 0
    if guessed and (scene.prior("depth") or {}).get("method") != "guess":
        words += ", how far away is a guess" if guessed == count else f", how far away {guessed} of them are is a guess"
    return "; ".join(filter(None, (words, describe_returns(masks))))


def _source(prior: Mapping[str, Any]) -> str:
    return {"truth": "true", "given": "given"}.get(prior.get("method", ""), prior.get("method", "unknown"))


def _advice(scene: Scene, cameras: Mapping[str, Any], depth: Mapping[str, Any]) -> str:
    if cameras.get("motion") == "unknown":
        return "Training will hardly work: the images are blank, without texture or nothing but noise."
    if cameras.get("breaks"):
        return "Train on one piece at a time: choose it with --start and --end."
    if cameras.get("blank"):
        return "Blank frames spoil the training: leave them out with --start and --end."
    if _is_poor(scene, cameras):
        return "Training will give blurred images: consider cameras from another tool."
    if cameras.get("flat") and not cameras.get("focal_given"):
        return "Training can work along the clip's own path; give --cameras.focal if you know it."
    if depth.get("method") == "guess":
        return "Training can work along the clip's own path; views from aside will be wrong."
    if depth.get("method") == "multi-view" and _get_trusted_static(depth) < MIN_TRUSTED_SHARE:
        return "Training can work; views far from the clip's own path will show gaps and bends."
    return "Training can work."


def _headline(scene: Scene, shown: _Shown, objects: SceneObjects) -> list[dict[str, Any]]:
    cameras, depth, tracks = (scene.prior(name) or {} for name in ("cameras", "depth", "tracks"))
    camera = scene.cameras[scene.train_frames[0]]
    angle = 2 * np.degrees(np.arctan(scene.width / 2 / camera.K[0, 0]))
    unsure = (cameras.get("focal_sigma") or 1.0) > 0.05 and not cameras.get("focal_given", True)
    parallax = cameras.get("parallax_degrees")
    return [
        card(figure(cameras.get("reprojection_px")), "px", "camera error", "static points, median"),
        card(figure(angle, 0), "°", "field of view", "a guess" if unsure else "across the image"),
        card(figure(parallax, 1), "°", "parallax", "seen by a point, median"),
        card(figure(100 * float(np.mean(shown.matched)), 0), "%", "matched", "flow that passes there and back"),
        card(figure(100 * float(np.mean(shown.trusted)), 0), "%", "of the still scene", f"known depth, {depth.get('method', '')}"),
        *_object_cards(scene, objects),
        card(figure(tracks.get("tracks"), 0), "", "points followed", f"over {tracks.get('median_length', '–')} frames, median"),
    ]


def _object_cards(scene: Scene, found: SceneObjects) -> Iterator[dict[str, Any]]:
    large = large_objects(scene)
    counted = [obj for obj in found.objects if obj.number in large]
    if counted:
        tied = [obj.sigma for obj in counted if obj.cues]
        words = sureness(tied, len(counted) - len(tied))
        worst = max(tied) if len(tied) == len(counted) else None
        value = figure(None if worst is None else 100 * np.expm1(worst), 0, "nothing speaks for the distance of some of them")
        yield card(value, "%", "distance of objects", words)


def _rows(scene: Scene, seconds: Mapping[str, float]) -> Iterator[tuple[str, ...]]:
    for name in PRIORS.recorded:
        prior, spent = scene.prior(name) or {}, seconds.get(name)
        yield name, str(prior.get("method", "missing")), str(prior.get("verdict", "")), "" if spent is None else f"{spent:.0f} s"


# -- images


@dataclass(frozen=True)
class _Seen:
    """One training frame, reduced: image, flow (NaN where not trusted), mask, depth and where it is trusted."""

    image: np.ndarray
    flow: np.ndarray
    mask: np.ndarray
    depth: np.ndarray
    sure: np.ndarray


class _Shown:
    """Training frames with their priors at the size of a panel, and figures that color them all alike.

    Attributes:
        frames: their numbers.
        rate: frames a second at which they play at the speed of the clip.
        matched: share of pixels with trusted flow, one a frame (the last one has none).
        trusted: share of the pixels of the still scene with trusted depth, one a frame.
    """

    def __init__(self, scene: Scene):
        train = scene.train_frames
        stride = -(-len(train) // MAX_STRIP_FRAMES)
        self.frames = train[::stride]
        span = float(scene.timestamps[self.frames[-1]] - scene.timestamps[self.frames[0]])
        self.rate = float(np.clip((len(self.frames) - 1) / max(span, 1e-6), 2, 30))
        guessed = (scene.prior("depth") or {}).get("method") == "guess"
        self._depth_name = "depth (a guess)" if guessed else "depth"
        self._tracks = scene.tracks if scene.has_tracks else None
        self._train, self._pairs = train, set(scene.flow_pairs)
        scale = min(1.0, PANEL_SIDE / max(scene.width, scene.height))
        self.size = (max(2, round(scene.width * scale)), max(2, round(scene.height * scale)))
        self._scale = np.array(self.size) / [scene.width, scene.height]
        self.matched: list[float] = []
        self.trusted: list[float] = []
        following = dict(pairwise(train))
        before = train[-2] if len(train) > 1 else None
        self._seen = [self._read(scene, i, following.get(i), before) for i in self.frames]
        some = [self._seen[k] for k in spread(len(self._seen), 12)]
        self.flow_scale = flow_scale([seen.flow for seen in some])
        self._near, self._far = depth_range([seen.depth for seen in some])

    def _read(self, scene: Scene, i: int, following: int | None, before: int | None) -> _Seen:
        depth, mask = scene.depth(i), scene.mask(i)
        flow = np.full((self.size[1], self.size[0], 2), np.nan, np.float32)
        j = before if following is None else following
        if j is not None and (j > i or (i, j) in self._pairs):
            found = scene.flow(i, j)
            trusted = _small(found.trusted.astype(np.float32), self.size) > 0.5
            # The last frame has no next one: it is taken to go on as it came.
            forward = found.flow if j > i else -found.flow
            flow = np.where(trusted[..., None], _small(forward, self.size), np.nan)
            if j > i:
                self.matched.append(float(found.trusted.mean()))
        still = mask == 0
        self.trusted.append(float(depth.trusted[still].mean()) if still.any() else 0.0)
        return _Seen(
            _small(scene.frame(i), self.size), flow, cv2.resize(mask, self.size, interpolation=cv2.INTER_NEAREST),
            cv2.resize(depth.depth, self.size, interpolation=cv2.INTER_NEAREST),
            _small(depth.trusted.astype(np.float32), self.size) > 0.5,
        )  # fmt: skip

    def panels(self, k: int) -> dict[str, np.ndarray]:
        """Return images of a frame by name."""
        seen = self._seen[k]
        depth = depth_to_color(seen.depth, self._near, self._far)
        pale = (0.45 * depth.mean(-1, keepdims=True) + 60).astype(np.uint8)
        return {
            "tracks": self._with_tracks(seen.image, self.frames[k]),
            "flow": flow_to_color(seen.flow, self.flow_scale),
            "objects": tint(seen.image, seen.mask),
            self._depth_name: np.where(seen.sure[..., None], depth, pale),
        }

    def draw_rulers(self, k: int) -> np.ndarray:
        """Return the image of a frame with rulers in pixels of the prepared frames, which is what clicks are given in."""
        width, height = np.round(np.array(self.size) / self._scale).astype(int).tolist()
        return with_rulers(self._seen[k].image, (width, height))

    def _with_tracks(self, image: np.ndarray, frame: int) -> np.ndarray:
        result = image.copy()
        if self._tracks is None:
            return result
        for moving, color in ((False, _STATIC_TRACK), (True, _MOVING_TRACK)):
            for line in self._tails(self._tracks, frame, moving):
                fixed = np.round((line * self._scale - 0.5) * 16).astype(np.int32)
                cv2.polylines(result, [fixed], False, color, 1, cv2.LINE_AA, 4)
                cv2.circle(result, fixed[-1].tolist(), 20, color, -1, cv2.LINE_AA, 4)
        return result

    def _tails(self, tracks: Tracks, frame: int, moving: bool) -> Iterator[np.ndarray]:
        here = np.flatnonzero(tracks.visible[:, frame] & (tracks.moving == moving))
        until = self._train.index(frame) + 1
        last = np.array(self._train[max(0, until - TRACK_TAIL) : until])
        for n in here[:: max(1, -(-len(here) // (MAX_TRACKS // 2)))]:
            yield tracks.points[n, last[tracks.visible[n, last]]]


def _small(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def _still(shown: _Shown, k: int) -> dict[str, Any]:
    label = f"Frame {shown.frames[k]}"
    return {"label": label, "panels": image_row({"pixels": shown.draw_rulers(k), **shown.panels(k)}, label)}


def _strip(shown: _Shown) -> str:
    """Return all shown frames as a small video, a ``data:`` address."""

    def sheet(k: int) -> np.ndarray:
        panels = shown.panels(k)
        names, images = list(panels), list(panels.values())
        if shown.size[1] > shown.size[0]:
            return side_by_side(images, names)
        return stack([side_by_side(images[:2], names[:2]), side_by_side(images[2:], names[2:])])

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "strip.mp4"
        write_mp4(path, (sheet(k) for k in range(len(shown.frames))), shown.rate, crf=STRIP_CRF)
        return f"data:video/mp4;base64,{base64.b64encode(path.read_bytes()).decode()}"


# -- the path


def _paths(scene: Scene, objects: SceneObjects) -> Iterator[dict[str, Any]]:
    """Drawings of the path of every piece of the clip."""
    starts = [0, *(scene.prior("cameras") or {}).get("breaks", [])]
    ends = [*starts[1:], scene.num_frames]
    for start, end in list(zip(starts, ends, strict=True))[:MAX_PIECES]:
        cameras = scene.cameras[start:end]
        points, colors = _scene_points(scene, [i for i in scene.train_frames if start <= i < end])
        centers = np.array([camera.center for camera in cameras])
        length = float(np.linalg.norm(np.diff(centers, axis=0), axis=1).sum())
        yield {
            "label": f"Frames {start} to {end - 1}" if len(starts) > 1 else "",
            "length": f"{length * scene.similarity.scale:.2g}",
            "views": [
                path_from_above(cameras, points, colors, list(_object_paths(scene, objects, start, end))),
                path_at_an_angle(cameras),
            ],
        }


def _object_paths(scene: Scene, objects: SceneObjects, start: int, end: int) -> Iterator[ObjectPath]:
    """Yield paths of what is seen between two frames of the clip, with one standard deviation of its distance to either side."""
    for obj in objects.objects:
        seen = [k for k, i in enumerate(scene.train_frames) if start <= i < end and np.isfinite(obj.log_depth[k])]
        if not seen:
            continue
        places = [
            np.concatenate([
                scene.cameras[scene.train_frames[k]].unproject(obj.middles[k][None], np.exp(obj.log_depth[k] + off)[None])
                for k in seen
            ])
            for off in (0.0, -obj.sigma, obj.sigma)
        ]  # fmt: skip
        yield ObjectPath(obj.number, object_color(obj.number), *places)


def _objects(scene: Scene, found: SceneObjects) -> Iterator[dict[str, Any]]:
    """Yield an image of every object where it is largest, and what is known of its distance."""
    described = {each.number: each for each in describe_objects(scene, found)}
    best = dict.fromkeys(described, (0, -1))
    for i in scene.train_frames:
        areas = np.bincount(scene.mask(i).ravel(), minlength=256)
        best = {number: max(most, (int(areas[number]), i)) for number, most in best.items()}
    for number, obj in described.items():
        area, i = best[number]
        if area:
            label = f"Object {number}"
            yield {"label": label, "image": image_tag(_show_object(scene, i, number), label), **_words(scene, obj)}


def _words(scene: Scene, obj: ObjectDescription) -> dict[str, str]:
    unit, camera = scene.similarity.scale, _travel(scene)
    step = f"{obj.largest_step / obj.depth:.1%} of its distance"
    if camera > 0:
        step += f", {obj.largest_step / camera:.0%} of the camera's own travel"
    return {
        "cues": obj.words, "distance": f"{obj.depth * unit:.2f} median depths of the scene",
        "sure": f"to {100 * np.expm1(obj.sigma):.0f}%", "step": step,
        "rigid": "one rigid body" if obj.rigid else "bends, or too little of it was followed",
        "hint": "" if obj.hint is None else obj.hint,
    }  # fmt: skip


def _travel(scene: Scene) -> float:
    """Return how far apart the camera's centers are, at most along any axis."""
    return float(np.ptp([camera.center for camera in scene.cameras], axis=0).max())


def _show_object(scene: Scene, i: int, number: int) -> np.ndarray:
    """Return the surroundings of an object, it in color and all else in gray."""
    mask = scene.mask(i)
    y, x = np.nonzero(mask == number)
    room = max(8, int(0.15 * max(np.ptp(x), np.ptp(y))))
    rows, columns = slice(max(y.min() - room, 0), y.max() + room + 1), slice(max(x.min() - room, 0), x.max() + room + 1)
    image, own = scene.frame(i)[rows, columns], (mask[rows, columns] == number).astype(np.uint8)
    gray = np.repeat(image.mean(-1, keepdims=True) * 0.6, 3, -1)
    cut = np.where(own[..., None] > 0, image, gray).astype(np.uint8)
    cv2.drawContours(cut, cv2.findContours(own, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0], -1, object_color(number), 1)
    scale = min(1.0, THUMBNAIL_SIDE / max(cut.shape[:2]))
    return _small(cut, (max(1, round(cut.shape[1] * scale)), max(1, round(cut.shape[0] * scale))))


def _scene_points(scene: Scene, frames: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Static points [N, 3] with their colors [N, 3], from a few of these frames."""
    points, colors = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)]
    chosen = [frames[k] for k in spread(len(frames), 3)] if frames else []
    step = max(1, round((len(chosen) * scene.width * scene.height / SCENE_POINTS) ** 0.5))
    for i in chosen:
        y, x = np.mgrid[step // 2 : scene.height : step, step // 2 : scene.width : step].reshape(2, -1)
        still = scene.mask(i)[y, x] == 0
        y, x = y[still], x[still]
        points.append(scene.cameras[i].unproject(np.stack([x, y], -1) + 0.5, scene.depth(i).depth[y, x].astype(np.float64)))
        colors.append(scene.frame(i)[y, x])
    return np.concatenate(points), np.concatenate(colors)


def _charts(scene: Scene, shown: _Shown) -> Iterator[dict[str, Any]]:
    frames = shown.frames
    matched = (frames[: len(shown.matched)], [100 * share for share in shown.matched])
    trusted = (frames, [100 * share for share in shown.trusted])
    title = "What is known, over the clip"
    series = {"flow matched to the next frame": matched, "still scene, depth with confidence": trusted}
    yield {"title": title, "chart": line_chart(series, title=title, x_label="frame", y_label="% of the pixels")}
    if scene.has_tracks:
        tracks, title = scene.tracks, "Points followed, over the clip"
        counts = {name: tracks.visible[tracks.moving == moving].sum(0) for name, moving in (("static", False), ("moving", True))}
        series = {name: (frames, values[frames].tolist()) for name, values in counts.items()}
        yield {"title": title, "chart": line_chart(series, title=title, x_label="frame", y_label="points")}
