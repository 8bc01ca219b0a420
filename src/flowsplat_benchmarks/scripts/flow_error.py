"""Flow by RAFT with weights of a file beside Dense Inverse Search: how far it is from the truth, and how long a pair takes.

    python -m flowsplat_benchmarks.scripts.flow_error OUT DATA_ROOT --raft raft-small.pth --seed 0 --worlds 10

Pairs of images with measured flow under ``DATA_ROOT/flow`` one way, and random worlds, 40 frames of 320 x 180, every fourth pair of
neighbors both ways, with the figures of ``flowsplat benchmark priors``, pooled over the worlds. RAFT enlarges images whose shorter
side has fewer than ``--sides`` pixels. Times are of one thread, the fastest of five, in seconds of the processor, at the size of a
world and, with the first pair enlarged, at 854 x 480. ``OUT/flow_error.md`` is the table. The same command again renders no world
again.
"""

from __future__ import annotations

import argparse
import time
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import torch

from flowsplat.common.files import write_text
from flowsplat.common.progress import track
from flowsplat.common.threads import set_thread_count
from flowsplat.priors.flow import FlowEstimator, dis_estimator, forward_backward_confidence
from flowsplat.priors.learned.raft import MIN_SIDE, raft_estimator
from flowsplat.scenes import Flow, Scene
from flowsplat.scenes.ingest import ingest, open_clip
from flowsplat_benchmarks.priors.measure import Figures, flow_figures, read_true_flow
from flowsplat_benchmarks.priors.preparation import scene_config
from flowsplat_benchmarks.priors.scenes import BenchmarkScene, find_scenes
from flowsplat_benchmarks.tables import format_table
from flowsplat_benchmarks.worlds import draw_world, write_world
from flowsplat_benchmarks.worlds.writing import OBJECTS

WIDTH, HEIGHT, FRAMES = 320, 180, 40
"""Pixels and frames of a world."""
TIMED_SIZES = ((320, 180), (854, 480))
"""Pixels at which a pair is timed: of a world, and of a clip of DAVIS."""
PAIR_STRIDE = 4
"""Neighboring frames of a world of which flow is found: every so many."""
REPEATS = 5
"""Of a timed pair, of which the fastest counts."""
COLUMNS = ("flow.epe", "flow.epe_objects", "flow.epe_matched", "flow.epe_matched_objects", "flow.kept", "flow.right")
"""Figures of the table, by their keys in ``flow_figures``."""


def find_flow(scene: Scene, estimate: FlowEstimator, stride: int = 1) -> dict[tuple[int, int], Flow]:
    """Return flow both ways between neighboring training frames, every so many, with its confidence, as the flow stage does."""
    found = {}
    for i, j in list(pairwise(scene.train_frames))[::stride]:
        a, b = scene.frame(i), scene.frame(j)
        there, back = estimate(a, b), estimate(b, a)
        found[i, j] = Flow(i, j, there, forward_backward_confidence(there, back))
        found[j, i] = Flow(j, i, back, forward_backward_confidence(back, there))
    return found


def measure_world(scene: Scene, estimate: FlowEstimator) -> list[tuple[Flow, Flow, np.ndarray]]:
    """Return (found, true, mask of objects) of every pair."""
    truth = scene.truth
    assert truth is not None
    return [(flow, truth.flow(*pair), truth.mask(pair[0]) > 0) for pair, flow in find_flow(scene, estimate, PAIR_STRIDE).items()]


def measure_pair(benchmark: BenchmarkScene, scene: Scene, estimate: FlowEstimator) -> Figures:
    """Return the figures of two images with measured flow."""
    return flow_figures([(find_flow(scene, estimate)[0, 1], read_true_flow(benchmark, scene), None)])


def time_pair(pair: tuple[np.ndarray, np.ndarray], estimate: FlowEstimator) -> float:
    """Return the seconds of the processor for one pair, one way."""
    seconds = []
    for _ in range(REPEATS):
        start = time.process_time()
        estimate(*pair)
        seconds.append(time.process_time() - start)
    return min(seconds)


def row(name: str, method: str, figures: Figures) -> list[str]:
    """Return a row of the table of errors."""
    return [name, method, *(f"{figures[key]:.3f}" if key in figures else "" for key in COLUMNS)]


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--raft", required=True, help="small, large or a file of weights")
    parser.add_argument("--sides", type=int, nargs="+", default=[128, MIN_SIDE])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--worlds", type=int, default=10)
    chosen = parser.parse_args()
    set_thread_count(1)
    networks = {f"raft {side}": raft_estimator(chosen.raft, torch.device("cpu"), side) for side in chosen.sides}
    estimators: dict[str, FlowEstimator] = {"dis": dis_estimator, **networks}
    rows = []
    pairs = {each.name: each for each in find_scenes(chosen.data) if each.kind == "pair"}
    scenes = {name: ingest_pair(each, chosen.out / name) for name, each in pairs.items()}
    for name, benchmark in pairs.items():
        rows += [row(name, method, measure_pair(benchmark, scenes[name], find)) for method, find in estimators.items()]
    seeds = range(chosen.seed, chosen.seed + chosen.worlds)
    worlds = [open_world(chosen.out / f"world-{seed}", seed) for seed in seeds]
    for method, find in estimators.items():
        found = [pair for scene in track(worlds, method) for pair in measure_world(scene, find)]
        rows += [row(f"{len(worlds)} worlds", method, flow_figures(found))] if found else []
    images = [scene.frame(i) for scene in [*scenes.values(), *worlds][:1] for i in (0, 1)]
    times = []
    for size in TIMED_SIZES:
        a, b = (cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in images)
        times += [[f"{size[0]} x {size[1]}", *(f"{time_pair((a, b), find):.3f}" for find in estimators.values())]]
    lines = format_table(("", "", *COLUMNS), rows) + [""] + format_table(("seconds a pair", *estimators), times)
    write_text(chosen.out / "flow_error.md", "\n".join(lines) + "\n")


def ingest_pair(benchmark: BenchmarkScene, folder: Path) -> Scene:
    """Return the two images of a pair as a scene."""
    options = scene_config(benchmark).input
    return ingest(open_clip(benchmark.source, options), folder, options)


def open_world(folder: Path, seed: int) -> Scene:
    """Return a random world with its truth, rendered where it is not there."""
    if (folder / "truth" / OBJECTS).exists():
        return Scene(folder)
    return write_world(folder, draw_world(seed, WIDTH, HEIGHT, FRAMES))


if __name__ == "__main__":
    main()
