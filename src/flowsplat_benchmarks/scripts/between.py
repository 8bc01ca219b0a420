"""Measure what moves between two training frames: held-out frames of random worlds inside the masks, by speed, thickness and blur.

    python -m flowsplat_benchmarks.scripts.between OUT --dancers --seed 0 --worlds 8        # people who dance, in worlds apart
    python -m flowsplat_benchmarks.scripts.between OUT --seed 0 --worlds 8                  # what moves in any world

Every fifth frame of 40 (320 x 180) is held out. Cameras and masks are true, so that only what is between frames counts; flow,
tracks and depth are our own. Each figure is 10 log10 of 1 over the squared error over all held-out pixels of a kind: by their true
speed in pixels a frame, by how thick the part is that they show, and by how far a pixel moves while the shutter is open.
``OUT/between.md`` is the table; the same command again goes on where it was stopped.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from flowsplat.common.files import read_json, write_json, write_text
from flowsplat.evaluation.baselines import HeldoutImage, to_float
from flowsplat.evaluation.baselines.flow_interpolation import interpolate_by_flow
from flowsplat.gaussians.observations import load_observations
from flowsplat.geometry.cameras import pixel_grid
from flowsplat.images.colors import float_to_bytes
from flowsplat.priors.options import PriorsOptions
from flowsplat.priors.prepare import prepare_priors
from flowsplat.scenes import Scene
from flowsplat.scenes.layers import write_image
from flowsplat.scenes.synthetic.worlds.casting import CAPSULE
from flowsplat.scenes.synthetic.worlds.world import World
from flowsplat.training.config import PRESETS, TrainConfig
from flowsplat.training.scene_model import scene_model
from flowsplat.training.trainer import Trainer
from flowsplat_benchmarks.worlds import draw_world, write_world

WIDTH, HEIGHT, FRAMES, HOLDOUT, TRAINING_STEPS = 320, 180, 40, 5, 300
"""Pixels and frames of a world, every how many frames one is held out, and training steps."""
SPEEDS, THICKNESSES, BLURS = (1.0, 3.0, 6.0), (4.0, 8.0, 16.0), (0.5, 1.5)
"""Pixels a frame, pixels, and pixels, between which kinds of pixels differ."""


@dataclass(frozen=True)
class Kinds:
    """Of every object's pixel of a frame [N]: its speed in pixels a frame, the thickness of its part and its blur in pixels."""

    inside: np.ndarray
    speed: np.ndarray
    thickness: np.ndarray
    blur: np.ndarray


def kinds_of(world: World, i: int) -> Kinds:
    """Return what the pixels of frame ``i`` show of objects; ``inside`` is their mask [H, W]."""
    inside = world.geometry(i)[1] > 0
    grid = pixel_grid(world.width, world.height).astype(np.float64).reshape(-1, 2)
    hits = world.cast(world.camera(i), float(world.timestamps[i]), grid)
    speed = np.linalg.norm(world.flow(i, i + 1).flow, axis=-1)[inside]
    # Of a tube twice its radius, of all else twice the second largest half extent.
    halves = np.array([part.size[0] if part.shape == CAPSULE else np.sort(part.size)[1] for part in world.parts])
    across = 2 * halves[hits.part] * world.camera(i).K[0, 0] / hits.depth
    return Kinds(inside, speed, across.reshape(inside.shape)[inside], speed * world.shutter)


def prepare(folder: Path, seed: int, dancers: bool) -> Scene:
    """Return the scene of a world with true cameras and masks, and all else our own."""
    if (folder / "done.json").exists():
        return Scene(folder)
    scene = write_world(folder, draw_world(seed, WIDTH, HEIGHT, FRAMES, dancers=dancers), HOLDOUT)
    truth = scene.truth
    assert truth is not None
    scene.write_cameras(truth.cameras)
    scene.finish_prior("cameras", method="truth", verdict="true cameras")
    for i in scene.train_frames:
        scene.write_mask(i, truth.mask(i))
    scene.finish_prior("masks", method="truth", verdict="true masks")
    prepare_priors(scene, PriorsOptions(), "cpu")
    write_json(folder / "done.json", {})
    return scene


def settings(steps: int) -> TrainConfig:
    """Preset ``default`` with fewer steps, and with fewer Gaussians where nothing moves, which is not measured."""
    config = PRESETS["default"]
    density, init = replace(config.density, every=100, start=100), replace(config.init, background_spacing=2.5)
    return replace(config, iterations=steps, preview_every=0, density=density, init=init)


def errors(image: np.ndarray, target: np.ndarray, kinds: Kinds) -> dict[str, tuple[float, int]]:
    """Sums of the squared error over the pixels of every kind, and their numbers."""
    squared = ((image - target) ** 2).mean(-1)[kinds.inside]
    chosen: dict[str, np.ndarray] = {"all": np.ones(len(squared), bool)}
    for name, values, edges in (
        ("speed", kinds.speed, SPEEDS), ("thickness", kinds.thickness, THICKNESSES), ("blur", kinds.blur, BLURS),
    ):  # fmt: skip
        for low, high in pairwise((0.0, *edges, np.inf)):
            chosen[f"{name} {low:g} to {high:g}"] = (values >= low) & (values < high)
    return {name: (float(squared[these].sum()), int(these.sum())) for name, these in chosen.items()}


def measure(scene: Scene, world: World, config: TrainConfig, images: Path | None = None) -> dict[str, Any]:
    """Train a scene; errors of its held-out frames, of ``flow_interpolation`` there, and of the training frames before them."""
    trainer = Trainer(load_observations(scene), scene.tracks, config)
    model = scene_model(scene, trainer.run(), config)
    found: dict[str, list[dict[str, tuple[float, int]]]] = {"held out": [], "flow interpolation": [], "trained": []}
    for i in scene.heldout_frames:
        target, kinds = to_float(scene.heldout_frame(i)), kinds_of(world, i)
        image = model.render(scene.cameras[i], float(scene.timestamps[i])).color
        found["held out"].append(errors(image, target, kinds))
        found["flow interpolation"].append(errors(interpolate_by_flow(HeldoutImage(scene, i)), target, kinds))
        if images is not None:
            write_image(images / f"{scene.name}_{i:05d}.png", float_to_bytes(np.concatenate([target, image], 1)))
        k = i - 1
        image = model.render(scene.cameras[k], float(scene.timestamps[k])).color
        found["trained"].append(errors(image, to_float(scene.frame(k)), kinds_of(world, k)))
    return {what: _add(frames) for what, frames in found.items()}


def _add(frames: list[dict[str, tuple[float, int]]]) -> dict[str, tuple[float, int]]:
    return {name: (sum(f[name][0] for f in frames), sum(f[name][1] for f in frames)) for name in frames[0]}


def table(results: list[dict[str, Any]]) -> str:
    """Markdown: PSNR of every kind of pixel, and the mean over worlds of the PSNR of all."""
    whats = list(results[0])
    lines = ["| pixels | share | " + " | ".join(whats) + " |", "| --- " * (len(whats) + 2) + "|"]
    count = sum(r[whats[0]]["all"][1] for r in results)
    for kind in results[0][whats[0]]:
        sums = {what: np.sum([r[what][kind] for r in results], 0) for what in whats}
        figures = [f"{-10 * np.log10(max(s, 1e-9) / n):.2f}" if n else "-" for s, n in sums.values()]
        lines.append(f"| {kind} | {sums[whats[0]][1] / count:.2f} | " + " | ".join(figures) + " |")
    means = [np.mean([-10 * np.log10(r[what]["all"][0] / r[what]["all"][1]) for r in results]) for what in whats]
    return "\n".join([*lines, "| mean over worlds | | " + " | ".join(f"{mean:.2f}" for mean in means) + " |", ""])


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--worlds", type=int, default=8)
    parser.add_argument("--dancers", action="store_true")
    parser.add_argument("--steps", type=int, default=TRAINING_STEPS)
    chosen = parser.parse_args()
    results = []
    for seed in range(chosen.seed, chosen.seed + chosen.worlds):
        folder = chosen.out / f"{'dancers' if chosen.dancers else 'any'}-{seed}"
        figures = folder / f"figures-{chosen.steps}.json"
        if not figures.exists():
            scene = prepare(folder / "scene", seed, chosen.dancers)
            world = draw_world(seed, WIDTH, HEIGHT, FRAMES, dancers=chosen.dancers)
            write_json(figures, measure(scene, world, settings(chosen.steps), folder))
        results.append(read_json(figures))
    write_text(chosen.out / "between.md", table(results))


if __name__ == "__main__":
    main()
