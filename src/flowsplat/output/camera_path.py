"""The cameras of a clip as drawings: from above with what they see, and at an angle with their frusta."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from flowsplat.common.spread import spread
from flowsplat.geometry import Camera

_WIDTH, _HEIGHT, _DRAWING_MARGIN = 640, 400, 26
"""Size of the drawing and the margin around it, pixels. Chosen by eye."""
_MAX_FRUSTA = 10
"""Cameras that are drawn with what they see; the line of the path has all of them. Chosen by eye."""
_FRUSTUM_LENGTH = 0.22
"""Length of a frustum over the extent of the drawing. Chosen by eye."""
_POINT_SIZE = 2.2
"""Pixels of the side of a scene point. Chosen by eye."""
_SINGLE_PLACE_EXTENT = 1.0
"""Extent of the drawing of cameras that all stand in one place. Chosen by eye."""
_YAW, _PITCH = np.radians(32.0), np.radians(28.0)
"""Under which the path is seen at an angle: from behind, a little from the right and from above. Chosen by eye."""


@dataclass(frozen=True)
class ObjectPath:
    """Where an object was, in the world of the cameras, and where it may have been by one standard deviation.

    Attributes:
        number: that it is called by.
        color: red, green and blue, 0 to 255.
        places: [T, 3] over the frames that see it; ``near`` and ``far`` [T, 3] the same.
    """

    number: int
    color: tuple[int, int, int]
    places: np.ndarray
    near: np.ndarray
    far: np.ndarray


def path_from_above(
    cameras: Sequence[Camera], points: np.ndarray, colors: np.ndarray, objects: Sequence[ObjectPath] = ()
) -> Markup:
    """Return an SVG of the path, the outer rays of some cameras, points of the scene and paths of objects, seen from above.

    Args:
        cameras: in the order of time.
        points: [N, 3] of the scene, in the world of the cameras; may be empty.
        colors: [N, 3] uint8.
        objects: their paths, each with a band of one standard deviation along the rays.
    """
    axes = _level_axes(cameras)[[0, 2]]
    centers = np.array([camera.center for camera in cameras]) @ axes.T
    dots = points @ axes.T
    # A few points far out would make all the rest too small to see.
    bounds = np.percentile(dots, (3, 97), axis=0) if len(dots) else np.zeros((0, 2))
    around = np.concatenate([centers, bounds, *(obj.places @ axes.T for obj in objects)])
    length = _FRUSTUM_LENGTH * _extent(around)
    wedges = [_corners(camera, length)[[0, 1]] @ axes.T for camera in _some(cameras)]
    page = _Page(np.concatenate([around, *wedges]))
    parts = [page.dot(place, color) for place, color in zip(dots, colors, strict=True) if page.shows(place)]
    for camera, wedge in zip(_some(cameras), wedges, strict=True):
        parts.append(page.line(np.array([wedge[0], camera.center @ axes.T, wedge[1]]), "frustum"))
    parts += [page.object_path(obj, axes) for obj in objects]
    title = "The camera path from above, with the scene" + (" and what moves" if objects else "")
    return _svg(title, parts + _track(page, centers))


def path_at_an_angle(cameras: Sequence[Camera]) -> Markup:
    """Return an SVG of the path with some cameras as pyramids, seen from behind and above, as large as it fits."""
    right, down, forward = _level_axes(cameras)
    across = np.cos(_YAW) * right - np.sin(_YAW) * forward
    away = np.sin(_YAW) * right + np.cos(_YAW) * forward
    axes = np.stack([across, np.sin(_PITCH) * away - np.cos(_PITCH) * down])
    centers = np.array([camera.center for camera in cameras])
    length = _FRUSTUM_LENGTH * _extent(centers)
    pyramids = [_corners(camera, length) @ axes.T for camera in _some(cameras)]
    page = _Page(np.concatenate([centers @ axes.T, *pyramids]))
    parts = []
    for camera, corners in zip(_some(cameras), pyramids, strict=True):
        apex = camera.center @ axes.T
        parts.append(page.line(np.concatenate([corners[2:], corners[2:3]]), "frustum"))
        parts += [page.line(np.array([apex, corner]), "frustum") for corner in corners[2:]]
    return _svg("The camera path with its frusta, from behind and above", parts + _track(page, centers @ axes.T))


def _level_axes(cameras: Sequence[Camera]) -> np.ndarray:
    """Return [3, 3] rows right, down and forward of the world as the cameras see it on average."""
    down = np.mean([camera.viewmat[1, :3] for camera in cameras], 0)
    down /= max(float(np.linalg.norm(down)), 1e-12)
    forward = np.mean([camera.viewmat[2, :3] for camera in cameras], 0)
    forward -= (forward @ down) * down
    if np.linalg.norm(forward) < 1e-6:  # Cameras that look every way: then the first one counts.
        return cameras[0].viewmat[:3, :3]
    forward /= np.linalg.norm(forward)
    return np.stack([np.cross(down, forward), down, forward])


def _extent(places: np.ndarray) -> float:
    extent = float(np.ptp(places, axis=0).max())
    return extent if extent > 1e-9 else _SINGLE_PLACE_EXTENT


def _some(cameras: Sequence[Camera]) -> list[Camera]:
    return [cameras[i] for i in spread(len(cameras), _MAX_FRUSTA)]


def _corners(camera: Camera, length: float) -> np.ndarray:
    """Return [6, 3] world points at that depth: the middles of the left and right border, then the four corners in a ring."""
    w, h = camera.width, camera.height
    pixels = np.array([[0, h / 2], [w, h / 2], [0, 0], [w, 0], [w, h], [0, h]])
    return camera.unproject(pixels, np.full(6, length))


class _Page:
    """Places [..., 2] with y up to an SVG that shows all of those given here."""

    def __init__(self, places: np.ndarray):
        low, high = places.min(0), places.max(0)
        room = np.array([_WIDTH, _HEIGHT]) - 2 * _DRAWING_MARGIN
        self._scale = float((room / np.maximum(high - low, 1e-12)).min())
        self._middle = (low + high) / 2

    def place(self, places: np.ndarray) -> np.ndarray:
        return (places - self._middle) * self._scale * [1, -1] + [_WIDTH / 2, _HEIGHT / 2]

    def shows(self, place: np.ndarray) -> bool:
        x, y = self.place(place)
        return bool(0 <= x <= _WIDTH and 0 <= y <= _HEIGHT)

    def dot(self, place: np.ndarray, color: np.ndarray) -> Markup:
        x, y = self.place(place) - _POINT_SIZE / 2
        fill = "#" + "".join(f"{int(c):02x}" for c in color)
        return Markup('<rect x="{:.0f}" y="{:.0f}" width="{}" height="{}" fill="{}"/>').format(x, y, _POINT_SIZE, _POINT_SIZE, fill)

    def object_path(self, obj: ObjectPath, axes: np.ndarray) -> Markup:
        """Return the path of an object with its band, its number where it begins."""
        color = "#{:02x}{:02x}{:02x}".format(*obj.color)
        band = self.place(np.concatenate([obj.near, obj.far[::-1]]) @ axes.T)
        path = self.place(obj.places @ axes.T)
        around, along = ("L".join(f"{x:.1f} {y:.1f}" for x, y in line) for line in (band, path))
        return Markup(
            '<g class="object" fill="{c}" stroke="{c}"><path class="band" d="M{}Z"/><path class="way" d="M{}"/>'
            '<text x="{:.1f}" y="{:.1f}">{}</text></g>'
        ).format(around, along, path[0, 0] + 5, path[0, 1] - 5, obj.number, c=color)

    def line(self, places: np.ndarray, kind: str) -> Markup:
        path = "L".join(f"{x:.1f} {y:.1f}" for x, y in self.place(places))
        return Markup('<path class="{}" d="M{}"/>').format(kind, path)


def _track(page: _Page, centers: np.ndarray) -> list[Markup]:
    """Return the path, with its first and last place."""
    parts = [page.line(centers, "line path")] if len(centers) > 1 else []
    (x, y), (u, v) = page.place(centers[0]), page.place(centers[-1])
    parts.append(Markup('<circle class="start" cx="{:.1f}" cy="{:.1f}" r="5"/>').format(x, y))
    parts.append(Markup('<circle class="end" cx="{:.1f}" cy="{:.1f}" r="4"/>').format(u, v))
    return parts


def _svg(title: str, parts: Sequence[Markup]) -> Markup:
    return Markup('<svg class="chart cameras" viewBox="0 0 {} {}" role="img" aria-label="{}"><title>{}</title>{}</svg>').format(
        _WIDTH, _HEIGHT, title, title, Markup().join(parts)
    )
