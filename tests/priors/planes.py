"""A small clip whose every pixel is known: a textured wall, and perhaps a textured square that moves before it."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from flowsplat.geometry import Camera
from flowsplat.scenes import Depth, Flow, Scene, Tracks

WIDTH, HEIGHT, FRAMES = 128, 80, 12
FOCAL, WALL = 100.0, 4.0
SIDE = 28


def texture(seed: int, width: int, height: int) -> np.ndarray:
    """RGB [height, width, 3] uint8 with detail at several sizes."""
    rng = np.random.default_rng(seed)
    image = np.zeros((height, width, 3), np.float32)
    for sigma, strength in ((1.0, 1.0), (2.5, 2.0), (6.0, 4.0)):
        noise = rng.normal(size=(height, width, 3)).astype(np.float32)
        smooth = cv2.GaussianBlur(noise, (0, 0), sigma)
        image += strength * smooth / smooth.std()
    image = image / image.std() * 45 + (90 if seed else 150)
    return np.clip(image, 0, 255).astype(np.uint8)


def camera_at(shift: float) -> Camera:
    """The camera that sees the wall ``shift`` pixels to the left of where the first one sees it."""
    viewmat = np.eye(4)
    viewmat[0, 3] = -shift * WALL / FOCAL
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    return Camera(viewmat, K, WIDTH, HEIGHT)


def square_at(i: int) -> tuple[int, int]:
    """Left and top of the square in frame ``i``."""
    return 20 + 3 * i, 12 + 2 * i


def write_planes(folder: Path, *, step: int, square: bool, holdout: int | None = None) -> Scene:
    """A scene with cameras that move by ``step`` pixels of the wall a frame, and with truth; no priors but cameras."""
    scene = Scene.create(
        folder, name="planes", source="planes", width=WIDTH, height=HEIGHT,
        timestamps=[i / 24 for i in range(FRAMES)], holdout=holdout, source_fps=24.0,
    )  # fmt: skip
    wall, body = texture(0, WIDTH + step * FRAMES, HEIGHT), texture(1, SIDE, SIDE)
    cameras = [camera_at(step * i) for i in range(FRAMES)]
    truth = scene.create_truth()
    truth.write_cameras(cameras)
    for i in range(FRAMES):
        frame = wall[:, step * i : step * i + WIDTH].copy()
        mask = np.zeros((HEIGHT, WIDTH), np.uint8)
        if square:
            x, y = square_at(i)
            frame[y : y + SIDE, x : x + SIDE] = body
            mask[y : y + SIDE, x : x + SIDE] = 1
        scene.write_frame(i, frame)
        truth.write_mask(i, mask)
        depth = np.where(mask > 0, np.float32(WALL / 2), np.float32(WALL))
        truth.write_depth(i, Depth(depth, np.ones_like(depth)))
        for j in (i - 1, i + 1):
            if 0 <= j < FRAMES:
                flow = np.where(mask[..., None] > 0, np.float32([3, 2]), np.float32([-step, 0])) * np.float32(j - i)
                truth.write_flow(Flow(i, j, flow, np.ones((HEIGHT, WIDTH), np.float32)))
    points = np.zeros((2, FRAMES, 3), np.float32)
    points[..., 2] = WALL
    seen = np.ones((2, FRAMES), bool)
    truth.write_tracks(Tracks(points, seen, seen.astype(np.float32), np.array([False, True])))
    scene.write_cameras(cameras)
    scene.finish_prior("cameras", method="truth")
    return scene
