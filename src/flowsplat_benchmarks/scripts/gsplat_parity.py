"""What of gsplat's public behavior ``flowsplat.rasterization`` has, against gsplat's own torch code, on the CPU.

    python -m flowsplat_benchmarks.scripts.gsplat_parity                          # prints three tables; gsplat must be installed
    python -m flowsplat_benchmarks.scripts.gsplat_parity --docs docs/gsplat.md    # also puts them there, between its two marks

The first table counts cases, by what gsplat documents (``gsplat_parts/behavior.py``). The second says how far off images and
gradients are from the reference (``gsplat_parts/reference.py``) in float64, beside how far the reference itself is in float32. The
third is of trainings: gsplat's strategies, unchanged, on an image, with the kernels and with the reference. A line for every case
goes to stderr as it ends; all of it is some minutes.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from statistics import mean

from flowsplat import gsplat_ops
from flowsplat.common.errors import InputError
from flowsplat.common.files import read_text, write_text
from flowsplat.common.progress import report
from flowsplat.splatting import rasterization
from flowsplat_benchmarks.scripts.gsplat_parts import behavior, trainings
from flowsplat_benchmarks.scripts.gsplat_parts.reference import rasterize_as_gsplat
from flowsplat_benchmarks.tables import format_table

MARKS = "<!-- measured: begin -->", "<!-- measured: end -->"
"""What stands around the tables in the docs."""
PARTS: tuple[Callable[[], Iterator[tuple[str, bool]]], ...] = (
    behavior.check_names_and_shapes, behavior.check_projection, behavior.check_absolute_gradients, behavior.check_drawing,
)  # fmt: skip


def count_cases() -> list[tuple[str, str, str]]:
    """Return rows: what gsplat documents, cases that hold, cases."""
    found: dict[str, list[bool]] = {}
    for part in PARTS:
        began = time.process_time()
        for name, holds in part():
            found.setdefault(name, []).append(holds)
        report(f"{part.__name__}: {time.process_time() - began:.1f} s of the processor")
    return [(name, f"{sum(each):,}", f"{len(each):,}") for name, each in found.items()]


def compare_rounding() -> list[tuple[str, ...]]:
    """Return rows: a case, and the distances of images and gradients with the kernels and with the reference."""
    rows = []
    for name, kernels, reference in behavior.compare_rounding():
        rows.append((name, *(f"{each:.1e}" for far in (kernels, reference) for each in (far.image, far.gradient))))
        report(f"{name}: {', '.join(rows[-1][1:])}")
    return rows


def compare_trainings(steps: int = trainings.STEPS, seeds: Sequence[int] = trainings.SEEDS) -> list[tuple[str, ...]]:
    """Return rows: a strategy; with the kernels and with the reference PSNR (lowest and highest), Gaussians, seconds."""
    rows = []
    for name in trainings.STRATEGIES[:2]:
        trainings.train(rasterization, name, min(steps, 60))  # compiles
    for name in trainings.STRATEGIES:
        cells: list[str] = []
        for draw in (rasterization, rasterize_as_gsplat):
            found = []
            for seed in seeds:
                found.append(trainings.train(draw, name, steps, seed))
                report(f"{name}, {draw.__name__}, seed {seed}: {found[-1]}")
            psnr = [each.psnr for each in found]
            cells.append(f"{mean(psnr):.2f} ({min(psnr):.2f} to {max(psnr):.2f})")
            cells += [f"{mean(each.count for each in found):,.0f}", f"{mean(each.seconds for each in found):.1f}"]
        rows.append((name, *cells))
    return rows


def format_results(steps: int = trainings.STEPS, seeds: Sequence[int] = trainings.SEEDS) -> str:
    """Return the tables as Markdown."""
    cases = format_table(["what gsplat documents", "cases that hold", "cases"], count_cases())
    rounding = format_table(
        ["from float64, relative", "kernels: image", "kernels: worst gradient", "reference: image", "reference: worst gradient"],
        compare_rounding(),
    )
    kinds = [f"{name}: {figure}" for name in ("kernels", "reference") for figure in ("dB", "Gaussians", "s")]
    trained = format_table(
        [f"{steps} steps, {trainings.START} Gaussians at first", *kinds],
        compare_trainings(steps, seeds),
    )
    return "\n".join(["", *cases, "", *rounding, "", *trained, ""])


def put_between_marks(page: str, found: str) -> str:
    """Return a page with other tables.

    Raises:
        InputError: the page has not both marks, once each and in their order.
    """
    before, begin, rest = page.partition(MARKS[0])
    _, end, after = rest.partition(MARKS[1])
    if not begin or not end:
        raise InputError(f"The page has no place for the tables: it needs {MARKS[0]} and, further down, {MARKS[1]}.")
    return f"{before}{begin}\n{found}\n{end}{after}"


def main() -> None:
    """Measure, print, and write where that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--docs", type=Path, help="page to put the tables into")
    options = parser.parse_args()
    try:
        gsplat_ops.install()
    except ImportError as error:
        raise InputError("gsplat is not installed: pip install gsplat (it needs no GPU for this).") from error
    if options.docs:
        put_between_marks(read_text(options.docs), "")
    found = format_results()
    print(found)
    if options.docs:
        write_text(options.docs, put_between_marks(read_text(options.docs), found))


if __name__ == "__main__":
    main()
