"""Bringing other people's files onto the frames of a scene: which file is which frame, and which pixel is which."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.scenes import Scene
from flowsplat.scenes.formats.images import natural_key

SLAM_AREA = 384 * 512
"""Pixels to which DROID-SLAM, and with it MegaSaM and Shape of Motion, resize images before they crop them."""

SLAM_MULTIPLE = 8
"""Their sides are then cropped, at the right and at the bottom, to a multiple of this."""


CHOOSING = "--start, --end, --every, --max-frames and --keep-all choose the frames of the clip"
"""What an error says of a number of frames that does not fit."""


def require_shape(path: Path, width: int, height: int, scene: Scene) -> None:
    """Refuse what has another shape than the frames.

    Raises:
        InputError: the shapes differ by more than rounding.
    """
    if abs(width * scene.height - height * scene.width) > max(scene.width, scene.height, width, height):
        raise InputError(
            f"{path} is {width}x{height} pixels, which is another shape than the frames ({scene.width}x{scene.height}): "
            "give priors of the whole, uncropped image, and keep bars round it with --crop off."
        )


def require_frames(path: Path, count: int, scene: Scene, what: str) -> None:
    """Refuse what was made of another number of frames.

    Raises:
        InputError: ``count`` is not the number of frames.
    """
    if count != scene.num_frames:
        raise InputError(f"{path} holds {count} {what}, but the clip has {scene.num_frames} frames: give one a frame ({CHOOSING}).")


def refuse_later_frames(path: Path, names: Iterable[str], scene: Scene, what: str) -> None:
    """Refuse files that are numbered by the frames of a clip from which fewer were chosen: its first ones are others.

    Args:
        names: five digits each; others say nothing.

    Raises:
        InputError: a number is not of a frame.
    """
    last = max((int(name) for name in names if name.isdecimal() and len(name) == 5), default=-1)
    if last >= scene.num_frames:
        raise InputError(
            f"{path} has {what} up to number {last:05d}, but the clip has {scene.num_frames} frames, 00000 to "
            f"{scene.num_frames - 1:05d}: number them so ({CHOOSING})."
        )


def files_by_frame(folder: Path, suffixes: Sequence[str], scene: Scene, what: str) -> dict[int, Path]:
    """Return the file of every frame, by its number.

    Files are called ``00000`` ..., and those of held-out frames may be missing; or there is exactly one a frame under
    any names, whose natural order is theirs, ``00001`` and so on among them.

    Raises:
        InputError: neither is the case.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is no folder: give one with {what} for every training frame.")
    found = sorted((p for p in folder.iterdir() if p.suffix.lower() in suffixes and p.name[0] != "."), key=natural_key)
    by_stem = {path.stem: path for path in found}
    if sorted(by_stem) == [f"{i + 1:05d}" for i in range(scene.num_frames)]:  # FFmpeg counts files from 1
        return dict(enumerate(found))
    refuse_later_frames(folder, by_stem, scene, f"files with {what}")
    numbered = {i: by_stem[f"{i:05d}"] for i in range(scene.num_frames) if f"{i:05d}" in by_stem}
    missing = [i for i in scene.train_frames if i not in numbered]
    if not missing:
        return numbered
    if len(found) == scene.num_frames:
        return dict(enumerate(found))
    if numbered or not found:
        stem = f"{missing[0]:05d}"
        others = sorted(p for p in folder.iterdir() if p.stem.split(".")[0] == stem and p.name[0] != ".")
        if others:
            raise InputError(f"{others[0]} cannot be read as {what}: it must be {stem}{suffixes[0]}. {folder} has no such file.")
        raise InputError(f"{folder / f'{stem}{suffixes[0]}'} does not exist: give {what} for every training frame.")
    require_frames(folder, len(found), scene, f"files with {what}")
    raise AssertionError("unreachable")


def slam_size(path: Path, width: int, height: int, scene: Scene) -> tuple[int, int]:
    """Return (width, height) that the whole image had where DROID-SLAM's preprocessing cropped it to ``width`` x ``height``.

    https://github.com/princeton-vl/DROID-SLAM/blob/main/demo.py, ``image_stream``. Images of that size come from it;
    others are taken to be whole.

    Raises:
        InputError: it is no image of this clip.
    """
    scale = float(np.sqrt(SLAM_AREA / (scene.width * scene.height)))
    # The working size is rounded, so the size that they saw may give one pixel more or less.
    for across in (0, -1, 1):
        for down in (0, -1, 1):
            size = int(scene.width * scale) + across, int(scene.height * scale) + down
            if tuple(side - side % SLAM_MULTIPLE for side in size) == (width, height):
                return size
    require_shape(path, width, height, scene)
    return width, height


def pad_to(values: np.ndarray, size: tuple[int, int], **how: Any) -> np.ndarray:
    """Return [H, W, ...] continued at the right and at the bottom to ``size`` (width, height)."""
    border = [(0, size[1] - values.shape[0]), (0, size[0] - values.shape[1])] + [(0, 0)] * (values.ndim - 2)
    return np.pad(values, border, **how)


def verdict_of(path: Path, maker: str) -> str:
    """Return where a given prior comes from, in words; ``flowsplat`` is not named."""
    return f"from {path}" if maker == "flowsplat" else f"from {path} ({maker})"
