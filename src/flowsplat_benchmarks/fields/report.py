"""The fields as a table of every scene, beside ``default`` and what the paper tells of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from flowsplat_benchmarks.ablations.page import how_measured, scene_names, write_ablation_report
from flowsplat_benchmarks.tables import Column, Result, Table, text

TITLE = "T-NeRF and HyperNeRF in as much time"
DEFAULT = "default"
"""Name of the run that the fields are compared with."""
LABELS = {DEFAULT: "Flow Splatting, preset default", "t-nerf": "T-NeRF", "hypernerf": "HyperNeRF"}
REMARKS = (
    "The fields are trained on the same training frames and cameras as default, for the seconds that it took, and for a multiple "
    "of them; their priors are none but how near and how far the scene is. In brackets: inside the masks of what moves.",
    "The networks are as large as published. A ray has 32 samples and 32 more, and a step 256 rays; HyperNeRF has 128 and 128, and "
    "6,144 rays of four accelerators. Schedules of hundreds of thousands of steps are shortened to those that fit. HyperNeRF has "
    "no code of the appearance of a frame here, and that of a held-out frame is mixed from its neighbors in time.",
    "The paper's rows (its Table 1, of other scenes, on a GPU): T-NeRF 20.76 dB, SSIM 0.59; HyperNeRF 20.05 dB, SSIM 0.57; Flow "
    "Splatting 22.72 dB, SSIM 0.72. It trains both fields for more than 20 hours. A row here says what a field reaches in its "
    "seconds on these cores, and nothing of what it would reach with more.",
)
COLUMNS = (
    Column("SSIM", ("ssim",), 3), Column("inside", ("inside_ssim",), 3), Column("LPIPS", ("lpips",), 3),
    Column("steps", ("iterations",), 0), Column("seconds of training", ("seconds", "train"), 0),
    Column("of all cores", ("seconds", "train_cpu"), 0), Column("seconds an image", ("image_seconds",), 2),
    Column("numbers, million", ("parameters",), 2, 1e-6), Column("peak memory, GiB", ("peak_memory_gib",), 1),
)  # fmt: skip


def write_report(out: Path, results: Sequence[Result], failed: Mapping[str, str], others: int = 0) -> Path:
    """Write the tables of some results, and return the path of the page.

    Args:
        results: with the same settings.
        failed: runs that could not be made, and why.
        others: how many results in ``out`` are none of these.

    Raises:
        InputError: the folder cannot be written.
    """
    tables = [_list_scene(scene, name, results) for scene, name in scene_names(results).items()]
    remarks = [*REMARKS, how_measured(results)] if results else []
    return write_ablation_report(out, "fields", TITLE, f"Runs measured: {len(results)}.", remarks, tables, failed, others)


def describe_run(result: Result) -> str:
    """Return what was trained, and for how many seconds on how many cores.

    >>> describe_run({"variant": "t-nerf", "seconds": {"train": 611.2}, "cores": 2, "threads": 1})
    'T-NeRF, 611 seconds on 2 cores (1 thread)'
    """
    cores, threads = int(result["cores"]), int(result["threads"])
    used = "" if threads == cores else f" ({threads} thread{'' if threads == 1 else 's'})"
    where = f"{cores} core{'' if cores == 1 else 's'}{used}"
    return f"{LABELS[result['variant']]}, {result['seconds']['train']:,.0f} seconds on {where}"


def _list_scene(scene: str, name: str, results: Sequence[Result]) -> Table:
    order = list(LABELS)
    found = [result for result in results if result["scene"] == scene]
    found.sort(key=lambda result: (order.index(result["variant"]) > 0, result["times"], order.index(result["variant"])))
    columns = [column for column in COLUMNS if column.is_in(found)]
    rows = [
        (
            describe_run(result), "1" if result["variant"] == DEFAULT else f"{result['times']}",
            f"{text(result['psnr'], 2)} ({text(result['moving'], 2)})", *(column.cell(result) for column in columns),
        )
        for result in found
    ]  # fmt: skip
    strong = tuple(k for k, result in enumerate(found) if result["variant"] == DEFAULT)
    note = "PSNR in dB. Times: how many times the seconds that were given, those of default where nothing else is said."
    return Table(name, note, ("", "times", "PSNR", *(column.header for column in columns)), rows, strong)
