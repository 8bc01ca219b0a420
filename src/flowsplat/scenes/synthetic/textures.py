"""Procedural colors: sums of plane waves and soft-edged patterns, filtered to what a pixel can show.

A texture lives in the meters of its body, so that it moves, turns and stretches with it. Nothing in it is finer than
the pixel that looks at it: each octave of waves fades out before its wavelength reaches two pixels, and every edge is
one and a half pixels wide (the "clamping" of Norton, Rockwood and Skolmoski, SIGGRAPH 1982).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

CHUNK_POINTS = 8192
"""Points that are textured at once: small enough for the temporaries to stay in the cache. Chosen by eye."""


@dataclass(frozen=True)
class Surface:
    """Points on a body that want a color.

    Attributes:
        points: [N, 3] meters in the axes of the body at rest.
        face: [N] which face of a box: 2 * axis + (1 on the positive side); 0 everywhere on an ellipsoid.
        footprint: [N] meters that a pixel covers on the surface.
    """

    points: np.ndarray
    face: np.ndarray
    footprint: np.ndarray

    def where(self, chosen: np.ndarray | slice) -> Surface:
        """Return the part of the surface that ``chosen`` picks."""
        return Surface(self.points[chosen], self.face[chosen], self.footprint[chosen])

    @property
    def plane(self) -> tuple[np.ndarray, np.ndarray]:
        """Two coordinates [N] on the face of a box; on upright faces the second one points up."""
        x, y, z = self.points.T
        axis = self.face // 2
        return np.where(axis == 0, y, x), np.where(axis == 2, y, z)


Material = Callable[[Surface], np.ndarray]
"""Gives a surface its colors [N, 3], display values between 0 and 1 (a little outside is clipped by the renderer)."""


def spiral(count: int) -> np.ndarray:
    """Return [count, 3] unit vectors, evenly spread over the sphere from pole to pole (a Fibonacci spiral)."""
    turn = np.arange(count) + 0.5
    height, angle = 1 - 2 * turn / count, np.pi * (1 + 5**0.5) * turn
    ring = np.sqrt(1 - height**2)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), height], -1)


class Waves:
    """A smooth random field: several octaves of plane waves with evenly spread directions and random phases.

    Args:
        wavelength: meters, of the longest octave; each further octave halves it.
        octaves: how many.
        channels: fields that are made of the same waves with weights of their own.
        stretch: scale of the field along each axis; 4 makes it four times as long.
    """

    WAVES, DECAY = 9, 0.8

    def __init__(
        self,
        rng: np.random.Generator,
        wavelength: float,
        octaves: int = 4,
        channels: int = 3,
        stretch: tuple[float, float, float] = (1, 1, 1),
    ):
        self.channels = channels
        self._bands = []
        power = sum(self.DECAY ** (2 * o) for o in range(octaves)) * self.WAVES / 2
        for octave in range(octaves):
            length = wavelength / 2**octave
            directions = spiral(2 * self.WAVES)[: self.WAVES] @ Rotation.random(random_state=rng).as_matrix()
            vectors = directions * (2 * np.pi / length * rng.uniform(0.8, 1.2, (self.WAVES, 1))) / stretch
            phases = rng.uniform(0, 2 * np.pi, self.WAVES)
            weights = rng.normal(size=(self.WAVES, channels)) * (self.DECAY**octave / np.sqrt(power))
            self._bands.append((length, *(a.astype(np.float32) for a in (vectors, phases[:, None], weights.T))))

    def __call__(self, surface: Surface) -> np.ndarray:
        """Return [N, channels] with a mean of 0 and a standard deviation of about 1."""
        # Single precision: NumPy's cosine is twenty times faster there, and 1e-4 rad are far below a gray level.
        points, footprint = surface.points.T.astype(np.float32), surface.footprint.astype(np.float32)
        field = np.zeros((self.channels, len(footprint)), np.float32)
        for length, vectors, phases, weights in self._bands:
            fade = np.clip(length / footprint / 2 - 1, 0, 1)
            if fade.any():
                field += fade * (weights @ np.cos(vectors @ points + phases))
        return field.T


def in_chunks(material: Material, surface: Surface) -> np.ndarray:
    """``material(surface)``, a part at a time."""
    colors = np.empty_like(surface.points)
    for start in range(0, len(colors), CHUNK_POINTS):
        colors[start : start + CHUNK_POINTS] = material(surface.where(slice(start, start + CHUNK_POINTS)))
    return colors


def gradient(value: np.ndarray, colors: Sequence[Sequence[float]]) -> np.ndarray:
    """Return [N, 3]: the colors, evenly spread over values from -2 to 2."""
    stops = np.linspace(-2, 2, len(colors))
    return np.stack([np.interp(value, stops, channel) for channel in np.array(colors, float).T], -1)


def inside(distance: np.ndarray, footprint: np.ndarray) -> np.ndarray:
    """Return [N] 1 where the signed distance (meters) is negative, 0 where positive, with an edge 1.5 pixels wide."""
    return np.clip(0.5 - distance / (1.5 * footprint), 0, 1)


def blend(below: np.ndarray, above: np.ndarray | Sequence[float], amount: np.ndarray) -> np.ndarray:
    """Return [N, 3]: ``above`` over ``below``, ``amount`` [N] between 0 and 1."""
    return below + amount[:, None] * (np.asarray(above) - below)


def to_line(x: np.ndarray, period: float) -> np.ndarray:
    """Return [N] distance to the nearest multiple of ``period``."""
    return np.abs(x - period * np.round(x / period))


def scatter(*cells: np.ndarray) -> np.ndarray:
    """Return [N] a fixed pseudo-random number between 0 and 1 for each combination of whole numbers."""
    mixed = sum(cell * weight for cell, weight in zip(cells, (127.1, 311.7, 74.7), strict=False))
    return np.modf(np.abs(np.sin(mixed + 0.5)) * 43758.5453)[0]


# -- materials


def stone(rng: np.random.Generator, wavelength: float, colors: Sequence[Sequence[float]]) -> Material:
    """Veined and speckled, solid (the same pattern goes through the body)."""
    waves = Waves(rng, wavelength, octaves=5)

    def material(surface: Surface) -> np.ndarray:
        field = waves(surface)
        return gradient(1.3 * field[:, 0], colors) * (1 + 0.1 * np.tanh(3 * field[:, 1:2]))

    return material


def planks(
    rng: np.random.Generator, width: float, length: float, colors: Sequence[Sequence[float]], grain: float = 0.8
) -> Material:
    """Boards along the first coordinate of each face, every one with a tone of its own."""
    waves = Waves(rng, grain, octaves=5, stretch=(3, 1, 1))

    def material(surface: Surface) -> np.ndarray:
        a, b = surface.plane
        row = np.floor(b / width)
        a = a + scatter(row) * length
        field = waves(surface)
        tone = 3 * scatter(row, np.floor(a / length), surface.face) - 1.5
        wood = gradient(0.6 * tone + 0.9 * field[:, 0], colors) * (1 + 0.1 * np.tanh(3 * field[:, 1:2]))
        gap = np.minimum(to_line(b, width), to_line(a, length)) - 0.012
        return blend(wood, np.multiply(colors[0], 0.45), inside(gap, surface.footprint))

    return material


def blocks(
    rng: np.random.Generator, width: float, height: float, colors: Sequence[Sequence[float]], mortar: Sequence[float]
) -> Material:
    """Rough masonry in shifted rows."""
    waves = Waves(rng, 0.9, octaves=5)

    def material(surface: Surface) -> np.ndarray:
        a, b = surface.plane
        field = waves(surface)
        row = np.floor(b / height)
        a = a + 0.5 * width * (row % 2)
        tone = 2.4 * scatter(row, np.floor(a / width), surface.face) - 1.2
        face = gradient(0.8 * tone + 0.8 * field[:, 0], colors) * (1 + 0.09 * np.tanh(3 * field[:, 1:2]))
        joint = np.minimum(to_line(a, width), to_line(b, height)) - 0.02 - 0.006 * field[:, 2]
        return blend(face, mortar, inside(joint, surface.footprint))

    return material


def patchwork(rng: np.random.Generator, cell: float, colors: Sequence[Sequence[float]]) -> Material:
    """Return square fields in many colors, each with a spot or a diamond in another one."""
    waves = Waves(rng, 0.5, octaves=4, channels=1)
    palette = np.array(colors, float)

    def pick(number: np.ndarray) -> np.ndarray:
        return palette[(number * len(palette)).astype(int)]

    def material(surface: Surface) -> np.ndarray:
        a, b = (coordinate / cell for coordinate in surface.plane)
        row, column = np.floor(b), np.floor(a)
        x, y = a - column - 0.5, b - row - 0.5
        kind = scatter(row, column, surface.face + 11)
        spot = np.where(kind < 0.5, np.hypot(x, y), np.abs(x) + np.abs(y)) - 0.3
        result = blend(
            pick(scatter(row, column, surface.face)),
            pick(scatter(column, row, surface.face + 5)),
            inside(spot * cell, surface.footprint),
        )
        seam = np.minimum(to_line(a, 1), to_line(b, 1)) * cell - 0.012
        result = blend(result, (0.16, 0.14, 0.14), inside(seam, surface.footprint))
        return result * (1 + 0.12 * np.tanh(1.5 * waves(surface)))

    return material


def segments(
    rng: np.random.Generator, count: int, radius: float, colors: Sequence[Sequence[float]], dot: Sequence[float]
) -> Material:
    """Return a beach ball: colored segments from pole to pole, and dots all over."""
    waves = Waves(rng, 0.5, octaves=4, channels=1)
    palette = np.array(colors, float)
    dots = spiral(40).T

    def material(surface: Surface) -> np.ndarray:
        unit = surface.points / radius
        longitude = np.arctan2(unit[:, 1], unit[:, 0]) / (2 * np.pi) * count
        result = palette[np.floor(longitude).astype(int) % len(palette)]
        along = to_line(longitude, 1) * (2 * np.pi / count) * np.hypot(unit[:, 0], unit[:, 1])
        result = blend(result, (0.97, 0.96, 0.92), inside(along * radius - 0.02, surface.footprint))
        away = np.arccos(np.clip((unit @ dots).max(1), -1, 1)) - 0.13
        result = blend(result, dot, inside(away * radius, surface.footprint))
        return result * (1 + 0.12 * np.tanh(1.5 * waves(surface)))

    return material


def swirls(rng: np.random.Generator, wavelength: float, colors: Sequence[Sequence[float]], edge: float) -> Material:
    """Bands that wind round the body: the level lines of one smooth field, with speckles of another."""
    slow, fast = Waves(rng, wavelength, octaves=2, channels=1), Waves(rng, 0.3, octaves=3, channels=1)
    palette = np.array(colors, float)

    def material(surface: Surface) -> np.ndarray:
        level = 2.2 * slow(surface)[:, 0]
        band = np.floor(level).astype(int)
        result = palette[band % len(palette)]
        field = fast(surface)
        seam = to_line(level, 1) * wavelength / 12 - edge
        result = blend(result, (0.15, 0.1, 0.2), inside(seam, surface.footprint))
        return result * (1 + 0.14 * np.tanh(1.5 * field))

    return material
