"""Tracks of other people's trackers.

| whose | files | content |
| --- | --- | --- |
| Shape of Motion (TAPIR, BootsTAPIR) | folder of ``<from>_<to>.npy`` | [N, 4]: x, y, logits of occlusion and of a large error |
| Dynamic Gaussian Marbles (CoTracker) | folder of ``track_<frame>.npy`` | [T, N, 3]: x, y, visible |
| MoSca | ``*_tap.npz``, or a folder of them | ``tracks`` [T, N, 2 or 3], ``visibility`` [T, N] |
| CoTracker | ``.npz`` | ``pred_tracks`` [1, T, N, 2], ``pred_visibility`` [1, T, N] |
| SpatialTrackerV2 | ``.npz`` | ``coords`` [T, N, 3], ``visibs`` [T, N] and more (``spatracker``) |
| TAPIR | ``.npz`` | ``tracks`` [N, T, 2], ``visibles`` [N, T] |

All count pixels from 0 at the center of the first one. A track that is followed from every frame comes many times;
``MAX_TRACKS`` of them, evenly chosen, are kept.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.special import expit

from flowsplat.common.errors import InputError
from flowsplat.common.files import read_npy, read_npz
from flowsplat.geometry.interpolation import sample_map
from flowsplat.priors.given import spatracker
from flowsplat.priors.given.fitting import require_frames
from flowsplat.scenes import Scene, Tracks
from flowsplat.scenes.formats.images import natural_key
from flowsplat.scenes.layers import MAX_TRACK_PLACES, TRUSTED_CONFIDENCE

MAX_TRACKS = 20_000
"""Tracks that are kept of a file, evenly chosen. A round number."""
MAX_TRACK_BYTES = 160 * 2**20
"""Of a file, or of the files of the tracks from one frame. Chosen by eye."""

KNOWN = (
    "a folder of <from>_<to>.npy (TAPIR in Shape of Motion's preprocessing), of track_<frame>.npy (CoTracker) or of "
    "*_tap.npz (MoSca), or a .npz with tracks and visibility, pred_tracks and pred_visibility, tracks and visibles, or coords and "
    "visibs (SpatialTrackerV2)"
)

_ARCHIVES = {
    "CoTracker": ("pred_tracks", "pred_visibility"), "MoSca": ("tracks", "visibility"), "TAPIR": ("tracks", "visibles"),
}  # fmt: skip
"""Names of the points and of what is seen in a ``.npz``, by maker."""
_NAMES = {name for names in _ARCHIVES.values() for name in names}

Found = tuple[np.ndarray, np.ndarray]
"""Pixels [N, T, 2] with whole numbers at pixel centers, and confidence [N, T], below one half where hidden."""


@dataclass(frozen=True)
class GivenTracks:
    """Tracks at the size of the frames: ``points`` [P, T, 2] and ``confidence`` [P, T], 0 where not seen; and their maker."""

    points: np.ndarray
    confidence: np.ndarray
    maker: str


def read_tracks(path: Path, scene: Scene, size: tuple[int, int] | None) -> GivenTracks:
    """Read tracks and bring them to the size of the frames; held-out frames are left out.

    Args:
        size: (width, height) of the images in which they were made; None = of the frames.

    Raises:
        InputError: missing, damaged, of no known layout, of another number of frames, or outside the images.
    """
    path = Path(path)
    read, maker = _read(path, scene)
    parts = list(read)
    count = sum(len(points) for points, _ in parts)
    if not count:
        raise InputError(f"{path} holds no tracks.")
    if len({points.shape[1:] for points, _ in parts}) > 1:
        raise InputError(f"{path}: its files hold tracks of different length.")
    step = -(-count // min(MAX_TRACKS, MAX_TRACK_PLACES // scene.num_frames))
    points = np.concatenate([points[::step] for points, _ in parts])
    confidence = np.concatenate([confidence[::step] for _, confidence in parts]).astype(np.float32)
    if points.ndim != 3 or points.shape[2] != 2 or confidence.shape != points.shape[:2]:
        raise InputError(f"{path} holds tracks of shape {points.shape} with visibility of shape {confidence.shape}.")
    require_frames(path, points.shape[1], scene, "positions a track")
    width, height = size or (scene.width, scene.height)
    if min(width, height) < 1:
        raise InputError(f"--given.tracks-size {width} {height}: give the width and height of images.")
    with np.errstate(all="ignore"):  # what is not finite is not seen
        pixels = (points.astype(np.float32) + np.float32(0.5)) * np.array([scene.width / width, scene.height / height], np.float32)
    confidence = np.where(np.isfinite(pixels).all(-1) & np.isfinite(confidence), confidence, 0)
    pixels = np.nan_to_num(pixels)
    seen = confidence >= TRUSTED_CONFIDENCE
    inside = (pixels >= 0).all(-1) & (pixels[..., 0] <= scene.width) & (pixels[..., 1] <= scene.height)
    if seen.any() and inside[seen].mean() < 0.9:
        raise InputError(
            f"{path}: {1 - inside[seen].mean():.0%} of the visible points lie outside the {width}x{height} pixels of the frames: "
            "give the size of the images in which they were tracked with --given.tracks-size WIDTH HEIGHT."
        )
    if (lens := scene.lens) is not None:
        pixels = np.nan_to_num(lens.straighten_positions(pixels), nan=-1).astype(np.float32)
        inside = (pixels >= 0).all(-1) & (pixels[..., 0] <= scene.width) & (pixels[..., 1] <= scene.height)
    confidence = np.where(inside, np.clip(confidence, 0, 1), 0)
    confidence[:, scene.heldout_frames] = 0
    kept = (confidence >= TRUSTED_CONFIDENCE).sum(1) >= 2
    return GivenTracks(pixels[kept], confidence[kept], maker)


def write_tracks(tracks: GivenTracks, path: Path, scene: Scene) -> None:
    """Write them into the scene; those that are mostly on masks move. Needs masks, if there are to be any."""
    visible = tracks.confidence >= TRUSTED_CONFIDENCE
    on_object = np.zeros(len(visible))
    if scene.prior("masks") is not None:
        for i in scene.train_frames:
            seen = np.flatnonzero(visible[:, i])
            on_object[seen] += sample_map((scene.mask(i) > 0).astype(np.float32), tracks.points[seen, i])[:, 0]
    moving = on_object > 0.5 * visible.sum(1)
    scene.write_tracks(Tracks(np.where(visible[..., None], tracks.points, 0), visible, tracks.confidence, moving))
    scene.finish_prior(
        "tracks", method="given", verdict=f"from {path} ({tracks.maker})", tracks=len(visible), moving=int(moving.sum()),
        median_length=int(np.median(visible.sum(1))) if len(visible) else 0,
    )  # fmt: skip


def _read(path: Path, scene: Scene) -> tuple[Iterator[Found], str]:
    if path.is_file() and path.suffix == ".npz":
        world = read_npz(path, spatracker.ARRAYS, MAX_TRACK_BYTES)
        if set(spatracker.ARRAYS) <= world.keys():
            points, seen = spatracker.read_points(path, world, scene)
            return iter([(points.swapaxes(0, 1), seen.T.astype(np.float32))]), spatracker.MAKER
        return _archives([path])
    if path.is_dir():
        arrays = sorted(path.glob("*.npy"), key=natural_key)
        marbles = [file for file in arrays if file.stem.startswith("track_")]
        archives = sorted(path.glob("*_tap.npz"), key=natural_key)
        if marbles:
            return _marbles(marbles), "CoTracker"
        if archives:
            return _archives(archives)
        names = _pair_names(arrays)
        if names:
            require_frames(path, len(names), scene, "frames")
            return _tapir(path, names), "TAPIR"
    if not path.exists():
        raise InputError(f"{path} does not exist.")
    raise InputError(f"{path} holds no tracks of a known layout. Looked for: {KNOWN}.")


def _pair_names(files: list[Path]) -> list[str]:
    """Return the names of frames, from files that are called ``<from>_<to>``: those that lead to themselves."""
    halves = [(file.stem[: len(file.stem) // 2], file.stem[len(file.stem) // 2 + 1 :]) for file in files]
    return sorted({start for start, end in halves if start == end}, key=lambda name: natural_key(Path(name)))


def _tapir(folder: Path, names: list[str]) -> Iterator[Found]:
    """Followed from every frame. Visible with the probability that it is neither hidden nor badly placed."""
    for start in names:
        arrays = [read_npy(folder / f"{start}_{end}.npy", MAX_TRACK_BYTES // len(names)) for end in names]
        if any(array.ndim != 2 or array.shape[1] != 4 or len(array) != len(arrays[0]) for array in arrays):
            raise InputError(f"{folder}: the tracks from {start} are not [N, 4] in every file.")
        values = np.stack(arrays, 1).astype(np.float32)
        yield values[..., :2], expit(-values[..., 2]) * expit(-values[..., 3])


def _marbles(files: list[Path]) -> Iterator[Found]:
    for file in files:
        values = read_npy(file, MAX_TRACK_BYTES)
        if values.ndim != 3 or values.shape[2] != 3:
            raise InputError(f"{file} is not [T, N, 3] (x, y, visible), but {list(values.shape)}.")
        values = values.astype(np.float32).swapaxes(0, 1)
        yield values[..., :2], values[..., 2]


def _archives(files: list[Path]) -> tuple[Iterator[Found], str]:
    found, maker = [], ""
    for file in files:
        arrays = read_npz(file, _NAMES, MAX_TRACK_BYTES)
        maker = next((maker for maker, names in _ARCHIVES.items() if set(names) <= arrays.keys()), "")
        if not maker:
            raise InputError(f"{file} holds no tracks of a known layout. Looked for: {KNOWN}.")
        points, seen = (arrays[name] for name in _ARCHIVES[maker])
        if maker != "TAPIR" and points.ndim == 4 and len(points) == 1:  # a batch of one, as the network gives it
            points = points[0]
            seen = seen.reshape(points.shape[:2]) if seen.size == points[..., 0].size else seen
        if points.ndim != 3 or points.shape[2] not in (2, 3) or seen.shape != points.shape[:2]:
            raise InputError(f"{file} holds tracks of shape {points.shape} with visibility of shape {seen.shape}.")
        if maker == "MoSca":
            points = points[..., :2]
        if maker != "TAPIR":
            points, seen = points.swapaxes(0, 1), seen.T
        found.append((points, seen.astype(np.float32)))
    return iter(found), maker
