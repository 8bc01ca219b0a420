"""``flowsplat benchmark all``."""

from __future__ import annotations

from pathlib import Path

from flowsplat.cli.arguments import Out
from flowsplat.cli.command import Command
from flowsplat_benchmarks.commands import WORK, Names, Numbers, Root, Work


def run(
    root: Root, out: Out, only: Names = (), seeds: Numbers = (), dry_run: bool = False, report_only: bool = False,
    retry_failed: bool = False, docs: Path | None = None, work: Work = WORK,
) -> None:  # fmt: skip
    """Everything whose figures the results pages show, as cells (one benchmark, clip and seed): a night on two cores.

    Each cell leaves one OUT/cells/<cell>.json with its figures, commit, machine, threads and seconds, or with why it failed; the
    pages in OUT/pages show failures, too. With as many --workers as cores each cell has one thread, and its seconds are those of
    the processor, which other work on the machine leaves as they are. Short cells come first. The same command again skips what
    is done at this commit and goes on where it was stopped.

    Args:
        root: Folder with davis/<clip>/images and masks, rig/<scene> and flow/<pair>; cells whose scene is not there are left out.
        out: Folder for everything that comes out.
        only: Only these: names of benchmarks (davis, rig, ...), of scenes, or of cells.
        seeds: Only cells with these seeds.
        dry_run: Only list the cells, whether each is done, and how long the others take, about.
        report_only: Run nothing, and write the pages of what is in OUT.
        retry_failed: Try once more what failed at this commit.
        docs: Folder of the results pages of the documentation (docs/results): they are written there, and what they are written
            of is kept in its folder records. What is kept there of this commit counts as done, so that another machine can go on.
        work: How the benchmark is done.
    """
    from flowsplat_benchmarks.results.benchmark import run_all

    run_all(root, out, only, seeds, dry_run, report_only, retry_failed, docs, work)


COMMAND = Command(lambda _: run, place=70)
