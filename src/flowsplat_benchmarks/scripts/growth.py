"""Measure how the cost of a run grows with frames, pixels and Gaussians, on the built-in clip.

``python -m flowsplat_benchmarks.scripts.growth``: every run is a process of its own, with few steps of training, whose time holds
that of loading and beginning; seconds are those of the processor, so that other work on the machine does not count. Says, as
Markdown, what every stage took and how much memory it needed, and the power of the number of frames with which it grew. ``--svg``
draws it. ``--clip FOLDER`` adds runs of clips of your own, ``--only frames`` leaves the others out, ``--json FILE`` keeps the
figures.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from flowsplat.geometry.similarity import align_paths, path_errors
from flowsplat.images.charts import line_chart, svg_file
from flowsplat.images.video import write_mp4
from flowsplat.output.videos import RenderOptions
from flowsplat.pipeline import run
from flowsplat.pipeline.config import RunConfig
from flowsplat.priors.graph import PRIORS
from flowsplat.scenes import Scene
from flowsplat.scenes.clip import InputOptions
from flowsplat.scenes.synthetic import SyntheticScene
from flowsplat_benchmarks.clock import by_the_processor
from flowsplat_benchmarks.scripts.cpu_parts.timing import significant, tell

MODULE = "flowsplat_benchmarks.scripts.growth"
"""This one, which its processes run."""
TRAINING_STEPS = 60
"""Training steps of every run."""
FRAMES = (100, 200, 400, 800)
"""Numbers of frames that are compared. The camera is back where it began after every 135 of them."""
LONG_SIDE = 320
"""Pixels of the long side where frames are counted; the long clip at 480p is enlarged from that."""
LONG_CLIP = 400, 854
"""Frames and pixels of that one."""
LONG_SIDES = (427, 640, 854, 1280, 1920)
"""Pixels of the long side that are compared."""
FEW_FRAMES = 16
"""Frames where pixels or Gaussians are counted."""
MAX_DRAWN_SIDE = 960
"""Pixels of the images that those are made of; larger ones are enlarged. Chosen by eye."""
BACKGROUND_SPACINGS = (3.0, 2.0, 1.5, 1.0, 0.75)
"""Pixels between Gaussians of the background at the start."""
STAGES = ("ingest", *PRIORS.names, "train", "evaluate", "render")


@dataclass(frozen=True)
class GrowthCase:
    """A run.

    Attributes:
        kind: what is counted: warm-up, frames, long, pixels, Gaussians or clip.
        clip: the input.
        out: its folder; runs that share one share their priors.
        frames: used, the first ones.
        side: pixels of the long side.
        spacing: of the background at the start; None = as in the preset.
    """

    kind: str
    clip: str
    out: str
    frames: int
    side: int
    spacing: float | None = None


def measure(case: GrowthCase) -> dict[str, Any]:
    """Return seconds of the processor and GiB of every stage of a run, and how large it was."""
    config = RunConfig()
    init = config.train.init if case.spacing is None else replace(config.train.init, background_spacing=case.spacing)
    config = replace(
        config, input=InputOptions(max_frames=case.frames, every=1, resize=case.side), render=RenderOptions(paths=("input",)),
        train=replace(config.train, iterations=TRAINING_STEPS, preview_every=0, init=init), final_fit=False, coarse_scene=False,
    )  # fmt: skip
    with by_the_processor():  # a run has a process of its own here
        metrics = run(Path(case.clip), Path(case.out), config)
    history = json.loads((Path(case.out) / "run.json").read_text())["stages"]
    scene = json.loads((Path(case.out) / "scene" / "scene.json").read_text())
    return {
        **asdict(case), "frames": len(scene["timestamps"]), "width": scene["width"], "height": scene["height"],
        "gaussians": metrics["gaussians"]["total"], "active": round(metrics["gaussians"]["active_mean"]),
        "seconds": metrics["seconds"], "memory": metrics["memory_gib"], "peak": max(h["peak_memory_gib"] for h in history.values()),
        **(camera_drift(Path(case.out)) if case.kind == "frames" else {}),
    }  # fmt: skip


def camera_drift(out: Path) -> dict[str, float]:
    """Return how far estimated cameras of the built-in clip are from the true ones, and whether that grows.

    Returns:
        ``path``, ``rotation`` as from ``path_errors``; ``drift`` and ``turn``: mean distance (as a share of the extent of the true
        path, the largest distance from its middle) and angle (degrees) between the last tenth of the cameras and the truth, once
        the first tenth is brought onto it.
    """
    scene = Scene(out / "scene")
    spec = SyntheticScene(width=scene.width, height=scene.height, frames=scene.num_frames)
    true, tenth = [spec.camera(i) for i in range(scene.num_frames)], scene.num_frames // 10
    whole = path_errors(scene.cameras, true)
    similarity = align_paths(scene.cameras[:tenth], true[:tenth])
    ends = [(similarity.camera(found), camera) for found, camera in zip(scene.cameras[-tenth:], true[-tenth:], strict=True)]
    centers = np.array([camera.center for camera in true])
    extent = np.linalg.norm(centers - centers.mean(0), axis=1).max()
    cosines = [(np.trace(a.viewmat[:3, :3] @ b.viewmat[:3, :3].T) - 1) / 2 for a, b in ends]
    return {
        "path": whole["path"], "rotation": whole["rotation"],
        "drift": float(np.mean([np.linalg.norm(a.center - b.center) for a, b in ends]) / extent),
        "turn": float(np.degrees(np.arccos(np.clip(cosines, -1, 1))).mean()),
    }  # fmt: skip


def enlarge(spec: SyntheticScene, side: int, path: Path) -> Path:
    """Return the built-in clip as a video, enlarged to a long side; rendered once."""
    if not path.exists():
        size = side, 2 * round(side * spec.height / spec.width / 2)
        images = (spec.render(spec.camera(i), spec.timestamps[i]).image for i in range(spec.frames))
        write_mp4(path, (cv2.resize(image, size, interpolation=cv2.INTER_CUBIC) for image in images), spec.fps, crf=12)
    return path


def cases(folder: Path, only: Sequence[str], clips: Sequence[Path]) -> Iterator[GrowthCase]:
    """Yield all runs, a short one first that compiles the kernels."""
    long = SyntheticScene(width=LONG_SIDE, height=LONG_SIDE * 9 // 16, frames=max(FRAMES))
    few = SyntheticScene(width=MAX_DRAWN_SIDE, height=MAX_DRAWN_SIDE * 9 // 16, frames=FEW_FRAMES)
    if {"pixels", "gaussians"} & set(only):
        large = str(enlarge(few, max(LONG_SIDES), folder / "few.mp4"))
        yield GrowthCase("warm-up", large, str(folder / "warm"), FEW_FRAMES, 160)
    if {"frames", "long"} & set(only):
        small = str(enlarge(long, LONG_SIDE, folder / "long.mp4"))
        yield GrowthCase("warm-up", small, str(folder / "warm_long"), 24, 160)
    if "frames" in only:
        yield from (GrowthCase("frames", small, str(folder / f"frames_{n}"), n, LONG_SIDE) for n in FRAMES)
    if "pixels" in only:
        yield from (GrowthCase("pixels", large, str(folder / f"pixels_{side}"), FEW_FRAMES, side) for side in LONG_SIDES)
    if "gaussians" in only:
        yield from (
            GrowthCase("gaussians", large, str(folder / "pixels_854"), FEW_FRAMES, 854, each) for each in BACKGROUND_SPACINGS
        )
    if "long" in only:
        yield GrowthCase("long", str(enlarge(long, LONG_CLIP[1], folder / "long_480p.mp4")), str(folder / "long"), *LONG_CLIP)
    yield from (GrowthCase("clip", str(clip), str(folder / f"clip_{clip.name}"), 1000, 854) for clip in clips)


def growth(rows: Sequence[dict[str, Any]], stage: str, by: str = "frames") -> float:
    """Return the power of the number of frames (or pixels) with which the seconds of a stage grew, over the larger half of the
    runs."""
    first, last = rows[len(rows) // 2 - 1], rows[-1]
    ratio = math.log(last[by] / first[by])
    return math.log(max(last["seconds"][stage], 1e-3) / max(first["seconds"][stage], 1e-3)) / ratio


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return every run a line: its size, seconds of its stages, GiB."""
    lines = ["| | frames | size | Gaussians (active) | " + " | ".join(STAGES) + " | GiB: priors | train | whole |"]
    lines.append("| --- " * (lines[0].count("|") - 1) + "|")
    for row in rows:
        seconds = row["seconds"]
        cells = [row["kind"] if row["kind"] != "clip" else Path(row["clip"]).name, str(row["frames"])]
        cells += [f"{row['width']}x{row['height']}", f"{row['gaussians']:,} ({row['active']:,})"]
        cells += [f"{seconds[stage]:.1f}" if stage in seconds else "" for stage in STAGES]
        cells += [f"{gib:.1f}" for gib in (row["memory"]["prepare"], row["memory"]["train"], row["peak"])]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def figure(rows: Sequence[dict[str, Any]]) -> str:
    """Return the content of an SVG: charts of time and memory against frames, pixels and Gaussians, one below the other."""
    kinds = {kind: [row for row in rows if row["kind"] == kind] for kind in ("frames", "pixels", "gaussians")}
    charts = []
    for kind, x, label in (
        ("frames", lambda row: row["frames"], f"frames of {LONG_SIDE} pixels"),
        ("pixels", lambda row: row["width"] * row["height"] / 1e6, f"megapixels of {FEW_FRAMES} frames"),
    ):
        some = kinds[kind]
        if some:
            places = [x(row) for row in some]
            series = {stage: (places, [row["seconds"][stage] for row in some]) for stage in PRIORS.names}
            charts.append(line_chart(series, title=f"Seconds of the priors by {kind}", x_label=label, y_label="seconds", dots=True))
            series = {
                f"{TRAINING_STEPS} steps, s": (places, [row["seconds"]["train"] for row in some]),
                "evaluation, s": (places, [row["seconds"]["evaluate"] for row in some]),
                "videos, s": (places, [row["seconds"]["render"] for row in some]),
                "GiB, priors": (places, [row["memory"]["prepare"] for row in some]),
                "GiB, training": (places, [row["memory"]["train"] for row in some]),
            }
            charts.append(line_chart(series, title=f"The rest by {kind}", x_label=label, y_label="", dots=True))
    if kinds["gaussians"]:
        some = sorted(kinds["gaussians"], key=lambda row: row["active"])
        places = [row["active"] / 1e3 for row in some]
        series = {
            f"{TRAINING_STEPS} steps, s": (places, [row["seconds"]["train"] for row in some]),
            "GiB, training": (places, [row["memory"]["train"] for row in some]),
        }
        label = "thousand Gaussians active at a time, 854x480"
        charts.append(line_chart(series, title="Training by Gaussians", x_label=label, y_label="", dots=True))
    return stack([svg_file(chart) for chart in charts])


def stack(charts: Sequence[str], height: int = 260, width: int = 640) -> str:
    """SVG files one below the other."""
    inner = "\n".join(
        chart.replace("<svg ", f'<svg y="{k * height}" width="{width}" height="{height}" ', 1) for k, chart in enumerate(charts)
    )
    total = height * len(charts)
    return f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {total}" role="img">\n{inner}</svg>\n'


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    kinds = ["frames", "pixels", "gaussians", "long"]
    parser.add_argument("--only", nargs="*", choices=kinds, default=kinds)
    parser.add_argument("--clip", nargs="*", type=Path, default=[])
    parser.add_argument("--folder", type=Path, help="keep clips and runs there")
    parser.add_argument("--svg", type=Path)
    parser.add_argument("--json", type=Path, help="figures are added to those that are there")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(measure(GrowthCase(**json.loads(options.one)))))
        return
    rows: list[dict[str, Any]] = json.loads(options.json.read_text()) if options.json and options.json.exists() else []
    with tempfile.TemporaryDirectory(prefix="flowsplat-") as temporary:
        folder = options.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for case in cases(folder, options.only, options.clip):
            tell(f"{case.kind}: {case.frames} frames, {case.side} pixels")
            command = [sys.executable, "-m", MODULE, "--one", json.dumps(asdict(case))]
            told = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
            row = json.loads(told.splitlines()[-1])
            if case.kind != "warm-up":
                rows.append(row)
                if options.json:
                    options.json.write_text(json.dumps(rows, indent=1))
    print(table(rows))
    by_frames = [row for row in rows if row["kind"] == "frames"]
    if len(by_frames) > 1:
        powers = {stage: significant(round(growth(by_frames, stage), 2)) for stage in STAGES if stage not in ("train", "ingest")}
        for row in by_frames:
            print(
                f"{row['frames']} frames: cameras are {row['path']:.2%} of the path and {row['rotation']:.2f} degrees off, "
                f"the last tenth by {row['drift']:.1%} of its extent and {row['turn']:.2f} degrees where the first is right"
            )
        print("\nPower of the number of frames: " + ", ".join(f"{stage} {power:g}" for stage, power in powers.items()))
    if options.svg:
        options.svg.write_text(figure(rows))


if __name__ == "__main__":
    main()
