"""Moving textures, and a scene of two of them."""

from __future__ import annotations

import numpy as np
import pytest

from flowsplat.scenes import Scene

from .textures import shifted, texture


@pytest.fixture
def scene(tmp_path) -> Scene:
    """A background that moves by (1.5, 0.5) and a square on it that moves by (-2, 1) pixels a frame; frame 3 held out."""
    back, front = texture(120, 160), texture(40, 40, seed=5)
    scene = Scene.create(
        tmp_path / "scene", name="s", source="", width=112, height=80, timestamps=range(8), holdout=4, source_fps=1
    )
    for i in range(8):
        image = shifted(back, 1.5 * i, 0.5 * i, 112, 80)
        x, y = 66 - 2 * i, 16 + i
        image[y : y + 36, x : x + 36] = front[:36, :36]
        scene.write_frame(i, np.repeat(image[..., None], 3, 2))
        if i in scene.train_frames:
            mask = np.zeros((80, 112), np.uint8)
            mask[y : y + 36, x : x + 36] = 1
            scene.write_mask(i, mask)
    return scene
