"""Flow from a folder of any known layout."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.files import read_bytes, read_npz
from flowsplat.geometry.cameras import MAX_COORDINATE
from flowsplat.images.header import MAX_PIXELS
from flowsplat.priors.given import megasam
from flowsplat.priors.given.fitting import refuse_later_frames, require_frames, require_shape
from flowsplat.priors.given.truth import consecutive_pairs
from flowsplat.scenes import Flow, Scene
from flowsplat.scenes.clip import resize_labels
from flowsplat.scenes.formats.images import natural_key
from flowsplat.scenes.layers import FLOW_UNIT, decode_image

FLO_MAGIC = 202021.25
"""First number of a Middlebury ``.flo`` file (https://vision.middlebury.edu/flow/code/flow-code/README.txt)."""

_MAX_NPZ_BYTES = 160 * 2**20
"""Bytes. Chosen by eye."""
_MAX_FLO_BYTES = 12 + 8 * MAX_PIXELS
"""Bytes: the header, and two float32 for every pixel of the largest image."""
KITTI_ZERO, KITTI_UNIT = 32768, 64.0
"""In KITTI's 16-bit PNG (https://www.cvlibs.net/datasets/kitti/eval_flow.php) u = (red - 32768) / 64 pixels."""

Arrays = tuple[np.ndarray, np.ndarray]
"""Flow [H, W, 2] and its confidence [H, W]."""


def read_flow(folder: Path, scene: Scene) -> tuple[list[Flow], str]:
    """Return the pairs of ``consecutive_pairs`` that a folder has, at the size of the frames, and whose layout it was.

    Our own layout must have all of them; those of MegaSaM (forward only) and MoSca may lack some.

    Raises:
        InputError: missing, damaged, of another shape, or of no known layout.
    """
    flows, maker = _read(Path(folder), scene)
    lens = scene.lens
    if lens is not None:
        flows = [Flow(each.i, each.j, *lens.straighten_flow(each.flow, each.confidence)) for each in flows]
    return flows, maker


def _read(folder: Path, scene: Scene) -> tuple[list[Flow], str]:
    wanted = consecutive_pairs(scene)
    if not folder.is_dir():
        wrong = "is no folder" if folder.exists() else "does not exist"
        raise InputError(
            f"{folder} {wrong}. Looked for a folder of 00000_00001.npz, .flo or .png (KITTI), MegaSaM's cache_flow "
            "(flows.npy, flows_masks.npy, ii-jj.npy), or MoSca's flow_raft (00000.jpg_to_00001.jpg.npz)."
        )
    if megasam.is_flow_cache(folder):
        return megasam.read_flow(folder, wanted, scene), megasam.MAKER
    if any(folder.glob("*_to_*.npz")):
        return _mosca(folder, wanted, scene), "MoSca"
    files = (path for path in folder.iterdir() if path.suffix in (".npz", ".flo", ".png"))
    refuse_later_frames(folder, (number for path in files for number in path.stem.split("_")), scene, "images")
    return [_read_own(folder, i, j, scene) for i, j in wanted], "flowsplat"


def _fit_to_frames(path: Path, i: int, j: int, arrays: Arrays, scene: Scene) -> Flow:
    flow, confidence = arrays
    if flow.ndim != 3 or flow.shape[2] != 2 or confidence.shape != flow.shape[:2]:
        raise InputError(f"{path} does not hold flow [height, width, 2] with a confidence [height, width].")
    height, width = flow.shape[:2]
    require_shape(path, width, height, scene)
    if flow.size == 0:
        raise InputError(f"{path} holds no pixel.")
    # Whole numbers are 1/64 pixels and 255 is certain, as in a scene folder; floating-point numbers mean themselves.
    flow = flow / np.float32(FLOW_UNIT) if flow.dtype.kind in "iu" else flow.astype(np.float32)
    confidence = confidence / np.float32(255) if confidence.dtype.kind in "iu" else confidence.astype(np.float32)
    if not ((np.abs(flow) <= MAX_COORDINATE).all() and np.isfinite(confidence).all()):
        raise InputError(f"{path} holds values that are not finite: set them to 0 with confidence 0.")
    size = (scene.width, scene.height)
    scale = np.array([scene.width / width, scene.height / height], np.float32)
    known = (confidence > 0).astype(np.float32)
    share = cv2.resize(known, size, interpolation=cv2.INTER_LINEAR)
    resized = cv2.resize(flow * known[..., None], size, interpolation=cv2.INTER_LINEAR) / np.maximum(share, 1e-6)[..., None]
    return Flow(i, j, resized * scale, np.where(share > 0, resize_labels(np.clip(confidence, 0, 1), size), 0))


def _read_own(folder: Path, i: int, j: int, scene: Scene) -> Flow:
    readers: dict[str, Callable[[Path], Arrays]] = {".npz": _read_npz, ".flo": _read_flo, ".png": _read_kitti}
    for suffix, read in readers.items():
        path = folder / f"{i:05d}_{j:05d}{suffix}"
        if path.exists():
            return _fit_to_frames(path, i, j, read(path), scene)
    missing = folder / f"{i:05d}_{j:05d}.npz"
    raise InputError(f"{missing} does not exist: give flow both ways between consecutive training frames.")


def _read_npz(path: Path) -> Arrays:
    arrays = read_npz(path, ("flow", "confidence"), _MAX_NPZ_BYTES)
    if not {"flow", "confidence"} <= arrays.keys():
        raise InputError(f"{path} needs the arrays 'flow' and 'confidence'.")
    return arrays["flow"], arrays["confidence"]


def _read_flo(path: Path) -> Arrays:
    data = read_bytes(path, _MAX_FLO_BYTES)
    if len(data) < 12 or np.frombuffer(data, "<f4", 1)[0] != np.float32(FLO_MAGIC):
        raise InputError(f"{path} is not a Middlebury .flo file.")
    width, height = (int(value) for value in np.frombuffer(data, "<i4", 2, offset=4))
    if width <= 0 or height <= 0 or len(data) != 12 + 8 * width * height:
        raise InputError(f"{path} is damaged or truncated.")
    flow = np.frombuffer(data, "<f4", offset=12).reshape(height, width, 2).astype(np.float32)
    return flow, np.ones((height, width), np.float32)


def _read_kitti(path: Path) -> Arrays:
    image = decode_image(path, cv2.IMREAD_UNCHANGED)
    if image is None or image.dtype != np.uint16 or image.ndim != 3 or image.shape[2] != 3:
        raise InputError(f"{path} is no flow of KITTI: a PNG with three channels of 16 bits.")
    valid = (image[..., 0] > 0).astype(np.float32)  # OpenCV turns the order of the channels round.
    flow = (image[..., :0:-1].astype(np.float32) - KITTI_ZERO) / np.float32(KITTI_UNIT)
    return flow * valid[..., None], valid


def _mosca(folder: Path, wanted: list[tuple[int, int]], scene: Scene) -> list[Flow]:
    files = {tuple(path.stem.split("_to_")): path for path in folder.glob("*_to_*.npz")}
    names = sorted({name for pair in files for name in pair}, key=lambda name: natural_key(Path(name)))
    require_frames(folder, len(names), scene, "images")
    found = []
    for i, j in wanted:
        path = files.get((names[i], names[j]))
        if path is not None:
            arrays = read_npz(path, ("flow", "mask"), _MAX_NPZ_BYTES)
            if not {"flow", "mask"} <= arrays.keys():
                raise InputError(f"{path} needs the arrays 'flow' and 'mask' as MoSca writes them.")
            known = arrays["mask"] if arrays["mask"].dtype.kind == "f" else arrays["mask"] > 0
            found.append(_fit_to_frames(path, i, j, (arrays["flow"], known), scene))
    return found
