"""A world small enough to render exactly: a textured wall, and a textured billboard that slides in front of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from flowsplat.gaussians.renderer import Rendering
from flowsplat.geometry import Camera, Similarity
from flowsplat.geometry.cameras import pixel_grid
from flowsplat.scenes import Depth, Flow, HeldoutView, Scene

WIDTH, HEIGHT, FPS, COUNT = 80, 64, 10.0, 12
K = np.array([[80.0, 0, 40], [0, 80, 32], [0, 0, 1]])
WALL, BILLBOARD = 4.0, 2.0


def camera_at(x: float, y: float = 0.0, angle: float = 0.0) -> Camera:
    """A camera on the plane z = 0, turned about the vertical."""
    R = np.array([[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]])
    viewmat = np.eye(4)
    viewmat[:3, :3] = R
    viewmat[:3, 3] = -R @ [x, y, 0]
    return Camera(viewmat, K, WIDTH, HEIGHT)


def billboard_position(t: float) -> np.ndarray:
    return np.array([0.5 * t - 0.3, 0.1 * t, 0])


@dataclass(frozen=True)
class World:
    """Renders the truth as images with 8 bits, in the coordinates that ``similarity`` makes of the true ones."""

    similarity: Similarity = field(default_factory=Similarity)
    moves: bool = True

    def _hits(self, camera: Camera, t: float) -> tuple[np.ndarray, np.ndarray]:
        """World points [H, W, 3] and where they are on the billboard [H, W]."""
        ends = camera.unproject(pixel_grid(camera.width, camera.height), np.ones((camera.height, camera.width)))
        rays = ends - camera.center
        walls, billboards = (camera.center + rays * ((z - camera.center[2]) / rays[..., 2:]) for z in (WALL, BILLBOARD))
        on_billboard = (np.abs(billboards - billboard_position(t))[..., :2] < [0.45, 0.35]).all(-1)
        return np.where(on_billboard[..., None], billboards, walls), on_billboard

    def mask(self, camera: Camera, t: float) -> np.ndarray:
        return self._hits(camera, t)[1]

    def render(self, camera: Camera, t: float, flow_to: tuple[Camera, float] | None = None) -> Rendering:
        t = t if self.moves else 0.0
        back = self.similarity.inverse()
        camera = back.camera(camera)
        points, on_billboard = self._hits(camera, t)
        own = points - on_billboard[..., None] * billboard_position(t)
        phases = own[..., :1] * [7, 9, 11] + own[..., 1:2] * [8, -6, 5] + on_billboard[..., None] * [1.0, 2.0, 3.0]
        color = np.round((0.5 + 0.4 * np.sin(phases)) * 255) / 255
        _, depth = camera.project(points)
        flow = None
        if flow_to is not None:
            moved = points + on_billboard[..., None] * (billboard_position(flow_to[1]) - billboard_position(t))
            flow = back.camera(flow_to[0]).project(moved)[0] - pixel_grid(camera.width, camera.height)
        depth = depth * self.similarity.scale
        alpha = np.ones(depth.shape, np.float32)
        return Rendering(color.astype(np.float32), alpha, depth.astype(np.float32), flow)


def build(
    folder: Path,
    *,
    holdout: int | None = 5,
    views: bool = True,
    truth: bool = True,
    masks: bool = True,
    full_masks: bool = False,
    similarity: Similarity | None = None,
) -> Scene:
    """The world as a prepared scene. ``similarity`` moves the cameras away from the truth, as an estimate would."""
    world, moved = World(), similarity or Similarity()
    times = [i / FPS for i in range(COUNT)]
    scene = Scene.create(
        folder,
        name="tiny",
        source="test",
        width=WIDTH,
        height=HEIGHT,
        timestamps=times,
        holdout=holdout,
        source_fps=FPS,
    )
    true = [camera_at(0.03 * i, 0.01 * i * (i % 3), 0.01 * i) for i in range(COUNT)]
    certain = np.ones((HEIGHT, WIDTH), np.float32)
    scene.write_cameras([moved.camera(camera) for camera in true])
    scene.finish_prior("cameras", method="estimated" if similarity else "truth")
    true_layers = scene.create_truth() if truth else None
    if true_layers is not None:
        true_layers.write_cameras(true)
    pairs = dict(pairwise(scene.train_frames))
    for i in range(COUNT):
        j = pairs.get(i)
        shown = world.render(true[i], times[i], None if j is None else (true[j], times[j]))
        scene.write_frame(i, (shown.color * 255 + 0.5).astype(np.uint8))
        mask = np.ones((HEIGHT, WIDTH), np.uint8) if full_masks else world.mask(true[i], times[i])
        if masks:
            (scene if i in scene.train_frames else scene.heldout_masks).write_mask(i, mask)
        if j is not None and shown.flow is not None:
            scene.write_flow(Flow(i, j, shown.flow, certain))
        if true_layers is not None:
            true_layers.write_depth(i, Depth(shown.depth, certain))
            if masks:
                true_layers.write_mask(i, mask)
            if j is not None and shown.flow is not None:
                true_layers.write_flow(Flow(i, j, shown.flow, certain))
    if views:
        for name, frame, camera in (("left", 0, camera_at(-0.2)), ("right", 4, camera_at(0.35, 0.05, 0.06))):
            color = world.render(camera, times[frame]).color
            mask = np.ones((HEIGHT, WIDTH), bool) if full_masks else world.mask(camera, times[frame])
            image = (color * 255 + 0.5).astype(np.uint8)
            scene.write_view(HeldoutView(name, frame, camera), image, mask if masks else None)
    return Scene(folder)


@pytest.fixture
def world() -> World:
    """The exact renderer."""
    return World()


@pytest.fixture
def build_scene(tmp_path):
    """``build`` in a fresh folder."""
    return lambda **options: build(tmp_path / "scene", **options)
