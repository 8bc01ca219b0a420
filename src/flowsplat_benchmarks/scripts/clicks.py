"""Clicks and boxes on objects of random worlds, drawn from their true masks: IoU at once, and over the clip.

    python -m flowsplat_benchmarks.scripts.clicks OUT --seed 200 --worlds 10           # boxes
    python -m flowsplat_benchmarks.scripts.clicks OUT --seed 200 --worlds 10 --clicks  # a click each instead

Worlds are 40 frames of 320 x 180 with true cameras and flow of our own. Each object that covers 150 pixels in some frame gets one
prompt on a random frame in which it has half of its largest area: a box with margins of 2 pixels and 2 to 15 % of its sides, or a
click at the point deepest inside. The same command again does not render again.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

from flowsplat.common.files import write_text
from flowsplat.priors.flow import dis_estimator, flow_stage
from flowsplat.priors.prompts import Prompt, cut_prompts, prompt_stage
from flowsplat.scenes import Scene
from flowsplat_benchmarks.worlds import draw_world, write_world

WIDTH, HEIGHT, FRAMES, MIN_PIXELS = 320, 180, 40, 150
"""Pixels and frames of a world, and pixels of an object in a frame below which it is not clicked."""


def prepare(folder: Path, seed: int) -> Scene:
    """Return a world with true cameras, and flow."""
    is_new = not (folder / "truth" / "objects.json").exists()
    scene = write_world(folder, draw_world(seed, WIDTH, HEIGHT, FRAMES)) if is_new else Scene(folder)
    truth = scene.truth
    assert truth is not None
    if scene.prior("cameras") is None:
        scene.write_cameras(truth.cameras)
        scene.finish_prior("cameras", method="truth", verdict="true cameras")
    if scene.prior("flow") is None:
        flow_stage(scene)
    return scene


def draw_prompts(masks: np.ndarray, seed: int, clicks: bool) -> dict[int, Prompt]:
    """Return a prompt for every object of true masks [T, H, W] that is large enough, by its number in them."""
    rng = np.random.default_rng(seed)
    prompts: dict[int, Prompt] = {}
    _, height, width = masks.shape
    for number in range(1, int(masks.max()) + 1):
        area = (masks == number).sum((1, 2))
        if area.max() < MIN_PIXELS:
            continue
        k = int(rng.choice(np.flatnonzero(area >= 0.5 * area.max())))
        mask = (masks[k] == number).astype(np.uint8)
        x, y, w, h = cv2.boundingRect(mask)
        left, top, right, bottom = 2 + rng.uniform(0.02, 0.15, 4) * [w, h, w, h]
        box = max(x - left, 0.0), max(y - top, 0.0), min(x + w + right, width), min(y + h + bottom, height)
        row, column = np.unravel_index(cv2.distanceTransform(np.pad(mask, 1), cv2.DIST_L2, 5)[1:-1, 1:-1].argmax(), mask.shape)
        click = (float(column) + 0.5, float(row) + 0.5)
        place = Prompt(k, (click,)) if clicks else Prompt(k, (), box)
        prompts[number] = Prompt(place.frame, place.clicks, place.box, number=len(prompts) + 1)
    return prompts


def overlap(found: np.ndarray, true: np.ndarray) -> float:
    """IoU of masks."""
    return float((found & true).sum() / max((found | true).sum(), 1))


def measure(scene: Scene, seed: int, clicks: bool) -> list[tuple[float, float]]:
    """IoU of every object on the frame of its prompt at once, and over the clip."""
    truth = scene.truth
    assert truth is not None
    true = np.stack([truth.mask(i) for i in scene.train_frames])
    prompts = draw_prompts(true, seed, clicks)
    if not prompts:
        return []
    first = cut_prompts(scene, list(prompts.values()), dis_estimator)
    prompt_stage(scene, list(prompts.values()))
    masks = np.stack([scene.mask(i) for i in scene.train_frames])
    figures = []
    for (number, prompt), mask in zip(prompts.items(), first, strict=True):
        here = true[prompt.frame] == number
        held = np.bincount(masks[prompt.frame][here], minlength=2)
        own = int(held[1:].argmax()) + 1
        over = overlap(masks == own, true == number) if held[own] else 0.0
        figures.append((overlap(mask, here), over))
    return figures


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, default=200)
    parser.add_argument("--worlds", type=int, default=10)
    parser.add_argument("--clicks", action="store_true")
    chosen = parser.parse_args()
    found: list[tuple[float, float]] = []
    for seed in range(chosen.seed, chosen.seed + chosen.worlds):
        found += measure(prepare(chosen.out / f"world-{seed}", seed), seed, chosen.clicks)
    once, clip = np.array(found).T
    kind = "clicks" if chosen.clicks else "boxes"
    row = f"| {kind} | {len(found)} | {once.mean():.3f} | {clip.mean():.3f} | {(clip < 0.5).sum()} |"
    head = "| | objects | at once | over the clip | under .5 over the clip |\n| --- | --- | --- | --- | --- |\n"
    write_text(chosen.out / f"{kind}.md", head + row + "\n")


if __name__ == "__main__":
    main()
