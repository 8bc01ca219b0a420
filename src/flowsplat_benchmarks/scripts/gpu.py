"""How fast the GPU backend is on this machine, beside gsplat and beside what the card could do.

    python -m flowsplat_benchmarks.scripts.gpu                             # everything; the result goes to results/ beside it
    python -m flowsplat_benchmarks.scripts.gpu --quick                     # fewer repetitions, nothing is written
    python -m flowsplat_benchmarks.scripts.gpu --scene out/bear/scene      # and from this prepared scene to a trained model
    python -m flowsplat_benchmarks.scripts.gpu --everything --minutes 8    # all there is to do with a card
    python -m flowsplat_benchmarks.scripts.gpu --everything --rehearse     # the same, tiny, in Triton's interpreter: without a card
    python -m flowsplat_benchmarks.scripts.gpu --everything --plan         # what would be done in which second
    python -m flowsplat_benchmarks.scripts.gpu --page RESULT.json          # what it found, as a page

Everything: kernels tested, measured, whole runs.
Milliseconds are the card's own. Without a GPU that works it says so and ends with code 2.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import tempfile
import time
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from flowsplat.common.devices import gpu_problem
from flowsplat.common.files import write_json
from flowsplat_benchmarks.scripts.cpu_parts.machine import commit
from flowsplat_benchmarks.scripts.cpu_parts.timing import tell

RESULTS = Path(__file__).parent / "results"
STAGES = ("cull", "slice", "project", "features", "blend")
COUNTS = (196_000, 500_000, 1_000_000, 2_000_000, 5_000_000)


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Everything, as it goes into the file."""
    from flowsplat_benchmarks.scripts.gpu_parts import frames, machine

    repeat = 10 if options.quick else 100
    limits = machine.limits(repeat)
    result: dict[str, Any] = {
        "format": 1, "date": datetime.now(timezone.utc).isoformat(timespec="seconds"), "quick": options.quick,
        "machine": machine.describe(), **commit(RESULTS.parent), "limits": limits, "frames": {}, "gsplat": {},
    }  # fmt: skip
    for name, (width, height) in frames.SIZES.items():
        model = frames.gaussians(frames.TOTAL, width, height)
        for channels in frames.WAYS:
            tell(f"{name}, C = {channels} ...")
            picture = frames.Frames(model, width, height, channels)
            result["frames"][f"{name}, C = {channels}"] = picture.measure(limits, repeat)
            result["gsplat"][f"{name}, C = {channels}"] = picture.compare_with_gsplat(repeat)
    tell("training ...")
    result["training"] = frames.training_step(repeat)
    tell("growth ...")
    result["growth"] = frames.growth(COUNTS[:2] if options.quick else COUNTS, repeat)
    for scene in options.scene[:1]:
        tell("a whole training ...")
        result["whole_training"] = _train(scene)
    return result


def _train(scene: Path) -> dict[str, Any]:
    """Seconds from a prepared scene to a trained model, and its figures."""
    from dataclasses import replace

    from flowsplat import pipeline

    with tempfile.TemporaryDirectory() as folder:
        config = replace(pipeline.preset("default"), device="cuda")
        run = pipeline.prepare(scene, Path(folder) / "out", config)
        began = time.perf_counter()
        pipeline.train(run)
        seconds = time.perf_counter() - began
        metrics = pipeline.evaluate_run(run)
    return {"scene": scene.name, "seconds": round(seconds, 1), "heldout_frames": metrics["heldout_frames"]}


def lines(result: dict[str, Any]) -> list[str]:
    """The result as a page."""
    machine, limits = result["machine"], result["limits"]
    page = [
        f"# GPU benchmark: {machine['card']}", "",
        f"PyTorch {machine['torch']}, Triton {machine['triton']}, commit {result['commit']}, {result['date']}. Measured limits: "
        f"{limits['copy_bytes_per_second'] / 1e9:,.0f} GB/s copied, {limits['flops_per_second'] / 1e12:.1f} TFLOP/s of FMAs.", "",
        f"| picture | active | forward ms | by graph | frames/s | both ways ms | floor ms | {' | '.join(STAGES)} | gsplat / ours |",
        "| --- | " + "---: | " * 12,
    ]  # fmt: skip
    for name, row in result["frames"].items():
        peer = result["gsplat"][name]
        ratio = peer if isinstance(peer, str) else f"{peer['ratio']['forward']:.2f} / {peer['ratio']['both']:.2f}"
        graph = "" if row["graph"] is None else f"{row['graph']['median_ms']:.3f}"
        stages = " | ".join(f"{row['stages'][stage]['median_ms']:.3f}" for stage in STAGES)
        page.append(
            f"| {name} | {row['active']:,} | {row['forward']['median_ms']:.3f} | {graph} | {row['frames_per_second']:,.0f} | "
            f"{row['forward_and_backward']['median_ms']:.3f} | {row['floor_ms']['forward']:.3f} | {stages} | {ratio} |"
        )
    page += ["", "| training step, 854x480 | ms | peak GiB |", "| --- | ---: | ---: |"]
    page += [f"| {name} | {row['step']['median_ms']:.2f} | {row['peak_memory_gib']} |" for name, row in result["training"].items()]
    page += ["", "| Gaussians | active | forward ms | both ways ms | peak GiB |", "| ---: | ---: | ---: | ---: | ---: |"]
    page += [
        f"| {name} | {row['active']:,} | {row['forward']['median_ms']:.2f} | {row['forward_and_backward']['median_ms']:.2f} | "
        f"{row['peak_memory_gib']} |"
        for name, row in result["growth"].items()
    ]
    if "whole_training" in result:
        whole = result["whole_training"]
        page += ["", f"Training {whole['scene']} took {whole['seconds']} s; held-out frames: {whole['heldout_frames']}."]
    return page


def _everything(options: argparse.Namespace) -> None:
    """All parts, or what they would be."""
    from flowsplat_benchmarks.scripts.gpu_parts import everything

    parts = tuple(part for part in everything.PARTS if not options.only or part.name in options.only)
    if options.plan:
        second = 0.0
        for part, limit in everything.plan(options.minutes, parts):
            print(f"{second:5.0f} to {second + limit:4.0f} s  {part.name:10} {part.what}")
            second += limit
        return
    out = options.out or RESULTS / ("gpu-rehearsal.json" if options.rehearse else "gpu-everything.json")
    out.parent.mkdir(parents=True, exist_ok=True)
    result = everything.everything(
        out,
        options.minutes,
        options.scene,
        options.rehearse,
        options.broken,
        [part.name for part in parts],
        None if options.keep is None else options.keep.resolve(),
    )
    tell(f"wrote {out}")
    # A part that failed has its figures missing: whoever calls this from a script should know.
    sys.exit(0 if all(part["outcome"] == "done" for part in result["parts"].values()) else 1)


def _part(options: argparse.Namespace) -> None:
    """One of them, in this process."""
    from flowsplat_benchmarks.scripts.gpu_parts import parts

    scenes = tuple(scene.resolve() for scene in options.scene)
    parts.run(options.part, parts.Record(options.out, options.work, options.seconds, options.rehearse, options.broken, scenes))


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="few repetitions")
    parser.add_argument("--scene", type=Path, metavar="FOLDER", action="append", default=[], help="also train this prepared scene")
    parser.add_argument("-o", "--out", type=Path, metavar="JSON", help="write the result here")
    parser.add_argument("--everything", action="store_true", help="all there is to do, each part in a process of its own")
    parser.add_argument("--minutes", type=float, default=8.0, help="for everything together")
    parser.add_argument("--only", nargs="+", default=[], metavar="PART", help="these parts of everything")
    parser.add_argument("--page", type=Path, metavar="JSON", help="print what --everything wrote there as a page")
    parser.add_argument("--plan", action="store_true", help="only say which part would run when")
    parser.add_argument("--rehearse", action="store_true", help="tiny, in Triton's interpreter")
    parser.add_argument("--broken", action="store_true", help="with a kernel that fails on purpose: what still comes?")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="what the parts print, and their runs, stay there")
    parser.add_argument("--part", help=argparse.SUPPRESS)
    parser.add_argument("--work", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--seconds", type=float, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.part:
        _part(options)
        return
    if options.page:
        from flowsplat_benchmarks.scripts.gpu_parts.page import page

        print(*page(json.loads(options.page.read_text(encoding="utf-8"))), sep="\n")
        return
    problem = None if options.rehearse or options.plan else gpu_problem()
    if problem is not None:
        tell(f"There is no GPU to measure: {problem}.")
        sys.exit(2)
    if options.everything:
        _everything(options)
        return
    result = measure(options)
    print(*lines(result), sep="\n")
    name = re.sub(r"[^a-z0-9]+", "-", result["machine"]["card"].lower()).strip("-")
    out = options.out or (None if options.quick else RESULTS / f"gpu-{name}.json")
    if out:
        out.parent.mkdir(parents=True, exist_ok=True)
        write_json(out, result)
        tell(f"wrote {out}")


if __name__ == "__main__":
    main()
