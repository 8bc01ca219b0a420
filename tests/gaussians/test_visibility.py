"""What the clip has seen of a view: a wall and an object before it, seen from places that are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pytest

from flowsplat.gaussians.renderer import Rendering
from flowsplat.gaussians.visibility import FEWEST, FURTHEST, ClipVisibility
from flowsplat.geometry import Camera
from flowsplat.geometry.cameras import pixel_grid

WALL = 4.0
WIDTH, HEIGHT = 128, 64


@dataclass
class WallAndBillboard:
    """The wall z = ``WALL``, endless, and before it a billboard that moves: what ``part`` says of them."""

    billboard_depth: float = 2.0
    shown: str = "all"

    def render(self, camera: Camera, t: float, flow_to: tuple[Camera, float] | None = None) -> Rendering:
        grid = pixel_grid(camera.width, camera.height).astype(np.float64)
        rays = camera.unproject(grid, np.ones(grid.shape[:2])) - camera.center
        depth = np.full(grid.shape[:2], WALL - camera.center[2])
        at_billboard = camera.center + rays * (self.billboard_depth - camera.center[2])
        on_billboard = (np.abs(at_billboard[..., 0]) < 0.3) & (np.abs(at_billboard[..., 1]) < 0.3)
        depth = np.full_like(depth, self.billboard_depth - camera.center[2]) if self.shown == "objects" else depth
        alpha = on_billboard if self.shown == "objects" else np.ones_like(on_billboard)
        return Rendering(np.zeros((*depth.shape, 3), np.float32), alpha.astype(np.float32), depth.astype(np.float32), None)

    def part(self, part: str) -> WallAndBillboard:
        return WallAndBillboard(self.billboard_depth, part)

    def at_distances(self, factors: object, times: Sequence[float], cameras: Sequence[Camera]) -> WallAndBillboard:
        return self

    def fade_by_confidence(self, times: Sequence[float], cameras: Sequence[Camera]) -> WallAndBillboard:
        return self


def camera_at(x: float, z: float = 0.0) -> Camera:
    viewmat = np.eye(4)
    viewmat[:3, 3] = [-x, 0, -z]
    return Camera(viewmat, np.array([[100.0, 0, WIDTH / 2], [0, 100.0, HEIGHT / 2], [0, 0, 1]]), WIDTH, HEIGHT)


def visibility_of(places: Sequence[float]) -> ClipVisibility:
    return ClipVisibility(WallAndBillboard(), [camera_at(x) for x in places], np.linspace(0, 1, len(places)).tolist())


def test_a_view_of_the_clip_is_known_but_for_its_rim_and_what_the_object_hid():
    places = np.linspace(-0.5, 0.5, 9)
    seen = visibility_of(places).compute_seen(camera_at(0.0), 0.5)
    assert seen.there.all()
    height, width = seen.there.shape
    assert seen.moves[height // 2, width // 2]
    assert not seen.moves[0, 0]
    column = 8  # in the rows above the billboard nothing hides the wall, so only the borders of the images count
    x = (column + 0.5 - width / 2) / (100 * width / WIDTH) * WALL
    pixels = (x - places) / WALL * 100 + WIDTH / 2
    assert seen.frames[1, column] == ((pixels >= 0) & (pixels < WIDTH)).sum()


def test_directions_are_compared_with_those_that_saw_it():
    places = np.linspace(-0.2, 0.2, 9)
    visibility = visibility_of(places)
    row, middle = 1, 32
    for x in (0.0, 0.5, 1.0):
        # The camera looks at the wall's middle column, which all nine cameras see.
        camera = camera_at(x)
        column = int((0 - x) / WALL * 50 + middle)
        seen = visibility.compute_seen(camera, 0.5)
        point = np.array([(column + 0.5 - 32) / 50 * WALL + x, (row + 0.5 - 16) / 50 * WALL, WALL])
        rays = np.stack([camera_at(place).center - point for place in places])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        mean = rays.mean(0)
        spread = np.sqrt(((rays - mean) ** 2).sum(1).mean())
        new = (camera.center - point) / np.linalg.norm(camera.center - point)
        assert seen.frames[row, column] == 9
        assert seen.off[row, column] == pytest.approx(np.linalg.norm(new - mean / np.linalg.norm(mean)) / spread, rel=1e-6)


def test_what_only_the_object_showed_is_unknown():
    """All cameras stand at one side of a billboard that is close: the wall behind it, seen from the other side, nobody saw."""
    visibility = visibility_of([0.0, 0.01, 0.02, 0.03])
    aside = visibility.compute_seen(camera_at(0.8), 0.5)
    hidden = (aside.frames < FEWEST) & ~aside.moves
    assert hidden[16].sum() > 5
    assert not aside.is_known[hidden].any()


def test_a_camera_that_stood_still_tells_no_view_from_aside():
    visibility = visibility_of([0.0, 0.0, 0.0])
    own, aside = visibility.compute_seen(camera_at(0.0), 0.5), visibility.compute_seen(camera_at(0.4), 0.5)
    assert own.is_known.all()
    assert not aside.is_known[~aside.moves].any()
    narrow = visibility_of(np.linspace(-0.01, 0.01, 5)).compute_seen(camera_at(0.4), 0.5)
    assert (narrow.off[narrow.frames > FEWEST] > FURTHEST).all()


def test_cameras_close_to_an_object_are_told():
    visibility = visibility_of(np.linspace(-0.5, 0.5, 5))
    assert visibility.keeps_clear(camera_at(0.2), camera_at(0.0), 0.5)
    assert visibility.keeps_clear(camera_at(0.0, 0.9), camera_at(0.0), 0.5)
    assert not visibility.keeps_clear(camera_at(0.0, 1.2), camera_at(0.0), 0.5)
