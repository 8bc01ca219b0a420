"""Replace every image of a scene by another one, so that a kill in between never leaves a mixture of both."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

from flowsplat.common.files import make_folder
from flowsplat.common.progress import track
from flowsplat.scenes.layers import read_image, write_image
from flowsplat.scenes.scene import Scene

FOLDERS = ("frames", "heldout/frames", "masks", "heldout/masks", "overlay")
NEW_IMAGES = "replaced"
"""Folder of the new images until all of them are there."""


def replace_images(scene: Scene, change: Callable[[np.ndarray], np.ndarray]) -> None:
    """Replace all frames and masks, held-out ones included. For what makes cameras only.

    The new images are written aside first; once the scene says that they are complete, they are moved. Called again after
    a kill, with the same ``change``, it goes on. The caller notes the end (``Scene.finish_straightening``), together with what
    says that it need not be called again.

    Args:
        change: from a frame [H, W, 3] or object numbers [H, W] to another one of the same size.

    Raises:
        InputError: an image is missing or damaged, or the disk is full.
    """
    aside = scene.folder / NEW_IMAGES
    if not scene.info.images_replaced:
        old = [Path(folder) / path.name for folder in FOLDERS for path in sorted((scene.folder / folder).glob("[!.]*.png"))]
        for path in track(old, "Straightening images"):
            if not (aside / path).exists():
                write_image(aside / path, change(read_image(scene.folder / path)))
        scene.mark_images_complete()
    for folder in FOLDERS:
        make_folder(scene.folder / folder)
        for path in sorted((aside / folder).glob("[!.]*.png")):
            os.replace(path, scene.folder / folder / path.name)
        if not any((scene.folder / folder).iterdir()):
            (scene.folder / folder).rmdir()
    shutil.rmtree(aside, ignore_errors=True)
