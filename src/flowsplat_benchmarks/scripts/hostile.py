"""Kills and full disks: does a run end with the same figures, and does it say in a line what went wrong?

``python -m flowsplat_benchmarks.scripts.hostile OUT --kills 60 --disks 6``.
A run on a small rendered scene is killed (SIGKILL) after random times until it has been killed so often, and compared with one that
was left alone. Then it is begun on disks of some sizes (tmpfs; needs root), each of which fills up, and goes on when there is room.
"""

from __future__ import annotations

import argparse
import json
import random
import shutil
import subprocess
import sys
import time
from pathlib import Path

from flowsplat.scenes.synthetic import SyntheticScene, write_synthetic

SETTINGS = ["--priors", "true", "--train.iterations", "200", "--train.checkpoint-every", "20", "--render.paths", "input"]


def command(scene: Path, out: Path) -> list[str]:
    """The run."""
    return [sys.executable, "-m", "flowsplat.cli", "run", str(scene), "-o", str(out), *SETTINGS]


def result(out: Path) -> tuple[object, bytes]:
    """Figures without times and memory, and the model."""
    metrics = json.loads((out / "metrics.json").read_text())
    figures = {
        name: value for name, value in metrics.items() if name not in ("seconds", "wall_seconds", "memory_gib", "peak_memory_gib")
    }
    return figures, (out / "model" / "gaussians.safetensors").read_bytes() + (
        out / "model_all_frames" / "gaussians.safetensors"
    ).read_bytes()


def kills(scene: Path, folder: Path, count: int) -> dict[str, object]:
    """Runs that are killed, each again and again until it is through, ``count`` kills in all."""
    began = time.monotonic()
    subprocess.run(command(scene, folder / "whole"), check=True, capture_output=True)
    whole = time.monotonic() - began
    wanted, rng, killed, runs, same = result(folder / "whole"), random.Random(0), 0, 0, 0
    while killed < count:
        out = folder / "killed"
        shutil.rmtree(out, ignore_errors=True)
        runs += 1
        while killed < count:
            process = subprocess.Popen(command(scene, out), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            try:
                process.wait(timeout=rng.uniform(0.1, 1.0) * whole)
                break
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
                killed += 1
        subprocess.run(command(scene, out), check=True, capture_output=True)
        left = [path.name for path in out.rglob(".*") if ".partial" in path.name or path.name == ".lock"]
        same += result(out) == wanted and not left
    return {"kills": killed, "runs": runs, "runs that ended with the same figures and models, nothing half-written": same}


def disks(scene: Path, folder: Path, sizes: list[int]) -> dict[str, object]:
    """Runs on disks of so many KiB."""
    subprocess.run(command(scene, folder / "whole"), check=True, capture_output=True)
    wanted, lines, same = result(folder / "whole"), 0, 0
    for size in sizes:
        disk = folder / "disk"
        disk.mkdir(exist_ok=True)
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}k", "tmpfs", str(disk)], check=True)
        try:
            ended = subprocess.run(command(scene, disk / "out"), capture_output=True, text=True)
            last = ended.stderr.strip().splitlines()[-1]
            print(f"{size} KiB: {ended.returncode} {last}", flush=True)
            lines += ended.returncode == 2 and "disk is full" in last and "Traceback" not in ended.stderr
            subprocess.run(["mount", "-o", "remount,size=1g", str(disk)], check=True)
            subprocess.run(command(scene, disk / "out"), check=True, capture_output=True)
            same += result(disk / "out") == wanted
        finally:
            subprocess.run(["umount", str(disk)], check=True)
    return {"disks": len(sizes), "ended with a line": lines, "ended with the same figures and models later": same}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--disks", type=int, default=0)
    options = parser.parse_args()
    options.out.mkdir(parents=True)
    write_synthetic(options.out / "scene", SyntheticScene(width=64, height=48, frames=12, fps=6.0), holdout=10)
    began = time.monotonic()
    if options.kills:
        print(json.dumps(kills(options.out / "scene", options.out, options.kills), indent=1), flush=True)
    if options.disks:
        sizes = [round(60 * 2.2**k) for k in range(options.disks)]
        print(json.dumps(disks(options.out / "scene", options.out, sizes), indent=1), flush=True)
    print(f"{time.monotonic() - began:.0f} s")


if __name__ == "__main__":
    main()
