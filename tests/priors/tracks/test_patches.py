"""Patches are found again moved, turned, stretched and under another light, and not where they are hidden."""

from __future__ import annotations

import cv2
import numpy as np

from flowsplat.priors.tracks.patches import PATCH_SIDE, Patches, align

from .textures import texture

CENTER = np.array([75.0, 55.0])


def turned(image: np.ndarray, degrees: float, scale: float, shift: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """The image turned round ``CENTER`` and moved, and how: offsets there = shape @ offsets here."""
    c, s = scale * np.cos(np.radians(degrees)), scale * np.sin(np.radians(degrees))
    shape = np.array([[c, -s], [s, c]])
    matrix = np.concatenate([shape, (CENTER - shape @ CENTER + shift)[:, None]], 1)
    return cv2.warpAffine(image, matrix, image.shape[::-1], flags=cv2.INTER_CUBIC).astype(np.float32), shape


def some_patches(image: np.ndarray, labels: np.ndarray | None = None) -> tuple[Patches, np.ndarray]:
    points = CENTER + np.stack(np.meshgrid([-20.0, 0, 20], [-20.0, 0, 20]), -1).reshape(-1, 2)
    labels = np.zeros(image.shape, np.int32) if labels is None else labels
    return Patches.cut(image.astype(np.float32), labels, points), points


def test_a_turned_and_brighter_patch_is_found():
    image = texture(110, 150)
    patches, points = some_patches(image)
    rotated, shape = turned(image, 8, 1.05, (1.3, -0.7))
    true = (points - CENTER) @ shape.T + CENTER + [1.3, -0.7]
    found, shapes, likeness = align(patches, 0.9 * rotated + 5, true + [0.8, 0.6], np.tile(np.eye(2), (9, 1, 1)))
    assert np.linalg.norm(found - true, axis=1).max() < 0.1
    assert np.abs(shapes - shape).max() < 0.08
    assert likeness.min() > 0.9


def test_what_is_hidden_does_not_look_like_it():
    patches, points = some_patches(texture(110, 150))
    _, _, likeness = align(patches, texture(110, 150, seed=1).astype(np.float32), points, np.tile(np.eye(2), (9, 1, 1)))
    assert np.median(likeness) < 0.6


def test_the_background_of_a_patch_does_not_count():
    """Left of its edge an object shows another background in the next image."""
    image, behind = texture(110, 150), texture(110, 150, seed=1)
    labels = np.zeros(image.shape, np.int32)
    labels[:, 73:] = 1
    patches, _ = some_patches(image, labels)
    edge = patches[np.array([4])]
    assert edge.weights[0].reshape(PATCH_SIDE, PATCH_SIDE)[:, : PATCH_SIDE // 2 - 2].sum() == 0
    assert abs(edge.weights[0].sum() - 1) < 1e-5
    hidden = np.where(labels > 0, image, behind).astype(np.float32)
    found, _, likeness = align(edge, hidden, CENTER[None] + 0.5, np.eye(2)[None])
    assert np.abs(found - CENTER).max() < 0.1
    assert likeness[0] > 0.95


def test_borders_and_nothing_at_all():
    image = texture(40, 50).astype(np.float32)
    corner = Patches.cut(image, np.zeros(image.shape, np.int32), np.array([[0.0, 0.0], [49, 39]]))
    found, _, likeness = align(corner, image, np.array([[0.0, 0.0], [49, 39]]), np.tile(np.eye(2), (2, 1, 1)))
    assert np.abs(found - [[0, 0], [49, 39]]).max() < 0.05
    assert likeness.min() > 0.99
    assert np.isfinite(align(corner, image, np.array([[-500.0, 3], [900, 3]]), np.tile(np.eye(2), (2, 1, 1)))[0]).all()
    none = corner[np.zeros(0, int)]
    assert align(none, image, np.zeros((0, 2)), np.zeros((0, 2, 2)))[0].shape == (0, 2)
