"""How fast the CPU backend is on this machine, and how far from what the machine could do.

    python -m flowsplat_benchmarks.scripts.cpu                        # everything; the result goes to results/ beside it
    python -m flowsplat_benchmarks.scripts.cpu --quick                # fewer repetitions, nothing is written
    python -m flowsplat_benchmarks.scripts.cpu --docs docs/benchmarks_cpu.md
    python -m flowsplat_benchmarks.scripts.cpu --only rasterizer --compare EARLIER.json
    python -m flowsplat_benchmarks.scripts.cpu --read EARLIER.json --docs docs/benchmarks_cpu.md   # measures nothing

The tables are printed as they stand in the docs. What is compared takes turns in one process, and every time is the minimum and
the median of many; still, let nothing else run.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from flowsplat.common.files import write_json, write_text
from flowsplat.common.threads import get_max_threads
from flowsplat_benchmarks.scripts.cpu_parts import large, machine, rasterizer, scaling, startup, step, variants
from flowsplat_benchmarks.scripts.cpu_parts.report import comparison, format_page
from flowsplat_benchmarks.scripts.cpu_parts.timing import tell

RESULTS = Path(__file__).parent / "results"


@dataclass(frozen=True)
class Effort:
    """How often everything is measured."""

    rasterizer: int = 25
    torch: int = 3
    training: int = 16
    viewing: int = 30
    growth: int = 7
    counts: tuple[int, ...] = (10_000, 30_000, 100_000, 300_000, 1_000_000)
    sizes: tuple[str, ...] = tuple(scaling.SIZES)
    channels: tuple[int, ...] = (1, 3, 6, 10, 16)
    large: int = 5
    warm: int = 7
    cold: int = 2
    turns: int = 3


QUICK = Effort(
    rasterizer=5, torch=1, training=4, viewing=6, growth=2, counts=(10_000, 100_000, 1_000_000), sizes=("240p", "480p", "4K"),
    channels=(3, 6, 10), large=2, warm=2, cold=1, turns=1,
)  # fmt: skip


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Everything that was asked for, as it goes into the file."""
    effort = QUICK if options.quick else Effort()
    available = get_max_threads()
    threads = sorted({min(count, available) for count in options.threads})
    most, limits = threads[-1], machine.Limits()
    sizes = scaling.SIZES["480p"], scaling.SIZES["240p"]
    parts: dict[str, Callable[[], dict[str, Any]]] = {
        "rasterizer": lambda: rasterizer.measure(limits, sizes, (3, 6, 10), threads, effort.rasterizer),
        "torch": lambda: rasterizer.compare_with_torch(sizes[0], 3, threads, effort.torch),
        "training": lambda: step.measure_training(most, effort.training),
        "viewing": lambda: step.measure_viewing(most, effort.viewing),
        "scaling": lambda: scaling.measure(limits, effort.counts, effort.sizes, effort.channels, most, effort.growth),
        "large": lambda: large.measure(most, effort.large),
        "startup": lambda: startup.measure(effort.warm, effort.cold),
    }
    result: dict[str, Any] = {
        "format": 1, "date": datetime.now(timezone.utc).isoformat(timespec="seconds"), "quick": options.quick,
        "machine": machine.describe(), **machine.commit(RESULTS.parent), "load_before": machine.load(),
    }  # fmt: skip
    for name in parts if options.only is None else options.only:
        tell(f"{name} ...")
        result[name] = parts[name]()
    if options.isa:
        tell("variants ...")
        result["variants"] = variants.measure([options.isa], threads, effort.turns, options.quick)
    result |= {"load_after": machine.load(), "limits": limits.to_json()}
    return _merge_result(json.loads(options.add_to.read_text(encoding="utf-8")), result) if options.add_to else result


def _merge_result(earlier: dict[str, Any], result: dict[str, Any]) -> dict[str, Any]:
    """An earlier result with what was measured now in place of or beside what it has."""
    for name in ("machine", "commit"):
        if earlier[name] != result[name]:
            raise SystemExit(f"--add-to: the {name} is not the same: {earlier[name]} then, {result[name]} now")
    return earlier | {name: value for name, value in result.items() if value}


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = ("rasterizer", "torch", "training", "viewing", "scaling", "large", "startup")
    parser.add_argument("--quick", action="store_true", help="few repetitions")
    parser.add_argument("--only", nargs="*", choices=parts, help="only these parts")
    parser.add_argument("--threads", nargs="+", type=int, default=[1, 2], help="numbers of threads; the most is used where one is")
    parser.add_argument("--isa", choices=["avx2"], help="the rasterizer once more, compiled for this instruction set")
    parser.add_argument("--read", type=Path, metavar="JSON", help="measure nothing, show this result")
    parser.add_argument("--add-to", type=Path, metavar="JSON", help="put what is measured into this result of the same commit")
    parser.add_argument("--compare", type=Path, metavar="JSON", help="print the ratios to an earlier result")
    parser.add_argument("--docs", type=Path, metavar="MD", help="write the tables into this page")
    parser.add_argument("-o", "--out", type=Path, metavar="JSON", help="write the result here")
    return parser


def main() -> None:
    """Measure, print, write."""
    options = _parser().parse_args()
    result = json.loads(options.read.read_text(encoding="utf-8")) if options.read else measure(options)
    page = format_page(result)
    print(page)
    if options.compare:
        print(comparison(result, json.loads(options.compare.read_text(encoding="utf-8"))))
    whole = not (options.read or options.quick or options.only is not None)
    options.out = options.out or options.add_to
    name = re.sub(r"[^a-z0-9]+", "-", result["machine"]["processor"].lower()).strip("-")
    out = options.out or (RESULTS / f"cpu-{name}.json" if whole else None)
    if out:
        out.parent.mkdir(parents=True, exist_ok=True)
        write_json(out, result)
        tell(f"wrote {out}")
    if options.docs:
        write_text(options.docs, page)
        tell(f"wrote {options.docs}")


if __name__ == "__main__":
    main()
