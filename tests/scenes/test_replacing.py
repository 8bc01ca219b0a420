from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flowsplat.scenes import Scene, replacing
from flowsplat.scenes.replacing import replace_images


def scene_of(folder: Path) -> Scene:
    scene = Scene.create(
        folder, name="s", source="", width=4, height=3, timestamps=range(5), holdout=2, source_fps=1,
    )  # fmt: skip
    for i in range(5):
        scene.write_frame(i, np.full((3, 4, 3), i, np.uint8))
        layers = scene if i in scene.train_frames else scene.heldout_masks
        layers.write_mask(i, np.full((3, 4), i, np.uint8))
    return scene


def brighter(image: np.ndarray) -> np.ndarray:
    return image + np.uint8(100)


def require_replaced(scene: Scene) -> None:
    for i in range(5):
        assert (scene.any_frame(i) == 100 + i).all()
        layers = scene if i in scene.train_frames else scene.heldout_masks
        assert (layers.mask(i) == 100 + i).all()
    assert not (scene.folder / replacing.NEW_IMAGES).exists()


def test_all_images_are_replaced(tmp_path):
    scene = scene_of(tmp_path / "s")
    replace_images(scene, brighter)
    require_replaced(scene)


@pytest.mark.parametrize("after", [0, 1, 4, 9])
def test_killed_while_writing_nothing_has_changed_and_it_goes_on(tmp_path, after):
    scene = scene_of(tmp_path / "s")
    left = [after]

    def dying(image: np.ndarray) -> np.ndarray:
        if left[0] == 0:
            raise KeyboardInterrupt
        left[0] -= 1
        return brighter(image)

    with pytest.raises(KeyboardInterrupt):
        replace_images(scene, dying)
    scene = Scene(tmp_path / "s")
    assert all((scene.any_frame(i) == i).all() for i in range(5))
    replace_images(scene, brighter)
    require_replaced(scene)


@pytest.mark.parametrize("after", [0, 1, 5, 9])
def test_killed_while_moving_nothing_is_changed_twice(tmp_path, after, monkeypatch):
    scene = scene_of(tmp_path / "s")
    move, left = replacing.os.replace, [after]

    def dying(source, target):
        if replacing.NEW_IMAGES in Path(source).parts and replacing.NEW_IMAGES not in Path(target).parts:
            if left[0] == 0:
                raise KeyboardInterrupt
            left[0] -= 1
        move(source, target)

    monkeypatch.setattr(replacing.os, "replace", dying)
    with pytest.raises(KeyboardInterrupt):
        replace_images(scene, brighter)
    monkeypatch.undo()
    scene = Scene(tmp_path / "s")
    replace_images(scene, brighter)
    require_replaced(scene)
