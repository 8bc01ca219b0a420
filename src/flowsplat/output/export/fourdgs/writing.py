"""Write a scene as ``.4dgs``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from flowsplat import __version__
from flowsplat.common.files import write_bytes
from flowsplat.common.progress import report, spinner
from flowsplat.gaussians.model import SceneModel
from flowsplat.geometry import Camera
from flowsplat.geometry.cameras import OPENGL
from flowsplat.geometry.morton import order_along_curve
from flowsplat.geometry.paths import CameraPath
from flowsplat.geometry.rotations import rotations_to_quats
from flowsplat.output.export.fourdgs import container
from flowsplat.output.export.fourdgs.container import ChunkPlace
from flowsplat.output.export.fourdgs.opus import BITS_A_CHANNEL, OpusSound, encode_sound
from flowsplat.output.export.fourdgs.pieces import TICKS, ClipViews, Pieces, cut_into_pieces, cutoff
from flowsplat.output.export.fourdgs.rounding import Frame, Rounded, measure_errors, round_colors, round_pieces
from flowsplat.scenes import Scene
from flowsplat.splatting.harmonics import harmonics_count

MIN_CHUNK_TICKS = 16 * TICKS
"""Of the interval of a chunk: shorter ones part the pieces of a Gaussian, which take little room side by side (a fifth of the file
more where it is halved)."""
MIN_CHUNK_PIECES = 4096
"""With fewer an interval has no chunk of its own. Chosen by eye."""
MAX_ZOOM = 1e-3
"""Share of the focal length by which it may change before it is said that the file's does not. Chosen by eye."""
POSES_A_FRAME = 4
"""Of the camera: between them readers know straight lines only. Chosen by eye."""
_ASKED_GAUSSIANS = 1000
"""How many are cut to tell how large a file will be. Chosen by eye."""
_BYTES_EACH = 16, 3, 4.5
"""What a Gaussian takes, each of its harmonics beyond the first, and each piece of it: on a trained scene of 77,239 Gaussians with
harmonics of degree 1 and on drawn ones of degrees 1 to 3 that is .6 to 1.4 times what they take."""
_REST_BYTES = 20_000
"""Of cameras and windows. Chosen by eye."""


def write_scene(path: Path, model: SceneModel, scene: Scene, *, has_sound: bool) -> None:
    """Write one file atomically, and tell how many Gaussians it has and how far off their centers are.

    Args:
        path: the file.
        model: one whose Gaussians have one color each.
        scene: the prepared scene that it was trained on.
        has_sound: whether the clip's sound is to be in it.

    Raises:
        InputError: it cannot be written.
    """
    with spinner("Cutting curves into straight pieces"):
        views, frame = _views_of(model, scene), Frame.of(model, scene.num_frames)
        pieces = cut_into_pieces(model.gaussians, views)
        rounded = round_pieces(model.gaussians, pieces, views, frame)
    sound = _read_sound(scene, frame) if has_sound else None
    with spinner("Packing"):
        write_bytes(path, _build(model, scene, pieces, rounded, views, frame, sound))
    first = scene.cameras[0]
    middle = (float(first.K[0, 2]), float(first.K[1, 2]))
    errors = measure_errors(model.gaussians, pieces, rounded, views, frame, (scene.width, scene.height), middle)
    off = f"{errors.max():.3f} px, 99.9 % of them {np.quantile(errors, 0.999):.3f} px" if len(errors) else "0 px"
    report(
        f"4dgs: {len(torch.unique(pieces.rows)):,} Gaussians became {len(pieces):,} that move on straight lines; centers that the "
        f"clip's cameras see are off by at most {off}, also between frames; {'with' if sound else 'without'} sound."
    )
    if np.ptp([camera.K[0, 0] for camera in scene.cameras]) > MAX_ZOOM * first.K[0, 0]:
        report("4dgs: its camera does not zoom as the clip's does.")


def estimate_scene_bytes(model: SceneModel, scene: Scene, has_sound: bool) -> int:
    """Return about how many bytes the file will have, with the clip's sound or without."""
    count = len(model.gaussians)
    asked = torch.from_numpy(np.linspace(0, count - 1, min(count, _ASKED_GAUSSIANS)).astype(np.int64))
    pieces = len(cut_into_pieces(model.gaussians.select(asked), _views_of(model, scene))) * count / len(asked)
    a_gaussian, a_harmonic, a_piece = _BYTES_EACH
    each = a_gaussian + a_harmonic * (harmonics_count(model.gaussians.sh_degree) - 1)
    seconds = float(scene.timestamps[-1] - scene.timestamps[0]) if has_sound and scene.sound is not None else 0.0
    return round(_REST_BYTES + each * count + a_piece * pieces + seconds * 2 * BITS_A_CHANNEL / 8)


def _views_of(model: SceneModel, scene: Scene) -> ClipViews:
    times = [model.clip_time(t) for t in scene.timestamps.tolist()]
    return ClipViews.of(times, [model.similarity.camera(camera) for camera in scene.cameras])


def _read_sound(scene: Scene, frame: Frame) -> OpusSound | None:
    return None if scene.sound is None else encode_sound(*scene.sound, frame.duration)


def _build(
    model: SceneModel, scene: Scene, pieces: Pieces, rounded: Rounded, views: ClipViews, frame: Frame, sound: OpusSound | None
) -> bytes:  # fmt: skip
    gaussians, count = model.gaussians, len(pieces)
    degree = gaussians.sh_degree
    object_ids = gaussians.object_ids[pieces.rows].numpy().astype(np.int64)
    low, high = (getattr(rounded.positions, side)(0) if count else np.zeros(3) for side in ("min", "max"))
    attributes = {
        "color_space": "srgb-rec709-display", "coordinate_system": "y-up-right-handed", "visibility_profile": "gaussian",
        "source": f"flowsplat {__version__}",
    }  # fmt: skip
    parts = [
        container.MAGIC,
        container.header(
            f"flowsplat {__version__}", frame.duration, count, cutoff(gaussians), low, high, degree, sound is not None, attributes
        ),
        container.quantization(rounded.origin, rounded.steps),
        container.window_table(rounded.windows),
    ]
    if sound is not None:
        parts.append(container.sound(sound.data, sound.layout, sound.seconds))
    parts.append(container.coordinate_frame())
    parts += _list_camera_records(model, scene)
    numbers = np.unique(object_ids[object_ids > 0]).tolist()
    if numbers:
        centers = frame.points(pieces.means.numpy())
        parts.insert(-1, container.object_table({number: centers[object_ids == number].mean(0) for number in numbers}))
    offset = sum(map(len, parts))
    places: list[ChunkPlace] = []
    order = np.argsort(order_along_curve(gaussians.params["means"].numpy()))[pieces.rows.numpy()]
    for level, number, index in _plan_chunks(pieces, views.steps):
        index = index[np.lexsort((pieces.first.numpy()[index], order[index]))]
        piece = pieces.select(torch.from_numpy(index))
        color, bands = round_colors(gaussians, piece, views, frame)
        begin, end = (side * frame.seconds / 2**level for side in (number, number + 1))
        end = frame.duration if number + 1 == 2**level else end
        streams = [
            container.stream(container.POSITION, rounded.position[index]),
            container.stream(container.SCALE, rounded.scale[index]),
            container.stream(container.ROTATION_INDEX, rounded.rotation_index[index]),
            container.stream(container.ROTATION, rounded.rotation[index]),
            # Green, and how much more red and blue there is.
            container.stream(container.COLOR, np.stack([color[:, 1], color[:, 0] - color[:, 1], color[:, 2] - color[:, 1]], 1)),
            container.stream(container.OPACITY, rounded.opacity[index]),
            container.stream(container.MOTION, rounded.motion[index]),
            container.stream(container.CENTER_TIME, rounded.center_time[index]),
            container.stream(container.DEVIATION, rounded.deviation[index]),
            container.stream(container.FLAGS, rounded.flags[index]),
            container.stream(container.WINDOW, rounded.window[index]),
        ]
        if numbers:
            streams.append(container.stream(container.OBJECT_ID, object_ids[index], may_differ=False))
        chunk = container.chunk(begin, end, level, len(index), streams)
        at, ranges = offset + len(chunk), []
        band_records = [container.harmonics_band(band, values) for band, values in enumerate(bands, 1)]
        for band, band_record in enumerate(band_records, 1):
            ranges.append((band, at, len(band_record)))
            at += len(band_record)
        parts += [chunk, *band_records]
        places.append(ChunkPlace(begin, end, offset, len(chunk), len(index), ranges))
        offset = at
    parts.append(container.summary(places, offset, count, frame.duration, low, high))
    return b"".join(parts)


def _list_camera_records(model: SceneModel, scene: Scene) -> list[bytes]:
    """Return the clip's camera on its way, and as a view to begin with."""
    frames = scene.timestamps
    shares = np.arange(POSES_A_FRAME) / POSES_A_FRAME
    times = np.append((frames[:-1, None] + np.diff(frames)[:, None] * shares).ravel(), frames[-1])
    path = CameraPath(frames.tolist(), scene.cameras)
    cameras: list[Camera] = [path.at(t) for t in times.tolist()]
    places = np.array([OPENGL[:3, :3] @ camera.center for camera in cameras])
    turns = np.array([OPENGL[:3, :3] @ camera.viewmat[:3, :3].T for camera in cameras])
    quats = np.roll(rotations_to_quats(torch.from_numpy(turns)).numpy(), -1, axis=1)
    K = scene.cameras[0].K
    seconds = times - model.first
    targets = places + turns[:, :, 2] / model.similarity.scale  # at the median depth, which is 1 in the model
    fov = float(np.degrees(2 * np.arctan(scene.height / 2 / K[1, 1])))
    return [
        container.rig(seconds, quats, places, (K[0, 0], K[1, 1], K[0, 2], K[1, 2]), (scene.width, scene.height)),
        container.camera(fov, seconds, places, targets),
    ]


def _plan_chunks(pieces: Pieces, steps: int) -> list[tuple[int, int, np.ndarray]]:
    """Return (how often the clip is halved, which part of it, which pieces) of every chunk: each piece is in the shortest interval
    that holds it and has enough of them."""
    first, last = pieces.first.numpy(), pieces.last.numpy()
    deepest = max(int(np.log2(max(steps / MIN_CHUNK_TICKS, 1))), 0)
    left = np.arange(len(pieces))
    plan = []
    for level in range(deepest, -1, -1):
        begin, end = first[left] * 2**level // steps, (last[left] * 2**level - 1) // steps
        for number in range(2**level):
            members = left[(begin == number) & (end == number)]
            if len(members) and (len(members) >= MIN_CHUNK_PIECES or level == 0):
                plan.append((level, number, members))
        taken = np.concatenate([members for at, _, members in plan if at == level] or [left[:0]])
        left = np.setdiff1d(left, taken, assume_unique=True)
    return sorted(plan, key=lambda chunk: chunk[:2])
