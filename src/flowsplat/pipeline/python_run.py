"""A run as Python sees it: ``flowsplat.run("clip.mp4", "out")`` and what came of it."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from functools import cached_property
from html import escape
from pathlib import Path
from typing import Any

from flowsplat.common.errors import InputError
from flowsplat.common.run_paths import RunPaths
from flowsplat.common.settings import list_setting_types, to_plain, with_settings
from flowsplat.evaluation.scores import pick
from flowsplat.gaussians.model import SceneModel
from flowsplat.images.html import data_uri
from flowsplat.pipeline import stages
from flowsplat.pipeline.config import RunConfig, check, find_setting, format_option
from flowsplat.pipeline.config import preset as settings_of
from flowsplat.pipeline.renamed_options import find_renamed_option
from flowsplat.scenes import Scene

THUMBNAIL = 320
"""Pixels: the longer side of the image that a notebook shows."""


class Run:
    """A run and what is in its folder; read when it is first asked for.

    Attributes:
        folder: the run's folder.
    """

    def __init__(self, folder: str | Path) -> None:
        """Open a run that there is.

        Raises:
            InputError: the folder holds none.
        """
        self.folder = Path(folder)
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
            InputError: the run was not measured yet.
        """
        return stages.read_metrics(RunPaths(self.folder).metrics_path)

    def _facts(self) -> dict[str, str]:
        """What is known of it in a few words; nothing of what was not made yet."""
        paths, facts = RunPaths(self.folder), dict[str, str]()
        if (paths.scene_path / "scene.json").exists():
            facts["clip"] = f"{self.scene.num_frames} frames of {self.scene.width}x{self.scene.height}"
        if not paths.metrics_path.exists():
            return {**facts, "figures": "not measured yet"}
        metrics = self.metrics
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
        facts, image = self._facts(), ""
        rows = "".join(f"<tr><td>{escape(name)}</td><td>{escape(value)}</td></tr>" for name, value in facts.items())
        if "Gaussians" in facts:
            middle = self.scene.num_frames // 2
            camera = self.scene.cameras[middle]
            factor = min(1.0, THUMBNAIL / max(camera.width, camera.height))
            camera = camera.resize(max(round(camera.width * factor), 1), max(round(camera.height * factor), 1))
            shown = self.model.render(camera, float(self.scene.timestamps[middle])).color
            image = f'<img alt="frame {middle}" src="{data_uri(shown)}"><br>'
        return f"<div><b>{escape(str(self.folder))}</b><br>{image}<table>{rows}</table></div>"


def run(
    source: str | Path, out: str | Path, *, preset: str = "default", overrides: Mapping[str, Any] | None = None
) -> Run:  # fmt: skip
    """The whole way: a clip becomes a 4D scene, images and figures. Called again, it continues.

    Args:
        source: a video, a folder of images (or with images/ and masks/), a DAVIS root, a rig scene, an NVIDIA Dynamic Scene
            or a prepared scene.
        out: folder of the run.
        preset: ``default``, ``fast``, ``paper`` or ``high``.
        overrides: other settings, by the names that the command line has: ``{"train.loss.flow": 0.1, "priors": "true"}``.

    Raises:
        InputError: the input, a setting or the folder cannot be used.
    """
    stages.run(Path(source), Path(out), make_config(preset, overrides or {}))
    return Run(out)


def make_config(name: str, overrides: Mapping[str, Any]) -> RunConfig:
    """The settings of a preset with some changed.

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
