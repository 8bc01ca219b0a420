"""A run as Python sees it: ``flowsplat.run("clip.mp4", "out")`` and what came of it."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

from flowsplat.common.errors import InputError
from flowsplat.common.run_paths import RunPaths
from flowsplat.common.settings import list_setting_types, to_plain, with_settings
from flowsplat.evaluation.scores import pick
from flowsplat.gaussians.model import SceneModel
from flowsplat.images.html import format_facts
from flowsplat.output.export.api import export_scene
from flowsplat.output.export.options import ExportOptions
from flowsplat.pipeline import stages
from flowsplat.pipeline.config import RunConfig, check, find_setting, format_option
from flowsplat.pipeline.config import preset as settings_of
from flowsplat.pipeline.folder import RunFolder
from flowsplat.pipeline.renamed_options import find_renamed_option
from flowsplat.pipeline.shot_list import resolve_run
from flowsplat.scenes import Scene


class Run:
    """A run and what is in its folder; read when it is first asked for.

    Examples:
        >>> run = flowsplat.Run("out/clip")
        >>> run.scene
        Scene('out/clip/scene', 12 frames of 64x48, 1 held out, 0 to 1.83 s)
        >>> sorted(run.metrics)[:3]
        ['baselines', 'baselines_views', 'depth_abs_rel']

    Attributes:
        folder: the run's folder.
    """

    def __init__(self, folder: str | Path) -> None:
        """Open a run that there is.

        Raises:
            InputError: the folder holds none.
        """
        self.folder = resolve_run(Path(folder))
        if not RunPaths(self.folder).record_path.exists():
            raise InputError(f"{self.folder} is no run: it has no run.json.")

    @cached_property
    def model(self) -> SceneModel:
        """The trained scene, as ``flowsplat.load`` gives it."""
        return stages.load(self.folder)

    @cached_property
    def scene(self) -> Scene:
        """The prepared clip: frames, cameras and priors."""
        return Scene(RunPaths(self.folder).scene_path)

    @property
    def metrics(self) -> dict[str, Any]:
        """The content of ``metrics.json``.

        Raises:
            InputError: the run was not measured yet, or not since it is trained or prepared anew.
        """
        metrics = stages.find_metrics(RunFolder(self.folder))
        if metrics is None:
            raise InputError(f"{self.folder} was not measured yet: finish flowsplat run, or call flowsplat evaluate {self.folder}.")
        return metrics

    def _facts(self) -> dict[str, str]:
        """Return what is known of it in a few words; nothing of what was not made yet."""
        paths, facts = RunPaths(self.folder), dict[str, str]()
        if (paths.scene_path / "scene.json").exists():
            facts["clip"] = f"{self.scene.num_frames} frames of {self.scene.width}x{self.scene.height}"
        metrics = stages.find_metrics(RunFolder(self.folder)) if paths.metrics_path.exists() else None
        if metrics is None:
            return {**facts, "figures": "not measured yet"}
        for name, path in (("held-out frames", ("heldout_frames", "psnr")), ("held-out views", ("heldout_views", "psnr"))):
            if (value := pick(metrics, *path)) is not None:
                facts[name] = f"{value:.2f} dB"
        facts["Gaussians"] = f"{metrics['gaussians']['total']:,}"
        return facts

    def __repr__(self) -> str:
        facts = "; ".join(f"{name}: {value}" for name, value in self._facts().items())
        return f"Run({str(self.folder)!r}; {facts})"

    def _repr_html_(self) -> str:
        """For notebooks: an image from the middle of the clip, and a few figures."""
        facts = self._facts()
        return format_facts(str(self.folder), facts, self.model.thumbnail() if "Gaussians" in facts else None)


def run(
    source: str | Path, out: str | Path, *, preset: str = "default", overrides: Mapping[str, Any] | None = None
) -> Run:  # fmt: skip
    """Go the whole way: a clip becomes a 4D scene, images and figures. Called again, it continues.

    Args:
        source: a video, a folder of images (or with images/ and masks/), a DAVIS root, a rig scene, an NVIDIA Dynamic Scene
            or a prepared scene.
        out: folder of the run.
        preset: ``default``, ``fast``, ``paper`` or ``high``.
        overrides: other settings, by the names that the command line has: ``{"train.loss.flow": 0.1, "priors": "true"}``.

    Raises:
        InputError: the input, a setting or the folder cannot be used.

    Examples:
        >>> flowsplat.run("clip.mp4", "out/new", overrides={"train.los.flow": 0.1})
        Traceback (most recent call last):
        flowsplat.common.errors.InputError: There is no setting 'train.los.flow'. Did you mean train.loss.flow or ...?
    """
    stages.run(Path(source), Path(out), make_config(preset, overrides or {}))
    return Run(out)


def export(
    source: Run | str | Path, to: str, out: str | Path | None = None, *, time: float | None = None, flip_axes: bool = False,
    max_gaussians: int | None = None, size_mb: float | None = None, embed: bool = False, sound: bool = True,
) -> Path:  # fmt: skip
    """Write a trained run in the format of other programs, or as a page that plays it.

    Args:
        source: the run, or its folder.
        to: ``html`` (the player), or another of the formats of docs/formats.md, such as ``ply``.
        out: the file or folder to write; None = in the folder of the run, in ``export/``.
        time: seconds of the clip that a format of one time shows; None = the middle.
        flip_axes: turn y up and z backward, in formats that do not prescribe their axes.
        max_gaussians: keep at most this many: those without which the training frames would change most. None = all.
        size_mb: millions of bytes that the file may have: as many Gaussians are kept as have room. None = any size.
        embed: of the page, also tell the line of HTML that shows it in another page.
        sound: put the clip's sound in, where the format has a place for it.

    Returns:
        what was written: a file or a folder.

    Raises:
        InputError: there is no trained scene, an unknown format, an option that does not fit it or the clip, or a place that cannot
            be written.

    Examples:
        >>> flowsplat.export("out/clip", "ply", "out/scene.ply", time=0.5)
        PosixPath('out/scene.ply')
    """
    run = source if isinstance(source, Run) else Run(source)
    options = ExportOptions(time=time, flip_axes=flip_axes, max_gaussians=max_gaussians, size_mb=size_mb, embed=embed, sound=sound)
    return export_scene(run.model, run.scene, to, out, options, stages.one_color_of(run.folder))


def make_config(name: str, overrides: Mapping[str, Any]) -> RunConfig:
    """Return the settings of a preset with some changed.

    Args:
        name: of the preset.
        overrides: values by the command line's names, with or without leading hyphens, hyphens or underscores within.

    Raises:
        InputError: there is no such preset or setting, or its value is of another type.
    """
    changes = {}
    for given, value in overrides.items():
        if (setting := find_setting(given)) is None:
            if now := find_renamed_option(given):
                raise InputError(f"The setting {given!r} is called {now.removeprefix('--')!r} now.")
            options = [format_option(known).removeprefix("--") for known in list_setting_types(RunConfig)]
            near = difflib.get_close_matches(given.lstrip("-").replace("_", "-"), options, 3)
            meant = f" Did you mean {' or '.join(near)}?" if near else ""
            raise InputError(f"There is no setting {given!r}.{meant}")
        changes[setting] = to_plain(value)
    config = with_settings(settings_of(name), changes)
    config.input.check()
    check(config)
    return config
