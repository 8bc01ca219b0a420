"""Measure how right and how fast the GPU backend is on this machine, beside gsplat and beside what the card could do.

    python -m flowsplat_benchmarks.scripts.gpu --everything --minutes 8          # kernels tested, measured, whole runs
    python -m flowsplat_benchmarks.scripts.gpu --everything --scene out/bear/scene   # and a training of this prepared scene
    python -m flowsplat_benchmarks.scripts.gpu --only step frames                # these parts of it, beside those that OUT has
    python -m flowsplat_benchmarks.scripts.gpu --everything --rehearse           # tiny, in Triton's interpreter: without a card
    python -m flowsplat_benchmarks.scripts.gpu --everything --plan               # what would be done in which second
    python -m flowsplat_benchmarks.scripts.gpu --page RESULT.json                # what it found, as a page

Milliseconds are the card's own. Without a GPU that works it says so and ends with code 2.
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

from flowsplat.common.devices import gpu_problem
from flowsplat.common.errors import InputError
from flowsplat.common.files import read_json
from flowsplat_benchmarks.scripts.cpu_parts.timing import tell
from flowsplat_benchmarks.scripts.gpu_parts import everything
from flowsplat_benchmarks.scripts.gpu_parts.page import page

OUT = Path("gpu.json")


def run(options: argparse.Namespace) -> int:
    """Return what was asked for; the exit code.

    Raises:
        InputError: a file, a scene or the time cannot be used, or there is no GPU.
    """
    if options.page:
        print(*page(read_json(options.page, everything.Found)), sep="\n")
        return 0
    parts = tuple(part for part in everything.PARTS if options.everything or part.name in options.only)
    if not 0 < options.minutes < math.inf:
        raise InputError(f"--minutes {options.minutes:g} must be more than 0.")
    if options.plan:
        second = 0.0
        for part, limit in everything.plan(options.minutes, parts):
            print(f"{second:5.0f} to {second + limit:4.0f} s  {part.name:10} {part.what}")
            second += limit
        return 0
    for scene in options.scene:
        if not (scene / "scene.json").is_file():
            raise InputError(f"{scene} is no prepared scene: it has no scene.json.")
    if not options.rehearse and (problem := gpu_problem()) is not None:
        raise InputError(f"There is no GPU to measure: {problem}.")
    keep = None if options.keep is None else options.keep.resolve()
    result = everything.measure(options.out, options.minutes, parts, options.scene, options.rehearse, options.broken, keep)
    tell(f"wrote {options.out}")
    # A part that failed has its figures missing: whoever calls this from a script should know.
    return int(any(part["outcome"] != "done" for part in result["parts"].values()))


def run_part(options: argparse.Namespace) -> None:
    """One of them, in this process."""
    from flowsplat_benchmarks.scripts.gpu_parts import parts

    scenes = tuple(scene.resolve() for scene in options.scene)
    parts.run(options.part, parts.Record(options.out, options.work, options.seconds, options.rehearse, options.broken, scenes))


def main() -> None:
    """Measure, and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--everything", action="store_true", help="all there is to do, each part in a process of its own")
    names = [part.name for part in everything.PARTS]
    what.add_argument("--only", nargs="+", default=[], choices=names, metavar="PART", help=f"some of it: {', '.join(names)}")
    what.add_argument("--page", type=Path, metavar="JSON", help="print what was written there as a page")
    what.add_argument("--part", choices=names, help=argparse.SUPPRESS)
    parser.add_argument("--minutes", type=float, default=8.0, help="for all of it together (default: 8)")
    parser.add_argument("--scene", type=Path, metavar="FOLDER", action="append", default=[], help="also train this prepared scene")
    parser.add_argument("-o", "--out", type=Path, metavar="JSON", default=OUT, help=f"the result (default: {OUT})")
    parser.add_argument("--plan", action="store_true", help="only say which part would run when")
    parser.add_argument("--rehearse", action="store_true", help="tiny, in Triton's interpreter")
    parser.add_argument("--broken", action="store_true", help="with a kernel that fails on purpose: what still comes?")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="what the parts print, and their runs, stay there")
    parser.add_argument("--work", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--seconds", type=float, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.part:
        run_part(options)
        return
    try:
        sys.exit(run(options))
    except InputError as error:
        tell(str(error))
        sys.exit(2)


if __name__ == "__main__":
    main()
