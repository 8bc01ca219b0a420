"""Procedural colors of random worlds: two colors in a pattern, and noise, filtered to what a pixel can show.

A material is a row of numbers, so that kernels can read it; ``COLUMNS`` names them. Its pattern lies in the meters of its
part. Nothing in it is finer than the pixel that looks at it: edges are as wide as a pixel, a pattern whose period is
smaller becomes its mean, and an octave of noise fades out before its wavelength reaches two pixels.
"""

from __future__ import annotations

import math

import numpy as np

from flowsplat.common.kernels import helper, inline

COLUMNS = (
    "pattern", "period", "red", "green", "blue", "other_red", "other_green", "other_blue", "x", "y", "z", "amplitude",
    "wavelength", "octaves", "phase",
)  # fmt: skip
"""``x``, ``y``, ``z``: unit direction of stripes; ``amplitude`` and ``wavelength`` (meters) of the noise."""

PLAIN, STRIPES, CHECKERS, BRICKS, SPOTS, SEGMENTS = range(6)


@inline
def _scatter(x, y, z, phase):
    """A fixed pseudo-random number between 0 and 1 for whole numbers."""
    mixed = (x * 374761393 + y * 668265263 + z * 1274126177 + phase * 362437) & 0xFFFFFFFF
    mixed = ((mixed ^ (mixed >> 13)) * 1274126177) & 0xFFFFFFFF
    return ((mixed ^ (mixed >> 16)) & 0xFFFFFF) / 16777216.0


@helper
def _noise(x, y, z, phase):
    """Smooth random values between -1 and 1, one lattice cell a unit."""
    fx, fy, fz = math.floor(x), math.floor(y), math.floor(z)
    i, j, k = int(fx), int(fy), int(fz)
    a, b, c = x - fx, y - fy, z - fz
    a, b, c = a * a * (3 - 2 * a), b * b * (3 - 2 * b), c * c * (3 - 2 * c)
    total = 0.0
    for di in range(2):
        for dj in range(2):
            for dk in range(2):
                weight = (a if di else 1 - a) * (b if dj else 1 - b) * (c if dk else 1 - c)
                total += weight * _scatter(i + di, j + dj, k + dk, phase)
    return 2 * total - 1


@inline
def _inside(distance, footprint):
    """1 where a signed distance in meters is negative, 0 where positive, with an edge 1.5 pixels wide."""
    return min(max(0.5 - distance / (1.5 * footprint), 0.0), 1.0)


@inline
def _to_line(x, period):
    """Distance to the nearest multiple of ``period``."""
    return abs(x - period * math.floor(x / period + 0.5))


@helper
def _share(m, x, y, z, nx, ny, nz, footprint):
    """How much of the other color is at a point, 0 to 1."""
    pattern, period = int(m[0]), m[1]
    if pattern == PLAIN:
        return 0.0
    fade = min(max(period / footprint / 3 - 0.5, 0.0), 1.0)
    share = 0.5
    if pattern == STRIPES:
        share = _inside(_to_line(x * m[8] + y * m[9] + z * m[10] + 0.37 * period, period) - 0.25 * period, footprint)
    elif pattern == CHECKERS:
        product = 1.0
        for q in range(3):
            # On a face the coordinate across it is the same everywhere: it must not lie on an edge.
            place = (x if q == 0 else (y if q == 1 else z)) + 0.31 * period
            across = abs(nx if q == 0 else (ny if q == 1 else nz)) > 0.9
            if not across:
                product *= 2 * _inside(_to_line(place, 2 * period) - 0.5 * period, footprint) - 1
        share = 0.5 + 0.5 * product
    elif pattern == BRICKS:
        a, b = (y, z) if abs(nx) > 0.7 else ((x, z) if abs(ny) > 0.7 else (x, y))
        row = math.floor(b / (0.5 * period))
        joint = min(_to_line(a + (0.5 * period if int(row) % 2 else 0.0), period), _to_line(b, 0.5 * period))
        share, fade = _inside(joint - 0.03 * period, footprint), 1.0
    elif pattern == SPOTS:
        cx, cy, cz = math.floor(x / period), math.floor(y / period), math.floor(z / period)
        i, j, k, phase = int(cx), int(cy), int(cz), int(m[14])
        ox = x / period - cx - 0.3 - 0.4 * _scatter(i, j, k, phase)
        oy = y / period - cy - 0.3 - 0.4 * _scatter(j, k, i, phase + 7)
        oz = z / period - cz - 0.3 - 0.4 * _scatter(k, i, j, phase + 13)
        share = _inside((math.sqrt(ox * ox + oy * oy + oz * oz) - 0.3) * period, footprint)
    elif pattern == SEGMENTS:
        turn = math.atan2(y, x) / math.pi * 3
        width = max(math.sqrt(x * x + y * y) * math.pi / 3, 1e-6)
        share = _inside((_to_line(turn, 2.0) - 0.5) * width, footprint)
        fade = 1.0
    mean = 0.06 if pattern == BRICKS else (0.12 if pattern == SPOTS else 0.5)
    return mean + fade * (share - mean)


@helper
def albedo(
    m: np.ndarray, x: float, y: float, z: float, nx: float, ny: float, nz: float, footprint: float
) -> tuple[float, float, float]:
    """Color of the point (x, y, z) with unit normal (nx, ny, nz), in a part's axes and meters.

    Args:
        m: [M] the material.
        footprint: meters that a pixel covers there.
    """
    share = _share(m, x, y, z, nx, ny, nz, footprint)
    field, tint, weight = 0.0, 0.0, 1.0
    length = m[12]
    for octave in range(int(m[13])):
        # Every octave has its own axes, so that no face lies along the cells of all.
        x, y, z = 0.8 * y + 0.6 * z, -0.8 * x + 0.36 * y - 0.48 * z, -0.6 * x - 0.48 * y + 0.64 * z
        fade = min(max(length / footprint / 2 - 1, 0.0), 1.0)
        if fade > 0:
            value = fade * weight * _noise(x / length + 17.3 * octave, y / length + 5.1, z / length + 9.7, int(m[14]) + 31 * octave)
            field += value
            if octave % 2 == 0:
                tint += value
        length *= 0.45
        weight *= 0.85
    bright = max(1 + m[11] * field, 0.05)
    hue = 0.25 * m[11] * tint
    red = (m[2] + share * (m[5] - m[2])) * (bright + hue)
    green = (m[3] + share * (m[6] - m[3])) * bright
    blue = (m[4] + share * (m[7] - m[4])) * (bright - hue)
    return max(red, 0.0), max(green, 0.0), max(blue, 0.0)


def draw_material(rng: np.random.Generator, scale: float, rich: bool, patterns: tuple[int, ...] = ()) -> np.ndarray:
    """[M] a random material.

    Args:
        scale: meters of what it covers: pattern and noise fit into it.
        rich: whether it has a pattern and strong noise, or hardly any.
        patterns: those to choose from; none = all but segments.
    """
    chosen = int(rng.choice(patterns or (PLAIN, STRIPES, CHECKERS, BRICKS, SPOTS))) if rich else PLAIN
    base = _draw_color(rng)
    other = _draw_color(rng)
    if np.abs(base - other).sum() < 0.45:
        other = np.clip(base + (0.4 if base.mean() < 0.5 else -0.4), 0.03, 0.95)
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    amplitude = rng.uniform(0.2, 0.45) if rich else rng.uniform(0.02, 0.08)
    return np.array([
        chosen, scale * rng.uniform(0.15, 0.45), *base, *other, *direction, amplitude, scale * rng.uniform(0.3, 1.0),
        5 if rich else 3, rng.integers(1, 10000),
    ])  # fmt: skip


def _draw_color(rng: np.random.Generator) -> np.ndarray:
    """[3] anything between earth and paint, not too dark."""
    gray = rng.uniform(0.2, 0.85)
    return np.clip(gray + rng.choice([0.05, 0.1, 0.2]) * rng.normal(size=3), 0.06, 0.95)
