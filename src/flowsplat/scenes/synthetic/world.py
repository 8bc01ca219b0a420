"""Define the synthetic world: what is in it, how it moves and where the camera goes. World z is up; meters and seconds."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from flowsplat.geometry import Camera
from flowsplat.geometry.cameras import rigid
from flowsplat.scenes.synthetic.bodies import Body, Motion, Shape
from flowsplat.scenes.synthetic.textures import (
    Material,
    Surface,
    blend,
    blocks,
    inside,
    patchwork,
    planks,
    segments,
    stone,
    swirls,
    to_line,
)

SCENE_DEPTH = 5.0
"""Meters from the camera to the middle of the scene, about. Chosen by eye."""

FOCAL_RATIO = 0.75
"""Focal length over the width of the image. Chosen by eye."""

OAK = [(0.25, 0.15, 0.09), (0.47, 0.30, 0.17), (0.66, 0.46, 0.28), (0.80, 0.62, 0.42)]
CRATE = [(0.30, 0.20, 0.10), (0.62, 0.43, 0.20), (0.78, 0.60, 0.32), (0.90, 0.76, 0.50)]
MASONRY = [(0.33, 0.42, 0.45), (0.48, 0.57, 0.58), (0.63, 0.69, 0.66), (0.80, 0.80, 0.72)]
PLASTER = [(0.55, 0.36, 0.27), (0.70, 0.48, 0.36), (0.80, 0.60, 0.46), (0.88, 0.73, 0.60)]
MARBLE = [(0.16, 0.20, 0.28), (0.55, 0.60, 0.66), (0.88, 0.88, 0.86), (0.97, 0.95, 0.90)]
GRANITE = [(0.18, 0.17, 0.19), (0.40, 0.37, 0.38), (0.60, 0.55, 0.52), (0.85, 0.78, 0.72)]
JADE = [(0.04, 0.20, 0.17), (0.12, 0.42, 0.33), (0.38, 0.66, 0.50), (0.80, 0.90, 0.72)]
CLOTH = [(0.80, 0.24, 0.20), (0.93, 0.70, 0.22), (0.20, 0.42, 0.62), (0.90, 0.86, 0.76), (0.24, 0.52, 0.40)]
TOYS = [(0.89, 0.20, 0.22), (0.98, 0.78, 0.16), (0.12, 0.50, 0.80), (0.95, 0.94, 0.90), (0.16, 0.66, 0.42)]
BALL = [(0.94, 0.26, 0.20), (0.98, 0.95, 0.90), (0.14, 0.48, 0.84), (0.99, 0.80, 0.18)]
JELLY = [(0.98, 0.52, 0.16), (0.86, 0.20, 0.46), (0.99, 0.80, 0.30), (0.52, 0.20, 0.66)]
SEA = [(0.05, 0.20, 0.38), (0.12, 0.48, 0.62), (0.62, 0.82, 0.80), (0.93, 0.90, 0.78)]
SUNSET = [(0.10, 0.08, 0.28), (0.55, 0.16, 0.36), (0.94, 0.42, 0.22), (0.99, 0.84, 0.46)]
FOREST = [(0.07, 0.16, 0.10), (0.20, 0.42, 0.16), (0.72, 0.72, 0.26), (0.96, 0.93, 0.70)]
FRAME_COLOR = (0.30, 0.19, 0.08)
"""Red, green and blue, 0 to 1, of what frames a canvas. Chosen by eye."""


# -- motions


def make_resting(center: tuple[float, float, float], size: np.ndarray, yaw: float = 0.0) -> Motion:
    """Return a body that stays where it is, turned by ``yaw`` degrees about the vertical."""
    A = Rotation.from_euler("z", yaw, degrees=True).as_matrix() * size
    return lambda time: (A, np.array(center, float))


def make_spinning(center: tuple[float, float, float], size: np.ndarray) -> Motion:
    """Spin about a tilted axis, 130 degrees a second, swaying up and down."""
    axis = np.array([0.35, -0.25, 0.9])
    axis /= np.linalg.norm(axis)

    def motion(time: float) -> tuple[np.ndarray, np.ndarray]:
        A = Rotation.from_rotvec(axis * np.radians(25 + 130 * time)).as_matrix() * size
        return A, center + np.array([0.8 * np.sin(1.2 * time - 1), 0, 0.15 * np.sin(2.5 * time)])

    return motion


def make_circling(center: tuple[float, float, float], size: np.ndarray) -> Motion:
    """On a tilted circle round ``center``, 88 degrees a second, rolling on the way."""

    def motion(time: float) -> tuple[np.ndarray, np.ndarray]:
        angle = np.radians(200 + 88 * time)
        A = Rotation.from_rotvec([0, np.radians(20), np.radians(60 * time)]).as_matrix() * size
        return A, center + np.array([1.75 * np.cos(angle), 1.2 * np.sin(angle), 0.45 * np.sin(angle + 0.8)])

    return motion


def make_pulsing(center: tuple[float, float, float], size: np.ndarray) -> Motion:
    """Its three radii swing by a fifth, a third of a period apart, while the body sways sideways."""
    R = Rotation.from_euler("zy", [20, 25], degrees=True).as_matrix()
    phases = np.array([0, 2, 4]) * np.pi / 3

    def motion(time: float) -> tuple[np.ndarray, np.ndarray]:
        A = R * (size * (1 + 0.22 * np.sin(4.5 * time + phases)))
        return A, center + np.array([0.8 * np.sin(1.2 * time - 1), 0, 0.2 * np.cos(2 * time)])

    return motion


# -- the room


def room_material(rng: np.random.Generator) -> Material:
    """Floor boards with a rug, masonry with paintings behind, plastered sides and a boarded ceiling."""
    floor, ceiling = planks(rng, 0.36, 2.2, OAK), planks(rng, 0.5, 3.0, CRATE, grain=1.2)
    wall, side = blocks(rng, 0.9, 0.45, MASONRY, (0.26, 0.27, 0.27)), stone(rng, 1.0, PLASTER)
    weave = patchwork(rng, 0.42, CLOTH)
    # Center and half extents on the wall, in the axes of the room.
    paintings = [
        (-2.9, 0.25, 0.85, 0.62, swirls(rng, 1.6, SEA, 0.01)),
        (-0.55, 0.35, 0.75, 0.75, stone(rng, 0.9, SUNSET)),
        (2.3, 0.2, 1.05, 0.6, stone(rng, 1.3, FOREST)),
    ]

    def floor_with_rug(surface: Surface) -> np.ndarray:
        x, y, _ = surface.points.T
        edge = np.maximum(np.abs(x) - 2.5, np.abs(y - 1.1) - 1.7)
        rug = blend(weave(surface), (0.86, 0.80, 0.66), inside(-0.22 - edge, surface.footprint))
        stripe = inside(to_line(edge + 0.11, 0.22) - 0.035, surface.footprint) * inside(-0.2 - edge, surface.footprint)
        rug = blend(rug, (0.45, 0.12, 0.14), stripe)
        return blend(floor(surface), rug, inside(edge, surface.footprint))

    def wall_with_paintings(surface: Surface) -> np.ndarray:
        x, _, z = surface.points.T
        result = wall(surface)
        for center_x, center_z, half_width, half_height, canvas in paintings:
            edge = np.maximum(np.abs(x - center_x) - half_width, np.abs(z - center_z) - half_height)
            near = edge < 0.3
            part = surface.where(near)
            framed = blend(np.array([FRAME_COLOR]), canvas(part), inside(edge[near] + 0.09, part.footprint))
            result[near] = blend(result[near], framed, inside(edge[near], part.footprint))
        return result

    materials = {0: side, 1: side, 2: wall, 3: wall_with_paintings, 4: floor_with_rug, 5: ceiling}

    def material(surface: Surface) -> np.ndarray:
        colors = np.empty_like(surface.points)
        for face, part in materials.items():
            chosen = surface.face == face
            if chosen.any():
                colors[chosen] = part(surface.where(chosen))
        return colors

    return material


def build_world(seed: int) -> list[Body]:
    """Return the bodies, the room first; ``seed`` decides the textures."""
    rng = np.random.default_rng(seed)
    static: list[tuple[Shape, tuple[float, float, float], tuple[float, float, float], float, Material]] = [
        ("box", (-2.6, 0.9, 0.65), (0.65, 0.65, 0.65), 28, planks(rng, 0.26, 9.0, CRATE, grain=0.5)),
        ("box", (-2.5, 0.95, 1.62), (0.32, 0.32, 0.32), 55, patchwork(rng, 0.32, CLOTH)),
        ("box", (0.6, 1.7, 0.5), (0.4, 0.4, 0.5), 12, stone(rng, 0.5, MARBLE)),
        ("ellipsoid", (0.6, 1.7, 1.5), (0.5, 0.5, 0.5), 0, stone(rng, 0.5, JADE)),
        ("box", (3.3, 1.3, 1.15), (0.45, 0.7, 1.15), -18, blocks(rng, 0.4, 0.28, PLASTER, (0.93, 0.88, 0.78))),
        ("box", (1.75, -1.5, 0.3), (0.34, 0.26, 0.3), 33, stone(rng, 0.35, GRANITE)),
        ("ellipsoid", (-0.9, -1.3, 0.36), (0.36, 0.36, 0.36), 0, stone(rng, 0.4, MARBLE)),
    ]
    room = np.array([5.6, 6.0, 2.1])
    block, ball, jelly = np.array([0.42, 0.38, 0.42]), np.full(3, 0.46), np.array([0.54, 0.54, 0.6])
    return [
        Body("room", room, make_resting((0, -2.6, 2.1), room), room_material(rng)),
        *(
            Body(shape, np.array(size), make_resting(center, np.array(size), yaw), material)
            for shape, center, size, yaw, material in static
        ),
        Body("box", block, make_spinning((-1.0, -0.4, 1.6), block), patchwork(rng, 0.28, TOYS), 1),
        Body("ellipsoid", ball, make_circling((0.1, 0.4, 1.35), ball), segments(rng, 8, 0.46, BALL, (0.1, 0.16, 0.3)), 2),
        Body("ellipsoid", jelly, make_pulsing((1.3, -0.2, 1.5), jelly), swirls(rng, 0.9, JELLY, 0.012), 3),
    ]


# -- the camera


def camera_at(time: float, width: int, height: int) -> Camera:
    """On an arc from left to right that comes nearer and rises in the middle; the gaze follows at most of its pace."""
    angle = np.radians(-52 + 64 * time)
    position = np.array([3.1 * np.sin(angle), -4.9 + 0.9 * np.cos(angle), 1.75 + 0.4 * np.cos(2 * angle)])
    target = np.array([0.8 * position[0], 0.6, 1.15])
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    focal = FOCAL_RATIO * width
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Camera(rigid(R, -R @ position), K, width, height)
