"""Depth from a file or folder of any known layout."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.files import read_npy, read_npz
from flowsplat.geometry.lens import Lens
from flowsplat.priors.given import droid, feedforward, megasam, vipe
from flowsplat.priors.given.fitting import compute_max_bytes, files_by_frame, require_shape
from flowsplat.scenes import Depth, Scene
from flowsplat.scenes.clip import resize_labels
from flowsplat.scenes.layers import decode_image

KNOWN = (
    "a folder of 00000.npy or gray .png ... (depth or disparity), Shape of Motion's aligned_depth_anything (disparity, .npy or "
    "16-bit .png), MoSca's *_depth (.npz with dep), the .npz of Depth Anything 3, VGGT (both depth) or MegaSaM (depths), "
    "the folder of ViPE's results (depth in it)"
)

DISPARITY_FOLDERS = re.compile(r"depth_anything|_disp$", re.IGNORECASE)
"""What the folders of Shape of Motion's disparities are called (``aligned_depth_anything``, ``unidepth_disp``). Others have such
names, too, so it counts only beside the cameras that they are in the units of."""
DEPTH, DISPARITY, INVERTED = "depth", "disparity", "inverted-disparity"
"""What values can be: far is large and zero is the camera; near is large; what is left of white, so that far is large."""
MIN_VALUE = {"Shape of Motion": 1e-6, "MoSca": 1e-3, "flowsplat": float(np.finfo(np.float32).tiny)}
"""Values up to here mean that nothing is known, as these programs write them; smaller ones have no inverse in float32."""


@dataclass(frozen=True)
class GivenDepth:
    """Depth that the user brought.

    Attributes:
        maker: whose layout it is.
        fits: makers of cameras whose units the depth has; with any others it is fitted to them.
        values: from the number of a frame to its values and how well they are known, 0 or 1, both [H, W] float32 at its size.
        kind: what the values are by the layout.
        is_certain: whether the files themselves say so, and not only where they lie.
        white: the largest value of the clip.
    """

    maker: str
    fits: tuple[str, ...]
    values: Callable[[int], tuple[np.ndarray, np.ndarray]]
    kind: str
    is_certain: bool = False
    white: float = 1.0

    def inverse(self, i: int, kind: str | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return inverse depth, up to a scale and, of disparities, a shift, and confidence [H, W] of frame ``i``.

        Args:
            kind: what the values are; the default is what the layout says.
        """
        values, confidence = self.values(i)
        known = confidence > 0
        kind = kind or self.kind
        if kind == DEPTH:
            with np.errstate(over="ignore"):  # what is so near that its inverse is no number is not known
                nearness = 1 / np.where(known, values, 1)
            known &= np.isfinite(nearness)
            confidence = np.where(known, confidence, 0)
        else:
            nearness = values if kind == DISPARITY else self.white - values
        # What is not known is as far away as the furthest.
        furthest = nearness[known].min() if known.any() else 1.0
        return np.where(known, nearness, np.float32(furthest)).astype(np.float32), confidence

    def read(self, i: int) -> Depth:
        """Return depth of frame ``i`` as its layout has it, in units of its own."""
        nearness, confidence = self.inverse(i)
        return Depth(1 / nearness, confidence)


def open_depth(path: Path, scene: Scene) -> GivenDepth:
    """Find out what ``path`` is; the maps of all training frames are read once, so that they can be relied on.

    Raises:
        InputError: missing, damaged, of no known layout, of another shape, or not for every training frame.
    """
    given = _open(Path(path), scene)
    if (lens := scene.lens) is not None:
        given = replace(given, values=partial(_straighten, lens, given.values))
    return replace(given, white=max(float(given.values(i)[0].max()) for i in scene.train_frames))


def _straighten(lens: Lens, values: Callable[[int], tuple[np.ndarray, np.ndarray]], i: int) -> tuple[np.ndarray, np.ndarray]:
    depth, confidence = values(i)  # of points, not of rays: the same behind the pinhole, which has the same axis
    return lens.straighten(depth), lens.straighten(confidence)


def _open(path: Path, scene: Scene) -> GivenDepth:
    if path.is_file() and path.suffix == ".npz":
        return _open_archive(path, scene)
    if not path.is_dir():
        wrong = "holds no depth of a known layout" if path.exists() else "does not exist"
        raise InputError(f"{path} {wrong}. Looked for: {KNOWN}.")
    if archive := vipe.find_file(path, "depth", scene):
        return _certain(vipe.MAKER, vipe.VipeDepth(archive, scene))
    suffixes = {file.suffix.lower() for file in path.iterdir()}
    is_disparity = any(DISPARITY_FOLDERS.search(part) for part in path.resolve().parts[-3:])
    # Of two kinds of files in one folder the one with the exact values is read.
    suffix = next((each for each in (".npz", ".npy", ".png") if each in suffixes), ".npy")
    if suffix == ".npz":
        maker, kind, read_values = "MoSca", DEPTH, _read_mosca
    elif is_disparity:
        maker, kind, read_values = "Shape of Motion", DISPARITY, _read_map
    else:
        maker, kind, read_values = "flowsplat", DEPTH, _read_map
    fits = {"Shape of Motion": (droid.MAKER,), "flowsplat": ("any",) * (suffix == ".npy")}.get(maker, ())
    files = files_by_frame(path, (suffix,), scene, "depth")
    return GivenDepth(maker, fits, lambda i: _read_known(files[i], read_values, MIN_VALUE[maker], scene), kind, suffix == ".npz")


def _open_archive(path: Path, scene: Scene) -> GivenDepth:
    arrays = read_npz(path, {*megasam.ARRAYS, *feedforward.ARRAYS}, most=compute_max_bytes(scene))
    if maker := feedforward.find_maker(arrays, with_cameras=False):
        return _certain(maker, feedforward.FeedForwardDepth(path, arrays, maker, scene))
    return _certain(megasam.MAKER, megasam.MegaSamDepth(path, arrays, scene))


def _certain(maker: str, depths: Callable[[int], Depth]) -> GivenDepth:
    """Return what files hold that say themselves that it is depth."""

    def read(i: int) -> tuple[np.ndarray, np.ndarray]:
        found = depths(i)
        return found.depth, found.confidence

    return GivenDepth(maker, (maker,), read, DEPTH, is_certain=True)


def _read_known(path: Path, read_values: Callable[[Path], np.ndarray], least: float, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return values and 1 where they are known, each [H, W] float32 at the size of the frames."""
    values = read_values(path)
    if values.ndim != 2 or values.dtype.kind not in "fiu":
        raise InputError(f"{path} does not hold one depth map [height, width] of numbers.")
    require_shape(path, values.shape[1], values.shape[0], scene)
    if not values.size:
        raise InputError(f"{path} holds an empty depth map.")
    with np.errstate(over="ignore"):  # what is no float32 is not finite then, and not known
        values = values.astype(np.float32)
    known = np.isfinite(values) & (values > least)
    if not known.any():
        raise InputError(f"{path} holds depths that are not finite and positive, and no others.")
    size = (scene.width, scene.height)
    return resize_labels(np.where(known, values, 0), size), resize_labels(known.astype(np.float32), size)


def _read_map(path: Path) -> np.ndarray:
    if path.suffix.lower() == ".npy":
        return read_npy(path)
    image = decode_image(path, cv2.IMREAD_UNCHANGED)
    if image is not None and image.ndim == 3 and (image[..., :3] == image[..., :1]).all():
        image = image[..., 0]
    if image is None or image.ndim != 2:
        raise InputError(f"{path} is no gray PNG of depth: save its values in 8 or 16 bits, not colors that stand for them.")
    return image.astype(np.float32) / 65535 if image.dtype == np.uint16 else image


def _read_mosca(path: Path) -> np.ndarray:
    arrays = read_npz(path, ("dep",))
    if "dep" not in arrays:
        raise InputError(f"{path} has no array 'dep' as MoSca's depth has.")
    return arrays["dep"]
