"""The background alone of random worlds under a strong sun, against images of the same worlds without their objects.

    python -m flowsplat_benchmarks.scripts.shadows OUT --seed 200 --worlds 10         # a strong sun
    python -m flowsplat_benchmarks.scripts.shadows OUT --seed 200 --worlds 10 --sky   # no sun, no shadows

Worlds are 40 frames of 320 x 180 with true priors and 500 frame-steps. Every third frame counts: all pixels; those of shadows,
which are darker by 4 % without being an object; those behind objects; all else. ``OUT/shadows.md`` is the table. The same command
again does not train again.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from flowsplat.common.files import write_text
from flowsplat.evaluation.baselines import to_float
from flowsplat.gaussians.model import SceneModel
from flowsplat.gaussians.observations import load_observations
from flowsplat.gaussians.shadows import add_shadow_free
from flowsplat.priors.options import PriorsOptions
from flowsplat.priors.prepare import prepare_priors
from flowsplat.scenes import Scene
from flowsplat.scenes.synthetic.worlds.world import World
from flowsplat.training.checkpoint import has_model, load_model, save_model
from flowsplat.training.config import PRESETS
from flowsplat.training.scene_model import scene_model
from flowsplat.training.trainer import Trainer
from flowsplat_benchmarks.worlds import draw_world, write_world

WIDTH, HEIGHT, FRAMES, TRAINING_STEPS, HOLDOUT = 320, 180, 40, 500, 3
"""Pixels and frames of a world, training steps, and every how many frames one is held out."""
SUN_LIGHT, SKY_LIGHT, SUN_RISE = 0.6, 0.5, 0.88
"""Light of the sun and of the sky, and how much higher than wide the direction to the sun is. Chosen by eye."""
MIN_DARKENING, MIN_PIXELS = 0.04, 500
"""Of a shadow, 0 to 1; and pixels of a kind that make a figure. Chosen by eye."""
KINDS = ("all", "shadow", "hidden", "all else")


def draw_lit_world(seed: int, sky: bool) -> World:
    """Return a world under a sun that is always there, or under the sky alone."""
    world = draw_world(seed, WIDTH, HEIGHT, FRAMES)
    if sky:
        return replace(world, light=replace(world.light, sun=0.0, ambient=world.light.ambient + world.light.sun))
    across = world.light.direction[:2] / np.linalg.norm(world.light.direction[:2])
    direction = np.array([*across, SUN_RISE]) / np.hypot(1, SUN_RISE)
    return replace(world, light=replace(world.light, direction=direction, sun=SUN_LIGHT, ambient=SKY_LIGHT))


def train_world(folder: Path, world: World) -> tuple[Scene, SceneModel]:
    """Return the scene of a world, and it trained, without what is known of shadows."""
    is_new = not (folder / "scene" / "truth" / "objects.json").exists()
    scene = write_world(folder / "scene", world) if is_new else Scene(folder / "scene")
    prepare_priors(scene, PriorsOptions(priors="true"), "cpu")
    if not has_model(folder / "model"):
        config = PRESETS["default"]
        density = replace(config.density, every=100, start=100)
        init = replace(config.init, background_spacing=2.0, foreground_spacing=2.0)
        config = replace(config, iterations=TRAINING_STEPS, preview_every=0, density=density, init=init)
        trainer = Trainer(load_observations(scene), scene.tracks, config)
        save_model(folder / "model", scene_model(scene, trainer.run(), config))
    return scene, load_model(folder / "model")


def measure(scene: Scene, model: SceneModel, world: World) -> dict[str, tuple[float, float]]:
    """PSNR by kind of pixel as trained and without shadows; of the kinds that there are."""
    frames = scene.train_frames
    times = [float(scene.timestamps[i]) for i in frames]
    shadow_free = add_shadow_free(model, [scene.cameras[i] for i in frames], times, [scene.mask(i) for i in frames])
    empty = replace(world, objects=(), touching=None, noise=0.0)
    sums = {kind: np.zeros(3) for kind in KINDS}
    for i in frames[::HOLDOUT]:
        target, seen = to_float(empty.image(i)), to_float(scene.frame(i))
        hidden = cv2.dilate(scene.mask(i), np.ones((5, 5), np.uint8)) > 0
        shadow = (cv2.blur((target - seen).mean(-1), (3, 3)) > MIN_DARKENING) & ~hidden
        kinds = dict(zip(KINDS, (np.ones_like(hidden), shadow, hidden, ~hidden & ~shadow), strict=True))
        images = [
            each.part("background").render(scene.cameras[i], float(scene.timestamps[i])).color for each in (model, shadow_free)
        ]
        for kind, where in kinds.items():
            sums[kind] += [*(((image - target) ** 2).mean(-1)[where].sum() for image in images), where.sum()]
    found = {}
    for kind, (before, now, count) in sums.items():
        if count > MIN_PIXELS:
            found[kind] = (-10 * float(np.log10(before / count)), -10 * float(np.log10(now / count)))
    return found


def table(results: list[dict[str, tuple[float, float]]]) -> str:
    """Markdown: means over the worlds that have a kind of pixel, as trained and now."""
    cells = []
    for kind in KINDS:
        figures = [each[kind] for each in results if kind in each]
        cells.append("{:.2f}, {:.2f}".format(*np.mean(figures, 0)) if figures else "")
    return f"| {' | '.join(KINDS)} |\n{'| --- ' * len(KINDS)}|\n| {' | '.join(cells)} |\n"


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, default=200)
    parser.add_argument("--worlds", type=int, default=10)
    parser.add_argument("--sky", action="store_true")
    chosen = parser.parse_args()
    results = []
    for seed in range(chosen.seed, chosen.seed + chosen.worlds):
        world = draw_lit_world(seed, chosen.sky)
        results.append(measure(*train_world(chosen.out / f"{'sky' if chosen.sky else 'sun'}-{seed}", world), world))
    write_text(chosen.out / "shadows.md", table(results))


if __name__ == "__main__":
    main()
