"""Store what is known about the frames of a clip besides their colors: cameras, depth, flow, masks, tracks.

One folder holds one such set of layers: the priors of a scene, or its truth. The files:

| file | content |
| --- | --- |
| ``cameras.json`` | for each frame ``viewmat`` [4, 4] world to camera (OpenCV axes), ``K`` [3, 3], ``width``, ``height`` |
| ``depth/00000.npz`` | ``depth`` [H, W] float32, planar, in the units of the cameras; ``confidence`` [H, W] uint8, 255 = certain |
| ``flow/00000_00001.npz`` | ``flow`` [H, W, 2] int16 in 1/64 pixel from frame 0 to 1, at the pixels of 0; ``confidence`` [H, W] |
| ``masks/00000.png`` | [H, W] uint8, the number of the moving object, 0 = background |
| ``tracks.npz`` | ``points`` [P, T, 2 or 3] float32, ``visible`` [P, T] bool, ``confidence`` [P, T] uint8, ``moving`` [P] bool |
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from typing_extensions import TypedDict

from flowsplat.common.errors import InputError
from flowsplat.common.files import atomic_path, read_bytes, read_json, read_npz, write_json, write_npz
from flowsplat.common.files.json_file import Pixels, Row3, Row4
from flowsplat.geometry import Camera
from flowsplat.geometry.cameras import MAX_COORDINATE
from flowsplat.images.header import MAX_PIXELS, can_hold, image_pixels

FLOW_UNIT = 64
"""Steps of stored flow in a pixel."""
TRUSTED_CONFIDENCE = 0.5
"""Confidence from which a pixel of a layer counts as known: the middle of its range."""
_MAX_IMAGE_BYTES = 512 * 2**20
"""Bytes of the file of an image. Chosen by eye."""
_MAX_BYTES_PER_PIXEL = 32
"""Bytes of the arrays of a layer for every pixel. Chosen by eye."""
MAX_TRACK_PLACES = 12_000_000
"""Tracks times frames that a clip has at most: 120,000 tracks of 100 frames, 15,000 of 800. Chosen by eye."""
_MAX_TRACKS_BYTES = 14 * MAX_TRACK_PLACES
"""Bytes: a position in space and two bytes for each place."""
_SILENCE = threading.Lock()


@dataclass(frozen=True)
class Depth:
    """Planar depth [H, W] float32 with a confidence [H, W] float32 between 0 and 1."""

    depth: np.ndarray
    confidence: np.ndarray

    @property
    def trusted(self) -> np.ndarray:
        """[H, W] bool."""
        return self.confidence >= TRUSTED_CONFIDENCE


@dataclass(frozen=True)
class Flow:
    """Displacement in pixels [H, W, 2] float32 from frame ``i`` to frame ``j``, at the pixels of ``i``.

    ``confidence`` [H, W] float32 between 0 and 1; below one half the pixel has no match in ``j``.
    """

    i: int
    j: int
    flow: np.ndarray
    confidence: np.ndarray

    @property
    def trusted(self) -> np.ndarray:
        """[H, W] bool."""
        return self.confidence >= TRUSTED_CONFIDENCE


@dataclass(frozen=True)
class StoredFlow:
    """The same as a ``Flow``, but as its file holds it, in less than half of the memory: what is asked for is made each time.

    Attributes:
        units: [H, W, 2] int16, displacement in 1/64 pixel.
        certainty: [H, W] uint8, 255 = certain.
    """

    i: int
    j: int
    units: np.ndarray
    certainty: np.ndarray

    @property
    def flow(self) -> np.ndarray:
        """[H, W, 2] float32, pixels."""
        return self.units.astype(np.float32) / FLOW_UNIT

    @property
    def confidence(self) -> np.ndarray:
        """[H, W] float32 between 0 and 1."""
        return self.certainty.astype(np.float32) / 255

    @property
    def trusted(self) -> np.ndarray:
        """[H, W] bool."""
        return self.certainty >= TRUSTED_CONFIDENCE * 255


@dataclass(frozen=True)
class Tracks:
    """Points followed over the clip.

    Attributes:
        points: [P, T, 2] float32 pixels (or [P, T, 3] world for truth); undefined where not visible.
        visible: [P, T] bool.
        confidence: [P, T] float32 between 0 and 1.
        moving: [P] bool, on a moving object.
    """

    points: np.ndarray
    visible: np.ndarray
    confidence: np.ndarray
    moving: np.ndarray


def _to_bytes(confidence: np.ndarray) -> np.ndarray:
    return np.clip(np.asarray(confidence, np.float32) * 255 + 0.5, 0, 255).astype(np.uint8)


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Without what OpenCV, libpng and libjpeg write to the terminal by themselves; what others write meanwhile is lost, too."""
    with _SILENCE, open(os.devnull, "wb") as nowhere:
        try:
            kept = os.dup(2)
        except OSError:  # there is no stderr
            yield
            return
        try:
            os.dup2(nowhere.fileno(), 2)
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)


def write_image(path: Path, image: np.ndarray) -> None:
    """Write uint8 [H, W] or RGB [H, W, 3] as PNG, atomically."""
    if image.ndim == 3:
        image = image[..., ::-1]
    # Encoded in memory and written here, so that a full disk is an error and not a silently missing file.
    ok, encoded = cv2.imencode(".png", np.ascontiguousarray(image), [cv2.IMWRITE_PNG_COMPRESSION, 1])
    assert ok
    with atomic_path(path) as temporary:
        temporary.write_bytes(encoded.tobytes())


def decode_image(path: Path, flags: int, expected: tuple[int, int] | None = None) -> np.ndarray | None:
    """Return an image as OpenCV gives it (BGR) under ``cv2.IMREAD_*`` flags; None where it cannot be decoded.

    Args:
        expected: width and height that it must have, where they are known.

    The file is read here and not by OpenCV, which cannot open every file name on every system.

    Raises:
        InputError: no ordinary file, larger than an image may be, or of another size; all before it is decoded.
    """
    return decode_image_bytes(path, read_bytes(path, _MAX_IMAGE_BYTES), flags, expected) if os.path.lexists(path) else None


def decode_image_bytes(path: Path, data: bytes, flags: int, expected: tuple[int, int] | None = None) -> np.ndarray | None:
    """Return what ``decode_image`` does from the bytes of a file; ``path`` is what to call it."""
    size = image_pixels(data)
    if size is None or min(size) < 1:
        return None
    if expected is not None and size != expected:
        raise InputError(f"{path} has {size[0]:,} x {size[1]:,} pixels, expected {expected[0]:,} x {expected[1]:,}.")
    if size[0] * size[1] > MAX_PIXELS:
        raise InputError(f"{path} has {size[0]:,} x {size[1]:,} pixels, more than the {MAX_PIXELS / 1e6:g} million that are read.")
    if not can_hold(data, size):
        return None
    try:
        with _silence():
            return cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        return None


def find_turn(path: Path) -> Callable[[np.ndarray], np.ndarray]:
    """Return how OpenCV turns an image upright by its EXIF tag; of what cannot be read, not at all."""
    upright, stored = (decode_image(path, cv2.IMREAD_COLOR | flag) for flag in (0, cv2.IMREAD_IGNORE_ORIENTATION))
    turns: list[Callable[[np.ndarray], np.ndarray]] = [
        partial(_turn, quarters=quarters, mirrors=mirrors) for mirrors in (False, True) for quarters in range(4)
    ]
    if upright is None or stored is None:
        return turns[0]
    # OpenCV does not tell what it does.
    return next((turn for turn in turns if np.array_equal(turn(stored), upright)), turns[0])


def _turn(image: np.ndarray, quarters: int, mirrors: bool) -> np.ndarray:
    turned = np.rot90(image, quarters)
    return np.ascontiguousarray(turned[:, ::-1] if mirrors else turned)


def read_image(path: Path, expected: tuple[int, int] | None = None) -> np.ndarray:
    """Read a stored image as uint8: RGB [H, W, 3] or gray [H, W].

    Args:
        expected: width and height that it must have, where they are known.

    Raises:
        InputError: missing, damaged, or of another size.
    """
    if not Path(path).exists():
        raise InputError(f"{path} is missing from the scene.")
    image = decode_image(path, cv2.IMREAD_UNCHANGED, expected)
    if image is None:
        raise InputError(f"{path} is damaged: it cannot be decoded as an image.")
    return np.ascontiguousarray(image[..., ::-1]) if image.ndim == 3 else image


class CameraFile(TypedDict):
    """A camera in ``cameras.json``."""

    viewmat: tuple[Row4, Row4, Row4, Row4]
    K: tuple[Row3, Row3, Row3]
    width: Pixels
    height: Pixels


class Layers:
    """One folder of cameras, depth, flow, masks and tracks; read lazily, written atomically, a file a frame."""

    def __init__(self, folder: str | Path, width: int, height: int):
        self.folder, self.width, self.height = Path(folder), width, height
        self._cameras: list[Camera] | None = None

    # -- cameras

    @property
    def has_cameras(self) -> bool:
        """Whether cameras were written."""
        return (self.folder / "cameras.json").exists()

    @property
    def cameras(self) -> list[Camera]:
        """One camera a frame.

        Raises:
            InputError: missing, damaged or not finite.
        """
        if self._cameras is None:
            path = self.folder / "cameras.json"
            cameras = [Camera.from_json(value) for value in read_json(path, list[CameraFile])]
            for index, camera in enumerate(cameras):
                if not camera.is_valid:
                    raise InputError(f"{path}: the camera of frame {index} is not finite or not a rotation.")
            self._cameras = cameras
        return self._cameras

    def write_cameras(self, cameras: Sequence[Camera]) -> None:
        """Write one camera for every frame of the clip."""
        write_json(self.folder / "cameras.json", [camera.to_json() for camera in cameras])
        self._cameras = None

    # -- depth

    def _depth_path(self, i: int) -> Path:
        return self.folder / "depth" / f"{i:05d}.npz"

    def has_depth(self, i: int) -> bool:
        """Return whether frame ``i`` has depth."""
        return self._depth_path(i).exists()

    def depth(self, i: int) -> Depth:
        """Return the depth of frame ``i``.

        Raises:
            InputError: missing, damaged, of the wrong size, or with values that are not finite and positive.
        """
        path = self._depth_path(i)
        arrays = self._arrays(path, ("depth", "confidence"))
        depth = arrays["depth"]
        if not ((depth > 0) & (depth.astype(np.float64) <= MAX_COORDINATE)).all():
            raise InputError(f"{path} holds depths that are not finite and positive.")
        return Depth(depth.astype(np.float32), arrays["confidence"].astype(np.float32) / 255)

    def write_depth(self, i: int, depth: Depth) -> None:
        """Write the depth of frame ``i``."""
        write_npz(
            self._depth_path(i),
            {"depth": depth.depth.astype(np.float32), "confidence": _to_bytes(depth.confidence)},
        )

    # -- flow

    def _flow_path(self, i: int, j: int) -> Path:
        return self.folder / "flow" / f"{i:05d}_{j:05d}.npz"

    @property
    def flow_pairs(self) -> list[tuple[int, int]]:
        """The pairs (i, j) that have flow, sorted."""
        found = sorted((self.folder / "flow").glob("[0-9]*_[0-9]*.npz"))
        return [(int(path.stem.split("_")[0]), int(path.stem.split("_")[1])) for path in found]

    def read_stored_flow(self, i: int, j: int) -> StoredFlow:
        """Return the flow from frame ``i`` to frame ``j``, as it is stored.

        Raises:
            InputError: missing, damaged or of the wrong size.
        """
        path = self._flow_path(i, j)
        arrays = self._arrays(path, ("flow", "confidence"))
        if arrays["flow"].dtype != np.int16:
            raise InputError(f"{path} is damaged: flow is stored as int16, not as {arrays['flow'].dtype}.")
        return StoredFlow(i, j, arrays["flow"], arrays["confidence"])

    def flow(self, i: int, j: int) -> Flow:
        """Return the flow from frame ``i`` to frame ``j``.

        Raises:
            InputError: missing, damaged or of the wrong size.
        """
        stored = self.read_stored_flow(i, j)
        return Flow(i, j, stored.flow, stored.confidence)

    def write_flow(self, flow: Flow) -> None:
        """Write one pair; displacements beyond 511 px cannot be stored and lose their confidence."""
        units = np.nan_to_num(np.round(flow.flow * FLOW_UNIT), nan=0.0, posinf=1e6, neginf=-1e6)
        fits = (np.abs(units) < 32767).all(-1) & np.isfinite(flow.flow).all(-1)
        arrays = {
            "flow": np.clip(units, -32767, 32767).astype(np.int16),
            "confidence": _to_bytes(np.where(fits, flow.confidence, 0)),
        }
        write_npz(self._flow_path(flow.i, flow.j), arrays)

    # -- masks

    def _mask_path(self, i: int) -> Path:
        return self.folder / "masks" / f"{i:05d}.png"

    def has_mask(self, i: int) -> bool:
        """Return whether frame ``i`` has a mask."""
        return self._mask_path(i).exists()

    def mask(self, i: int) -> np.ndarray:
        """Return [H, W] uint8: object numbers, 0 = background.

        Raises:
            InputError: missing, damaged or of the wrong size.
        """
        mask = read_image(self._mask_path(i), (self.width, self.height))
        if mask.shape != (self.height, self.width):
            raise InputError(f"{self._mask_path(i)} is {mask.shape[1::-1]} pixels, the frames {(self.width, self.height)}.")
        return mask

    def write_mask(self, i: int, mask: np.ndarray) -> None:
        """Write object numbers [H, W]."""
        write_image(self._mask_path(i), mask.astype(np.uint8))

    # -- tracks

    @property
    def has_tracks(self) -> bool:
        """Whether tracks were written."""
        return (self.folder / "tracks.npz").exists()

    @property
    def tracks(self) -> Tracks:
        """The tracks.

        Raises:
            InputError: missing or damaged.
        """
        path = self.folder / "tracks.npz"
        arrays = read_npz(path, ("points", "visible", "confidence", "moving"), _MAX_TRACKS_BYTES)
        for name in ("points", "visible", "confidence", "moving"):
            if name not in arrays:
                raise InputError(f"{path} has no {name!r}.")
        points, seen, confidence, moving = (arrays[name] for name in ("points", "visible", "confidence", "moving"))
        fits = points.ndim == 3 and points.shape[2] in (2, 3) and seen.shape == confidence.shape == points.shape[:2]
        if not (fits and moving.shape == points.shape[:1] and points.dtype.kind == "f" and seen.dtype == moving.dtype == bool):
            raise InputError(f"{path} is damaged: its arrays are no tracks, or not of the same ones.")
        if confidence.dtype != np.uint8 or not np.isfinite(points[seen]).all():
            raise InputError(f"{path} is damaged: it holds positions that are not finite, or confidences that are none.")
        return Tracks(points, seen, confidence.astype(np.float32) / 255, moving)

    def write_tracks(self, tracks: Tracks) -> None:
        """Write the tracks."""
        arrays = {
            "points": tracks.points.astype(np.float32),
            "visible": tracks.visible.astype(bool),
            "confidence": _to_bytes(tracks.confidence),
            "moving": tracks.moving.astype(bool),
        }
        write_npz(self.folder / "tracks.npz", arrays)

    def _arrays(self, path: Path, names: tuple[str, ...]) -> dict[str, np.ndarray]:
        arrays = read_npz(path, names, most=_MAX_BYTES_PER_PIXEL * self.width * self.height)
        for name in names:
            if name not in arrays:
                raise InputError(f"{path} has no array {name!r}.")
            if arrays[name].dtype.kind not in "biuf":
                raise InputError(f"{path}: {name} holds no numbers.")
            if arrays[name].shape != (self.height, self.width) + ((2,) if name == "flow" else ()):
                raise InputError(f"{path}: {name} has shape {arrays[name].shape}, the frames {(self.height, self.width)}.")
        return arrays
