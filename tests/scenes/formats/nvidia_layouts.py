"""A scene of our own written in the three layouts of the NVIDIA scenes, exactly as other people's code writes them."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from flowsplat.geometry import Camera
from flowsplat.scenes.synthetic import SyntheticScene

CAMERAS = 12


def rig_camera(spec: SyntheticScene, number: int) -> Camera:
    """One of the fixed cameras: twelve places beside each other, each turned a little, none where the clip's own camera is."""
    base, x = spec.camera(0), (number - 5.5) / 5.5
    angle = 0.03 * x
    R = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    viewmat = np.eye(4)
    viewmat[:3, :3] = R @ base.viewmat[:3, :3]
    viewmat[:3, 3] = R @ base.viewmat[:3, 3] + [-0.25 * x, 0.02 * number, 0]
    return Camera(viewmat, base.K, spec.width, spec.height)


def scaled(camera: Camera, factor: int) -> Camera:
    return camera.resize(camera.width * factor, camera.height * factor)


def make_image(spec: SyntheticScene, camera: Camera, time: int) -> np.ndarray:
    return spec.render(camera, spec.timestamps[time]).image


def write(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = image if image.ndim == 2 else image[..., ::-1]
    jpeg = [cv2.IMWRITE_JPEG_QUALITY, 98, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    ok, encoded = cv2.imencode(path.suffix, image, jpeg if path.suffix == ".jpg" else [])
    assert ok
    encoded.tofile(path)


def llff_row(camera: Camera) -> np.ndarray:
    """[17]: the 3x5 matrix by rows, with camera axes down, right, back and the column height, width, focal; near, far."""
    c2w = np.linalg.inv(camera.viewmat)
    right, down, forward, center = c2w[:3].T
    hwf = np.array([camera.height, camera.width, camera.K[0, 0]])
    return np.concatenate([np.stack([down, right, -forward, center, hwf], 1).ravel(), [1.0, 20.0]])


def write_raw(folder: Path, spec: SyntheticScene, rows: int = CAMERAS) -> None:
    """``mv_images``, ``mv_masks`` and ``poses_bounds.npy`` with ``rows`` rows, at the full size that the poses name."""
    folder.mkdir(parents=True)
    np.save(folder / "poses_bounds.npy", np.stack([llff_row(rig_camera(spec, n % CAMERAS)) for n in range(rows)]))
    for t in range(spec.frames):
        for c in range(CAMERAS):
            view = spec.render(rig_camera(spec, c), spec.timestamps[t])
            write(folder / "mv_images" / f"{t:05d}" / f"cam{c + 1:02d}.jpg", view.image)
            write(folder / "mv_masks" / f"{t:05d}" / f"cam{c + 1:02d}.png", (view.mask > 0).astype(np.uint8) * 255)


def write_twelve(folder: Path, spec: SyntheticScene, targets: Path | None = None) -> None:
    """``images`` at twice the size of ``v000_t*.png``; the poses name a size of their own."""
    folder.mkdir(parents=True)
    np.save(folder / "poses_bounds.npy", np.stack([llff_row(scaled(rig_camera(spec, i), 4)) for i in range(spec.frames)]))
    for t in range(spec.frames):
        write(folder / "images" / f"{t:03d}.png", make_image(spec, scaled(rig_camera(spec, t), 2), t))
        write((targets or folder) / f"v000_t{t:03d}.png", make_image(spec, rig_camera(spec, 0), t))


def write_nerfies(folder: Path, spec: SyntheticScene) -> None:
    """Camera 4 to train, 3, 5 and 6 to test."""
    for split, cameras in (("train", [4]), ("val", [3, 5, 6])):
        names = [(c, t) for c in cameras for t in range(spec.frames)]
        values = {
            "frame_names": [f"{c}_{t:05d}" for c, t in names],
            "time_ids": [t for _, t in names],
            "camera_ids": [c for c, _ in names],
        }
        (folder / "splits").mkdir(parents=True, exist_ok=True)
        (folder / "splits" / f"{split}.json").write_text(json.dumps(values))
        for c, t in names:
            camera = rig_camera(spec, c)
            value = {
                "focal_length": camera.K[0, 0], "principal_point": camera.K[:2, 2].tolist(),
                "image_size": [camera.width, camera.height], "orientation": camera.viewmat[:3, :3].tolist(),
                "position": camera.center.tolist(), "pixel_aspect_ratio": 1.0, "skew": 0.0,
                "radial_distortion": [0.0, 0.0, 0.0], "tangential_distortion": [0.0, 0.0],
            }  # fmt: skip
            (folder / "camera").mkdir(exist_ok=True)
            (folder / "camera" / f"{c}_{t:05d}.json").write_text(json.dumps(value))
            write(folder / "rgb" / "1x" / f"{c}_{t:05d}.png", make_image(spec, camera, t))
    (folder / "scene.json").write_text(json.dumps({"scale": 1.0, "near": 1.0, "far": 20.0, "center": [0, 0, 0]}))
    (folder / "dataset.json").write_text(json.dumps({"count": 4 * spec.frames, "num_exemplars": spec.frames}))
