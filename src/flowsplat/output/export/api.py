"""The one place that knows all formats: what they are called, how large they become, and who writes them."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import torch

from flowsplat.common.errors import InputError
from flowsplat.common.files import make_folder
from flowsplat.common.progress import report, track
from flowsplat.gaussians.model import SceneModel
from flowsplat.output.export.cameras import write_colmap, write_nerfstudio
from flowsplat.output.export.importance import choose_most_important
from flowsplat.output.export.options import FORMATS, ExportOptions
from flowsplat.output.export.parameters import write_parameters_npz, write_parameters_safetensors
from flowsplat.output.export.ply import property_names, write_ply
from flowsplat.output.export.splat import RECORD, write_splat
from flowsplat.output.export.spz import bytes_per_gaussian, write_spz
from flowsplat.output.export.still import still_at
from flowsplat.output.player.pack import estimate_bytes
from flowsplat.output.player.page import write_player
from flowsplat.output.videos.amplitudes import loop_widths
from flowsplat.scenes import Scene
from flowsplat.splatting.harmonics import harmonics_count

_FOLDERS = ("ply-sequence", "colmap", "nerfstudio")
_STILLS = ("ply", "splat", "spz")
_FLIPPED = ("ply", "ply-sequence", "splat")
_CAMERAS = ("colmap", "nerfstudio")
_SEQUENCE_FILE = re.compile(r"frame\d{4,}\.ply")
_PAGE_BYTES = 150_000
"""The player without its scene: program, poster, camera path."""
_SPZ_GZIP_RATIO = 0.6
"""What gzip leaves of the bytes of an spz, as measured on trained scenes."""


def export_scene(model: SceneModel, scene: Scene, to: str, path: str | Path | None, options: ExportOptions) -> Path:
    """Write a trained scene in a format of others, or as the single-file player.

    Args:
        model: the trained scene.
        scene: the prepared scene that it was trained on.
        to: one of ``FORMATS``.
        path: the file or folder to write; None = beside the scene, in ``export/``.
        options: what and how.

    Returns:
        what was written: a file or a folder.

    Raises:
        InputError: an unknown format, an option that does not fit it or the clip, or a place that cannot be written.
    """
    _check(model, to, options)
    path = Path(path) if path is not None else scene.folder.parent / "export" / _default_name(to)
    if path.is_dir() and to not in _FOLDERS:
        raise InputError(f"{path} is a folder, {to} is one file: give a name for it with -o.")
    if path.is_file() and to in _FOLDERS:
        raise InputError(f"{path} is a file, {to} needs a folder: give another one with -o.")
    make_folder(path if to in _FOLDERS else path.parent)
    if options.max_gaussians is not None and to not in _CAMERAS:
        views = [(scene.cameras[i], float(scene.timestamps[i])) for i in scene.train_frames]
        model = choose_most_important(model, views, options.max_gaussians)
    size = estimate_size(model, scene, to, options)
    what = f"{scene.num_frames} cameras" if to in _CAMERAS else f"{len(model.gaussians):,} Gaussians"
    report(f"{what} as {to}: about {_readable(size)} in {path}")
    _write(model, scene, to, path, options)
    return path


def estimate_size(model: SceneModel, scene: Scene, to: str, options: ExportOptions) -> int:
    """Return about how many bytes an export will have; exact for ply, ply-sequence and splat but for their headers."""
    gaussians = model.gaussians
    harmonics = harmonics_count(gaussians.sh_degree)
    record = 4 * len(property_names(harmonics, _has_objects(model), gaussians.seen is not None))
    active = model.active_count(_seconds(model, options))
    sizes = {
        "html": lambda: _PAGE_BYTES + estimate_bytes(gaussians),
        "ply": lambda: record * active,
        "ply-sequence": lambda: record * sum(model.active_count(float(t)) for t in scene.timestamps),
        "splat": lambda: RECORD.itemsize * active,
        "spz": lambda: round(_SPZ_GZIP_RATIO * bytes_per_gaussian(harmonics) * active),
        "colmap": lambda: 150 * scene.num_frames + 40 * min(active, 100_000),
        "nerfstudio": lambda: 700 * scene.num_frames,
    }
    parameters = sum(value.numel() * value.element_size() for value in gaussians.params.values()) + 2 * len(gaussians)
    return sizes.get(to, lambda: parameters)()


def _check(model: SceneModel, to: str, options: ExportOptions) -> None:
    if to not in FORMATS:
        raise InputError(f"Unknown format {to!r}: choose one of {', '.join(FORMATS)}.")
    if options.time is not None:
        if to not in _STILLS:
            raise InputError(f"--time is for {', '.join(_STILLS)}: {to} is not of one time.")
        if not model.first <= options.time <= model.last:
            raise InputError(f"--time {options.time:g} s is outside the clip ({model.first:g} to {model.last:g} s).")
    if options.flip_axes and to not in _FLIPPED:
        raise InputError(f"--flip-axes is for {', '.join(_FLIPPED)}, not for {to}.")
    if options.max_gaussians is not None and options.max_gaussians < 1:
        raise InputError(f"--max-gaussians is {options.max_gaussians}: give at least 1.")
    if not len(model.gaussians):
        raise InputError("The scene has no Gaussians: there is nothing to export.")


def _seconds(model: SceneModel, options: ExportOptions) -> float:
    return (model.first + model.last) / 2 if options.time is None else options.time


def _default_name(to: str) -> str:
    names = {"html": "player.html", "npz": "gaussians.npz", "safetensors": "gaussians.safetensors"}
    return names.get(to, to if to in _FOLDERS else f"scene.{to}")


def _write(model: SceneModel, scene: Scene, to: str, path: Path, options: ExportOptions) -> None:
    seconds = _seconds(model, options)
    if to == "html":
        write_player(path, model, scene.timestamps.tolist(), scene.cameras, scene.name, loop_widths(model, scene))
    elif to == "ply":
        write_ply(path, still_at(model, seconds, flip_axes=options.flip_axes), _has_objects(model), _comments(scene, seconds))
    elif to == "ply-sequence":
        _write_sequence(path, model, scene, options)
    elif to == "splat":
        write_splat(path, still_at(model, seconds, flip_axes=options.flip_axes))
    elif to == "spz":
        write_spz(path, still_at(model, seconds, flip_axes=True))
    elif to == "npz":
        write_parameters_npz(path, model)
    elif to == "safetensors":
        write_parameters_safetensors(path, model)
    elif to == "colmap":
        resting = model.gaussians.select(torch.nonzero(model.gaussians.at_rest).squeeze(1))
        write_colmap(path, scene, still_at(replace(model, gaussians=resting) if len(resting) else model, seconds))
    else:
        write_nerfstudio(path, scene)


def _write_sequence(folder: Path, model: SceneModel, scene: Scene, options: ExportOptions) -> None:
    """``frame0001.ply`` and so on, one a frame of the clip; files of a longer sequence that was there before go."""
    entries = [entry for entry in folder.iterdir() if not entry.name.startswith(".")]
    foreign = [entry.name for entry in entries if not _SEQUENCE_FILE.fullmatch(entry.name)]
    if foreign:
        raise InputError(f"{folder} holds something else ({min(foreign)}): give an empty folder with -o.")
    names = [f"frame{k:04d}.ply" for k in range(1, scene.num_frames + 1)]
    for name, seconds in zip(names, track(scene.timestamps.tolist(), "Writing the sequence"), strict=True):
        still = still_at(model, seconds, flip_axes=options.flip_axes)
        write_ply(folder / name, still, _has_objects(model), _comments(scene, seconds))
    for entry in entries:
        if entry.name not in names:
            entry.unlink()


def _has_objects(model: SceneModel) -> bool:
    return bool(model.gaussians.object_ids.any())


def _comments(scene: Scene, seconds: float) -> list[str]:
    return [f"{re.sub(r'[^ -~]', '?', scene.name)} at {seconds:.4f} s"]


def _readable(size: float) -> str:
    for unit in ("B", "kB", "MB"):
        if size < 1000:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.3g} GB"
