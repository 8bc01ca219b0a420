"""A tiny data root: the built-in clip as a rig scene and as a clip with masks, and a pair of images with known flow."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from flowsplat.scenes.layers import write_image
from flowsplat.scenes.synthetic import SyntheticScene
from flowsplat_benchmarks import resume
from tests.batch.fakes import Inline

SPEC = SyntheticScene(width=96, height=64, frames=8, fps=12.0)
STEP = (2.0, -1.0)
"""Pixels by which the pair moves."""


def write_rig(folder: Path, spec: SyntheticScene) -> None:
    """The clip with its truth, without held-out cameras."""
    shape = (spec.frames, spec.height, spec.width)
    depth, flow, valid = np.zeros(shape), np.zeros((2, *shape, 2)), np.zeros((2, *shape), bool)
    for i in range(spec.frames):
        view = spec.render(spec.camera(i), spec.timestamps[i])
        write_image(folder / "rgb" / f"{i:05d}.png", view.image)
        write_image(folder / "masks" / f"{i:05d}.png", view.mask)
        depth[i] = view.depth
        for k, j in enumerate((i + 1, i - 1)):
            if 0 <= j < spec.frames:
                found = spec.flow(i, j)
                flow[k, i], valid[k, i] = found.flow, found.trusted
    tracks = spec.tracks()
    np.savez(folder / "depth.npz", depth=depth.astype(np.float16))
    np.savez(folder / "flow.npz", fwd=flow[0], bwd=flow[1], fwd_valid=valid[0], bwd_valid=valid[1])
    np.savez(
        folder / "tracks.npz", points=tracks.points.swapaxes(0, 1), visible=tracks.visible.T, moving=tracks.moving,
        group=np.zeros(len(tracks.moving), np.uint8), birth=tracks.visible.argmax(1),
    )  # fmt: skip
    cameras = [spec.camera(i) for i in range(spec.frames)]
    values = {"K": cameras[0].K.tolist(), "width": spec.width, "height": spec.height, "fps": spec.fps}
    (folder / "cameras.json").write_text(json.dumps({**values, "w2c": [c.viewmat.tolist() for c in cameras]}))


def write_pair(folder: Path, size: tuple[int, int] = (120, 80)) -> None:
    """Two images of a texture that moves by ``STEP``; the flow of its left column is not known."""
    width, height = size
    noise = np.random.default_rng(0).uniform(0, 255, (height + 20, width + 20, 3)).astype(np.float32)
    world = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2.0), None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    x, y = (int(v) for v in STEP)
    write_image(folder / "frame10.png", world[10 : 10 + height, 10 : 10 + width])
    write_image(folder / "frame11.png", world[10 - y : 10 - y + height, 10 - x : 10 - x + width])
    flow = np.broadcast_to(np.float32(STEP), (height, width, 2)).copy()
    flow[:, 0] = 1e10
    cv2.writeOpticalFlow(str(folder / "flow10.flo"), flow)


@pytest.fixture
def in_this_process(monkeypatch) -> None:
    """Measurements are made here, one after the other: other processes would not see what is patched."""
    monkeypatch.setattr(resume, "engine_of", lambda *_, **__: Inline())


@pytest.fixture(scope="session")
def data_root(tmp_path_factory) -> Path:
    """``rig/tiny``, ``davis/clip`` and ``flow/pair``."""
    root = tmp_path_factory.mktemp("root")
    write_rig(root / "rig" / "tiny", SPEC)
    for i in range(SPEC.frames):
        images, masks = (root / "davis" / "clip" / name for name in ("images", "masks"))
        write_image(images / f"{i:05d}.png", cv2.imread(str(root / "rig" / "tiny" / "rgb" / f"{i:05d}.png"))[..., ::-1])
        mask = cv2.imread(str(root / "rig" / "tiny" / "masks" / f"{i:05d}.png"), cv2.IMREAD_UNCHANGED)
        write_image(masks / f"{i:05d}.png", (mask > 0).astype(np.uint8) * 255)
    write_pair(root / "flow" / "pair")
    return root
