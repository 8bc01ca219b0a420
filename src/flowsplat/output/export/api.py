"""Export a trained scene: what holds for every format is checked and told here, and then the format writes."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.files import make_folder
from flowsplat.common.progress import as_one, report
from flowsplat.gaussians.crop import crop, parse_crop
from flowsplat.gaussians.model import SceneModel
from flowsplat.geometry import Camera
from flowsplat.output.export.formats import EXPORTERS, Write
from flowsplat.output.export.importance import choose_most_important
from flowsplat.output.export.options import ExportOptions
from flowsplat.output.export.still import middle_or
from flowsplat.output.export.strays import bring_strays_near
from flowsplat.output.player.chebyshev import find_seen_in_clip
from flowsplat.scenes import Scene

SIZE_MARGIN = 0.98
"""Share that is kept of the Gaussians that would have room if each took as many bytes as now. Chosen by eye."""


def export_scene(
    model: SceneModel,
    scene: Scene,
    to: str,
    path: str | Path | None,
    options: ExportOptions,
    one_color: Callable[[], SceneModel] | None = None,
    *,
    is_part: bool = False,
) -> Path:
    """Write a trained scene in a format of others, or as the single-file player.

    Args:
        model: the trained scene.
        scene: the prepared scene that it was trained on.
        to: one of the formats (docs/formats.md).
        path: the file or folder to write; None = beside the scene, in ``export/``.
        options: what and how.
        one_color: gives the scene as it was fitted without slopes of brightness, for formats that hold none; None, or where it
            raises an ``InputError``: they are left out.
        is_part: of another file: what that one holds, and how it is embedded, is for its writer to tell.

    Returns:
        what was written: a file or a folder.

    Raises:
        InputError: an unknown format, an option that does not fit it or the clip, or a place that cannot be written.
    """
    exporter = EXPORTERS[to]
    _check(model, to, options)
    path = Path(path) if path is not None else scene.folder.parent / "export" / exporter.default_name
    if path.is_dir() and not exporter.is_folder:
        raise InputError(f"{path} is a folder, {to} is one file: give a name for it with -o.")
    if path.is_file() and exporter.is_folder:
        raise InputError(f"{path} is a file, {to} needs a folder: give another one with -o.")
    box = None if options.crop is None else parse_crop(options.crop)
    # Before anything is fitted or written it is said that nothing is left.
    _check_shown(model if box is None else crop(model, box), to, options)
    make_folder(path if exporter.is_folder else path.parent)
    if exporter.has_gaussians and not exporter.keeps_slopes and model.gaussians.has_slopes:
        model = _without_slopes(model, scene, to, options, one_color)
    write = exporter.write if exporter.begin is None else exporter.begin(model, scene)
    if box is not None:
        model = crop(model, box)
    if exporter.rounds:
        model = bring_strays_near(model, to)
        _check_shown(model, to, options)
    if options.max_gaussians is not None and exporter.has_gaussians:
        model = choose_most_important(model, _list_views(scene), options.max_gaussians)
    if options.size_mb is not None:
        model = _fit_size(model, scene, write, path.name, options, 1e6 * options.size_mb)
    _check_shown(model, to, options)
    what = f"{len(model.gaussians):,} Gaussians" if exporter.has_gaussians else f"{scene.num_frames} cameras"
    report(f"{what} as {to}: about {_readable(exporter.estimate_bytes(model, scene, options))} in {path}")
    write(path, model, scene, options)
    if not path.exists():
        raise InputError(f"Nothing was written: format {to} made no {path}.")
    if is_part:
        return path
    if exporter.note is not None:
        report(exporter.note)
    if options.embed and exporter.embed is not None:
        report(exporter.embed(path, scene))
    return path


def _fit_size(model: SceneModel, scene: Scene, write: Write, name: str, options: ExportOptions, most: float) -> SceneModel:
    """Return the scene with as many Gaussians as ``most`` bytes have room for: how many each takes is known when it is written."""
    with tempfile.TemporaryDirectory() as folder, as_one("Looking how many Gaussians have room"):
        trial = Path(folder) / name

        def measure(tried: SceneModel) -> int:
            write(trial, tried, scene, options)
            return trial.stat().st_size

        count, size = len(model.gaussians), measure(model)
        if size <= most:
            return model
        # What the file holds beside Gaussians. The fewer there are, the more each takes: their number comes from above.
        single = model.gaussians.select(model.gaussians.params["logit_opacities"].argmax()[None])
        rest = measure(replace(model, gaussians=single))
        each = max(size - rest, 1) / count
        while size > most:
            count = min(int(SIZE_MARGIN * (most - rest) / each), count - 1)
            if count < 1:
                raise InputError(
                    f"--size-mb {options.size_mb:g} is too little: beside Gaussians there are {_readable(max(rest, 1))}."
                )
            model = choose_most_important(model, _list_views(scene), count)
            size = measure(model)
            each = max(size - rest, 1) / count
    return model


def _list_views(scene: Scene) -> list[tuple[Camera, float]]:
    return [(scene.cameras[i], float(scene.timestamps[i])) for i in scene.train_frames]


def _check(model: SceneModel, to: str, options: ExportOptions) -> None:
    exporter, entries = EXPORTERS[to], EXPORTERS.entries()
    if options.time is not None:
        if not exporter.is_of_one_time:
            of_one_time = ", ".join(entry.name for entry in entries if entry.value.is_of_one_time)
            raise InputError(f"--time is for {of_one_time}: {to} is not of one time.")
        if not model.first <= options.time <= model.last:
            raise InputError(f"--time {options.time:g} s is outside the clip ({model.first:g} to {model.last:g} s).")
    if options.flip_axes and not exporter.can_flip_axes:
        can = ", ".join(entry.name for entry in entries if entry.value.can_flip_axes)
        raise InputError(f"--flip-axes is for {can}, not for {to}.")
    if options.max_gaussians is not None and options.max_gaussians < 1:
        raise InputError(f"--max-gaussians is {options.max_gaussians}: give at least 1.")
    if options.size_mb is not None and not 0 < options.size_mb < math.inf:
        raise InputError(f"--size-mb is {options.size_mb:g}: give more than 0.")
    if options.size_mb is not None and (exporter.is_folder or not exporter.has_gaussians):
        raise InputError(
            f"--size-mb is for Gaussians in one file: {to} has {'none' if not exporter.has_gaussians else 'a folder'}."
        )
    if options.crop is not None and not exporter.has_gaussians:
        raise InputError(f"--crop is for Gaussians: {to} has none.")
    if options.embed and exporter.embed is None:
        can = ", ".join(entry.name for entry in entries if entry.value.embed is not None)
        raise InputError(f"--embed is for {can}, not for {to}.")
    if not options.sound and not exporter.holds_sound:
        can = ", ".join(entry.name for entry in entries if entry.value.holds_sound)
        raise InputError(f"--no-sound is for {can}: {to} never holds sound.")
    if not len(model.gaussians):
        raise InputError("The scene has no Gaussians: there is nothing to export.")


def _check_shown(model: SceneModel, to: str, options: ExportOptions) -> None:
    """Refuse to write a file of which a reader would show nothing.

    Raises:
        InputError: no Gaussian that is left is there at the time, or at any where the format is not of one.
    """
    exporter = EXPORTERS[to]
    if not exporter.has_gaussians:
        return
    if not bool(find_seen_in_clip(model.gaussians).any()):
        raise InputError("No Gaussian that is left is there at any time of the clip: there is nothing to export.")
    seconds = middle_or(model, options.time)
    if exporter.is_of_one_time and not model.active_count(seconds):
        raise InputError(f"No Gaussian is there at {seconds:g} s: give another --time.")


def _without_slopes(
    model: SceneModel, scene: Scene, to: str, options: ExportOptions, one_color: Callable[[], SceneModel] | None
) -> SceneModel:
    if one_color is not None:
        try:
            return one_color()
        except InputError as error:
            report(f"The scene cannot be fitted to what {to} holds: {error}")
    seconds = middle_or(model, options.time)
    camera = scene.cameras[int(np.abs(scene.timestamps - seconds).argmin())]
    flat = replace(model, gaussians=model.gaussians.without_slopes())
    change = float(np.mean((model.render(camera, seconds).color - flat.render(camera, seconds).color) ** 2))
    same = f"{-10 * np.log10(change):.1f} dB between images with and without it" if change > 0 else "which changes no image here"
    report(
        f"{to} has one color for each Gaussian: how brightness varies inside is left out ({same}). "
        "Of a scene that was trained with --train.model.no-slopes it shows all."
    )
    return flat


def _readable(size: float) -> str:
    for unit in ("B", "kB", "MB"):
        if size < 1000:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.3g} GB"
