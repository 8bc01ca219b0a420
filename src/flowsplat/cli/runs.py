"""Serve commands on a run: its settings as their defaults, the run with some of them changed, and its figures."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from flowsplat.cli.arguments import value_of
from flowsplat.cli.command import preset_defaults
from flowsplat.common.files import lease
from flowsplat.common.progress import console, report
from flowsplat.common.run_paths import RunPaths
from flowsplat.pipeline.config import RunConfig, check

HOLDOUT_NOTE = "These figures are of frames that were kept back (--holdout); --holdout none trains on all of them."


def run_defaults(arguments: Sequence[str]) -> RunConfig:
    """Return the settings of the run that a command works on, trained as a preset says where one is named; without a run the
    preset's.

    Raises:
        InputError: the record of the run is damaged, or there is no such preset.
    """
    from flowsplat.pipeline.folder import RunFolder
    from flowsplat.pipeline.shot_list import resolve_run

    defaults = preset_defaults(arguments)
    for argument in arguments[1:]:
        if argument.startswith("-"):
            continue
        path = resolve_run(Path(argument))
        if RunPaths(path).record_path.exists():
            stored = RunFolder(path).config
            return replace(stored, train=defaults.train) if value_of(arguments, "--preset") else stored
    return defaults


@contextlib.contextmanager
def change_run(out: Path, **changes: Any) -> Iterator[Any]:
    """The run in a folder, with some of its settings changed from now on, and nobody else's meanwhile."""
    from flowsplat.pipeline.folder import RunFolder

    check(replace(RunFolder(out).config, **changes))  # before anything is written there
    with lease(out):
        folder = RunFolder(out)  # another process may just have ended there
        folder.config = replace(folder.config, **changes)
        folder.save()
        yield folder


def print_shot_figures(metrics: Mapping[str, Mapping[str, Any]], out: Path) -> None:
    """Print the figures of the shots of a clip beside each other, and what to do next.

    Args:
        metrics: as in metrics.json, by the name of the shot.
        out: folder that holds their runs.
    """
    from flowsplat.pipeline.shots import word_next_steps
    from flowsplat.pipeline.summary import figures_table

    console.print(figures_table({f"shot {name}": figures for name, figures in metrics.items()}))
    if any(figures["heldout_frames"] is not None for figures in metrics.values()):
        report(HOLDOUT_NOTE)
    for line in word_next_steps(out):
        report(line)


def print_figures(metrics: dict[str, Any], out: Path) -> None:
    """Print the figures of a run, what they are of, a verdict in words and what to do next.

    Args:
        metrics: as in metrics.json.
        out: folder of the run.
    """
    from flowsplat.output.verdict import verdict
    from flowsplat.pipeline.summary import figures_table, next_steps, suggest_hints

    console.print(figures_table({"": metrics}))
    if metrics["heldout_frames"] is not None:
        report(HOLDOUT_NOTE)
    for line in (verdict(metrics), *suggest_hints(metrics), *next_steps(out)):
        report(line)
