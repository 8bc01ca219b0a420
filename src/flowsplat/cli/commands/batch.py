"""``flowsplat batch``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import tyro

from flowsplat.batch.options import BatchOptions
from flowsplat.cli.arguments import NO_PREFIX, Preset, value_of
from flowsplat.cli.command import Command, preset_defaults
from flowsplat.pipeline.config import RunConfig


def build(defaults: RunConfig) -> Callable[..., bool]:
    """The command with these settings by default."""

    def batch(
        inputs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="INPUT [...]")],
        out: Annotated[Path | None, tyro.conf.arg(aliases=("-o",), metavar="OUT")] = None,
        preset: Preset = "default",
        options: Annotated[BatchOptions, NO_PREFIX] = BatchOptions(),  # noqa: B008 (frozen)
        config: Annotated[RunConfig, NO_PREFIX] = defaults,
    ) -> bool:
        """Many clips, each an ordinary run in OUT/<id>: as many at a time as cores and memory allow, on any number of machines.

        The same command again continues; flowsplat batch OUT does, too, with the inputs and settings of before. Any number of
        processes may work on one OUT. Exit code 0: all clips are done; 1: some are not; 2: the batch itself cannot be done.

        Args:
            inputs: Clips (all that run takes), folders of clips, and lists: a .txt with a path on every line; a .csv, .tsv or
                .jsonl with path, perhaps id, and options of run by their names (start, end, mask-click, ...). Or OUT alone.
            out: Folder for everything that comes out: OUT/<id>, OUT/batch.json and OUT/index.html.
            preset: As for run.
            options: How the batch is done.
            config: All settings of the runs.
        """
        from flowsplat.batch.command import run_batch

        return run_batch(inputs, out, config, options)

    return batch


def batch_defaults(arguments: Sequence[str]) -> RunConfig:
    """The settings of the batch that a command continues, where it names nothing but that; else those of a preset.

    Raises:
        InputError: the plan of the batch is damaged, or there is no such preset.
    """
    from flowsplat.batch.command import read_plan

    if any(value_of(arguments, option) is not None for option in ("-o", "--out")) or value_of(arguments, "--preset"):
        return preset_defaults(arguments)
    for argument in arguments[1:]:
        if not argument.startswith("-") and (plan := read_plan(Path(argument))) is not None:
            return plan[1]
    return preset_defaults(arguments)


COMMAND = Command(build, batch_defaults, place=20)
