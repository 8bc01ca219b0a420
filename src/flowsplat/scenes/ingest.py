"""Input of any kind to a scene folder with frames, split, given masks, truth and held-out views. Priors are not computed here."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.files import hash_files, ordinary_file
from flowsplat.common.progress import progress_bar
from flowsplat.common.run_paths import RunPaths
from flowsplat.common.settings import to_plain
from flowsplat.common.spread import spread
from flowsplat.images.sound import keep_sound
from flowsplat.scenes.bars import cut_bars, find_bars
from flowsplat.scenes.clip import Clip, InputOptions
from flowsplat.scenes.formats.davis import IMAGES, open_davis, sequence_folders
from flowsplat.scenes.formats.images import IMAGE_SUFFIXES, is_animated, list_images, open_images
from flowsplat.scenes.formats.masks import require_rest
from flowsplat.scenes.formats.nerfies import is_nerfies, open_nerfies
from flowsplat.scenes.formats.nvidia import RAW_IMAGES, TARGET, is_nvidia, open_nvidia, target_folder
from flowsplat.scenes.formats.rig import open_rig
from flowsplat.scenes.formats.video import VIDEO_SUFFIXES, open_video
from flowsplat.scenes.overlay import COMPARED_FRAMES, fill_overlay, find_overlay
from flowsplat.scenes.scene import Scene

__all__ = ["InputOptions", "fingerprint", "ingest", "kind_of_input", "open_clip"]

CALIBRATED = "calibrated"
"""Method of cameras that came with the input and share the coordinates of its held-out views."""
CHECKED_MASKS = 24
"""Given masks that are looked at before any is written. Chosen by eye."""
SOUND = "sound.flac"
ALREADY = "{} is a prepared scene already: there is nothing to ingest."


def kind_of_input(path: Path) -> str:
    """Return what ``path`` is: ``scene`` (prepared), ``rig``, ``davis``, ``nvidia``, ``nerfies``, ``images`` or ``video``.

    Raises:
        InputError: it does not exist, or is a folder of nothing that is known.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path} does not exist.")
    if not path.is_dir():
        ordinary_file(path)
        if path.suffix.lower() in IMAGE_SUFFIXES:
            if is_animated(path):
                raise InputError(f"{path} is an animated WebP, which is not read: make a video, a GIF or a folder of frames of it.")
            raise InputError(f"{path} is a single image: give a video, or a folder with at least two frames.")
        return "video"
    if is_nerfies(path):  # has a scene.json, too
        return "nerfies"
    if (path / "scene.json").exists():
        return "scene"
    if (path / "rgb").is_dir() and (path / "cameras.json").exists():
        return "rig"
    if (path / IMAGES).is_dir():
        return "davis"
    if is_nvidia(path):
        return "nvidia"
    if (path / "images").is_dir() or list_images(path):
        return "images"
    videos = sorted(file for file in path.iterdir() if file.suffix.lower() in VIDEO_SUFFIXES and file.is_file())
    if len(videos) == 1:
        raise InputError(f"{path} is a folder with a video: give {videos[0]}.")
    if videos:
        raise InputError(f"{path} holds {len(videos)} videos: give one, as {videos[0]}, or the folder to flowsplat batch.")
    raise InputError(
        f"{path} has no images (jpg, png, webp, tiff or bmp) and no images/ folder: give a video or a folder of frames."
    )


def _image_folders(path: Path) -> tuple[Path, Path | None]:
    if not (path / "images").is_dir():
        return path, None
    return path / "images", path / "masks" if (path / "masks").is_dir() else None


def open_clip(path: Path, options: InputOptions) -> Clip:
    """Open a video, a folder of images (with ``images/`` and ``masks/`` or without), DAVIS, a rig, an NVIDIA or a Nerfies scene.

    Raises:
        InputError: cannot be used; the message says why. Prepared scenes are opened with ``Scene`` instead.
    """
    options.check()
    path = Path(path)
    kind = kind_of_input(path)
    if options.sequence is not None and kind != "davis":
        raise InputError(f"--sequence {options.sequence} needs the root folder of DAVIS, which {path} is not.")
    if kind in ("video", "davis", "images"):
        clip = _open_uncalibrated(kind, path, options)
        if options.crop == "auto" and find_bars(clip) is not None:
            return cut_bars(_open_uncalibrated(kind, path, replace(options, resize=0)), options)
        return clip
    if kind == "rig":
        return open_rig(path, options)
    if kind == "nvidia":
        return open_nvidia(path, options)
    if kind == "nerfies":
        return open_nerfies(path, options)
    raise InputError(ALREADY.format(path))


def _open_uncalibrated(kind: str, path: Path, options: InputOptions) -> Clip:
    if kind == "video":
        return open_video(path, options)
    if kind == "davis":
        return open_davis(path, options)
    folder, masks = _image_folders(path)
    clip = path.resolve()
    return open_images(folder, options, masks, name=clip.parent.name if clip.name == "images" else clip.name)


def ingest(clip: Clip, folder: Path, options: InputOptions) -> Scene:
    """Write a clip into a scene folder: frames, split, given masks, calibrated cameras, truth and held-out views.

    ``scene.json`` comes first and its ``ingested`` last, so an interrupted run is recognized; called again, it keeps every file
    that is there (files are written atomically, so they are whole) and adds what is missing.

    Raises:
        InputError: the input cannot be read, or the folder holds a scene of another input.
    """
    scene = _open_or_create(clip, Path(folder), options)
    if scene.info.ingested:
        return scene
    _write_frames(clip, scene)
    notes = _take_out_overlay(scene) if options.overlay == "auto" and clip.cameras is None and clip.truth is None else []
    if clip.has_masks:
        _write_masks(clip, scene)
    if clip.cameras is not None:
        scene.write_cameras(list(clip.cameras))
        scene.finish_prior("cameras", method=CALIBRATED, verdict="calibrated cameras, as they came")
    if clip.truth is not None:
        _write_truth(clip, scene)
    written = {view.name for view in scene.views}
    for image in clip.views():
        if image.view.name not in written:
            scene.write_view(image.view, image.image, image.mask, image.covisible)
    scene.mark_ingested(_write_sound(clip, scene), notes)
    return scene


def _open_or_create(clip: Clip, folder: Path, options: InputOptions) -> Scene:
    train, heldout = clip.split(options)
    if (folder / "scene.json").exists():
        scene = Scene(folder)
        same = (scene.name, scene.width, scene.height, scene.train_frames, scene.heldout_frames)
        if same != (clip.name, clip.width, clip.height, train, heldout) or not np.array_equal(scene.timestamps, clip.timestamps):
            raise InputError(f"{folder} holds a scene of another input or other options: choose another output folder with -o.")
        return scene
    return Scene.create(
        folder,
        name=clip.name,
        source=clip.source,
        width=clip.width,
        height=clip.height,
        timestamps=clip.timestamps.tolist(),
        holdout=clip.holdout(options),
        heldout=options.holdout_frames,
        source_fps=clip.source_fps,
        notes=clip.notes,
        input_frames=clip.available if (clip.available or 0) > clip.num_frames else None,
    )


def _write_frames(clip: Clip, scene: Scene) -> None:
    missing = [i for i in range(scene.num_frames) if not scene.has_frame(i)]
    with progress_bar("Reading frames", scene.num_frames, done=scene.num_frames - len(missing)) as bar:
        for i, image in zip(missing, clip.frames(missing), strict=True):
            scene.write_frame(i, image)
            bar.advance()


def _take_out_overlay(scene: Scene) -> list[str]:
    """Fill what is burnt into the frames, and return what is said of it. Stopped in between, the next call goes on."""
    if scene.overlay is None:
        compared = [scene.train_frames[k] for k in spread(len(scene.train_frames), COMPARED_FRAMES)]
        found = find_overlay(scene.frame(i) for i in compared)
        if found is None:
            return []
        scene.write_overlay(found)
    overlay = scene.overlay
    assert overlay is not None
    for i in range(scene.num_frames):
        image = scene.any_frame(i)
        if scene.overlay_frame(i) is None:
            scene.write_overlay_frame(i, np.where(overlay[..., None], image, 0))
        scene.write_frame(i, fill_overlay(image, overlay))
    return [
        f"Something stays on the screen while the camera moves (a logo, a clock), on {overlay.mean():.1%} of the image: it is left "
        "out of all that is measured and trained (--overlay keep takes it as part of the scene)."
    ]


def _write_sound(clip: Clip, scene: Scene) -> str | None:
    """Return the name of the sound's file, which comes into the scene: a scene names no file outside it. None where there is no
    sound."""
    if clip.audio is None:
        return None
    seconds = float(scene.timestamps[-1] - scene.timestamps[0]) + 1 / clip.source_fps
    return SOUND if keep_sound(clip.audio, clip.audio_start, seconds, scene.folder / SOUND) else None


def _write_masks(clip: Clip, scene: Scene) -> None:
    heldout = set(scene.heldout_frames)
    require_rest(clip.source, [clip.mask(scene.train_frames[k]) for k in spread(len(scene.train_frames), CHECKED_MASKS)])
    for i in range(scene.num_frames):
        layers = scene.heldout_masks if i in heldout else scene
        if not layers.has_mask(i):
            layers.write_mask(i, clip.mask(i))
    scene.finish_prior("masks", method="given")


def _write_truth(clip: Clip, scene: Scene) -> None:
    assert clip.truth is not None
    truth = scene.create_truth()
    truth.write_cameras(clip.truth.cameras)
    truth.write_tracks(clip.truth.tracks)
    for i in range(scene.num_frames):
        if not truth.has_mask(i):
            truth.write_mask(i, clip.truth.mask(i))
    for i in range(scene.num_frames):
        if not truth.has_depth(i):
            truth.write_depth(i, clip.truth.depth(i))
    for i, j in sorted(set(clip.truth.flow_pairs) - set(truth.flow_pairs)):
        truth.write_flow(clip.truth.flow(i, j))


def fingerprint(path: Path, options: InputOptions) -> str:
    """Return a short name of an input with its options, the same wherever the input lies: names, sizes and both ends of its files.

    Of a prepared scene options change nothing. Its similarity follows from the rest, and is noted when it is first asked for.

    Raises:
        InputError: the input does not exist or is of no known kind.
    """
    if kind_of_input(path) == "scene":
        info = replace(Scene(path).info, similarity=None)
        files = [(name, file) for name, file in _list_folder(Path(path)) if name != "scene.json"]
        return hash_files(json.dumps(info.to_json(), sort_keys=True), files)
    return hash_files(json.dumps(to_plain(options), sort_keys=True), _list_input_files(Path(path), options))


def _list_input_files(path: Path, options: InputOptions) -> list[tuple[str, Path]]:
    """Return the files that make up an input, with names that do not depend on where it lies."""
    kind = kind_of_input(path)
    if path.is_file():
        return [(path.name, path)]
    if kind not in ("davis", "images"):
        named = _list_folder(path)
        if kind == "nvidia" and not (path / RAW_IMAGES).is_dir():
            named += [(f"gt/{file.name}", file) for file in sorted(target_folder(path).glob(TARGET))]
        return named
    images, masks = sequence_folders(path, options.sequence) if kind == "davis" else _image_folders(path)
    named = [(f"images/{file.name}", file) for file in list_images(images)]
    return named + [(f"masks/{file.name}", file) for file in list_images(masks)] if masks else named


def _list_folder(path: Path) -> list[tuple[str, Path]]:
    """Return all files in a folder, hidden ones and those of runs that somebody put there excepted."""
    runs = [record.parent for record in path.rglob(RunPaths(path).record_path.name)]
    inside = (file for file in path.rglob("*") if not any(run in file.parents for run in runs))
    found = sorted(file for file in inside if file.is_file() and not file.name.startswith("."))
    return [(file.relative_to(path).as_posix(), file) for file in found]
