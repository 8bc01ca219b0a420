"""How fast the GPU backend is on this machine, beside gsplat and beside what the card could do.

    python benchmarks/gpu.py                      # everything; the result goes to benchmarks/results/
    python benchmarks/gpu.py --quick              # fewer repetitions, nothing is written
    python benchmarks/gpu.py --scene out/bear/scene   # and the seconds from this prepared scene to a trained model

Milliseconds are the card's own. Without a GPU that works it says so and ends with code 2.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
import time
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from cpu_parts.machine import commit
from cpu_parts.timing import tell

from flowsplat.common.devices import gpu_problem
from flowsplat.common.files import write_json

RESULTS = Path(__file__).parent / "results"
STAGES = ("cull", "slice", "project", "features", "blend")
COUNTS = (196_000, 500_000, 1_000_000, 2_000_000, 5_000_000)


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Everything, as it goes into the file."""
    from gpu_parts import frames, machine

    repeat = 10 if options.quick else 100
    limits = machine.limits(repeat)
    result: dict[str, Any] = {
        "format": 1, "date": datetime.now(timezone.utc).isoformat(timespec="seconds"), "quick": options.quick,
        "machine": machine.describe(), **commit(RESULTS.parents[1]), "limits": limits, "frames": {}, "gsplat": {},
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
    if options.scene:
        tell("a whole training ...")
        result["whole_training"] = _train(options.scene)
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


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="few repetitions")
    parser.add_argument("--scene", type=Path, metavar="FOLDER", help="also train this prepared scene")
    parser.add_argument("-o", "--out", type=Path, metavar="JSON", help="write the result here")
    options = parser.parse_args()
    problem = gpu_problem()
    if problem is not None:
        tell(f"There is no GPU to measure: {problem}.")
        sys.exit(2)
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
