"""Measure where the time of training goes, on a prepared scene (``flowsplat prepare``).

``python -m flowsplat_benchmarks.scripts.training OUT/scene`` trains as ``flowsplat train`` would and says, as Markdown: what steps
cost and gain at different times of the training, which parts of one cost what, and what Gaussians at rest and those that move cost
alone. Held-out images only tell what was gained. ``--set rates.means=2e-4`` changes a setting of training by its dotted name,
``--json FILE`` keeps the figures.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from flowsplat.evaluation.evaluate import find_heldout_mask
from flowsplat.evaluation.placement import view_camera
from flowsplat.evaluation.scores import score_image
from flowsplat.gaussians.gaussians4d import Active, Gaussians4D
from flowsplat.gaussians.observations import load_observations
from flowsplat.scenes import Scene
from flowsplat.training.config import PRESETS, TrainConfig
from flowsplat.training.history import Figures
from flowsplat.training.scene_model import scene_model
from flowsplat.training.state import TrainState
from flowsplat.training.step import StepOutput
from flowsplat.training.trainer import Trainer
from flowsplat_benchmarks.scripts.cpu_parts.clock import profile
from flowsplat_benchmarks.scripts.cpu_parts.step import DIRECTORS
from flowsplat_benchmarks.scripts.cpu_parts.timing import significant, tell

PROFILED_STEPS = 12
"""Steps whose parts are measured each time."""
HELD_OUT_IMAGES = 12
"""Held-out images that say what was gained."""


def with_setting(config: Any, name: str, value: str) -> Any:
    """Return the settings with one of them changed, by its dotted name."""
    first, _, rest = name.partition(".")
    if first not in {each.name for each in fields(config)}:
        raise SystemExit(f"there is no setting {name}")
    before = getattr(config, first)
    if is_dataclass(before):
        return replace(config, **{first: with_setting(before, rest, value)})
    return replace(config, **{first: value if isinstance(before, str) else type(before)(json.loads(value))})


class HeldoutImages:
    """Held-out images of a scene, to look at while it is trained."""

    def __init__(self, scene: Scene, most: int):
        self._scene, self._tests = scene, []  # type: Scene, list[tuple[Any, float, np.ndarray, np.ndarray | None]]
        if scene.views:
            for view in scene.views[:: -(-len(scene.views) // most)]:
                target, mask = scene.view_image(view), scene.view_mask(view)
                self._tests.append((view_camera(scene, view), float(scene.timestamps[view.frame]), target, mask))
        else:
            for i in scene.heldout_frames[:: -(-len(scene.heldout_frames) // most)]:
                frame, mask = scene.heldout_frame(i), find_heldout_mask(scene, i)
                self._tests.append((scene.cameras[i], float(scene.timestamps[i]), frame, mask))

    def psnr(self, gaussians: Gaussians4D, config: TrainConfig) -> dict[str, float]:
        """dB of all of the image, and inside the masks of what moves; means over the images."""
        model = scene_model(self._scene, gaussians, config)
        found: dict[str, list[float]] = {"all": [], "moving": []}
        for camera, seconds, target, mask in self._tests:
            scores = score_image(
                model.render(camera, seconds).color, target / np.float32(255), {"moving": mask}, None, self._scene.overlay
            )
            found["all"].append(scores["psnr"])
            if scores["moving"] is not None:
                found["moving"].append(scores["moving"]["psnr"])
        return {name: statistics.mean(values) for name, values in found.items() if values}


class StageClock:
    """Lets a trainer run in pieces, and measures the steps between them: processor seconds, which other programs disturb least."""

    def __init__(self, trainer: Trainer, every: int, images: HeldoutImages, profiled: int):
        self._trainer, self._every, self._images, self._profiled = trainer, every, images, profiled
        self._seconds, self._since = 0.0, 0.0
        self.entries: list[dict[str, Any]] = []
        self.parts: list[dict[str, float]] = []

    def attach(self) -> None:
        """Watch the trainer from now on."""
        self._trainer.callbacks.append(self._look)
        self._since = time.process_time()

    @property
    def seconds(self) -> float:
        """Spent on steps so far."""
        return self._seconds

    def _look(self, state: TrainState, _step: StepOutput, _figures: Figures) -> None:
        trainer = self._trainer
        last = state.step == trainer.config.iterations
        if state.step % self._every and not last:
            return
        self._seconds += time.process_time() - self._since
        g = state.gaussians
        averaged = {name: value.clone() for name, value in g.values.items()}
        state.average.write(averaged)
        params, shared = ({name: averaged[name] for name in names} for names in (g.params, g.shared))
        shown = Gaussians4D(params, g.dynamic, g.config, g.sh_degree, g.object_ids, shared=shared)
        found = {"step": state.step, "seconds": self._seconds, **self._images.psnr(shown, trainer.config)}
        self.entries.append(found)
        tell("  ".join(f"{name} {value:.2f}" for name, value in found.items()))
        self._since = time.process_time()


def classes(trainer: Trainer, repeat: int) -> dict[str, dict[str, float]]:
    """Milliseconds of rendering and differentiating a frame with all active Gaussians, and with those of one class alone."""
    found: dict[str, list[float]] = {"all": [], "at rest": [], "moving": []}
    counts: dict[str, list[int]] = {"all": [], "at rest": [], "moving": []}
    for r in range(repeat):
        k = (r * 7) % (len(trainer.observations) - 1)
        frame = trainer.observations[k]
        active = trainer.gaussians.active(frame.time, frame.camera)
        kinds = {
            "all": active,
            "at rest": Active(active.rows[: active.num_static].contiguous(), active.num_static, active.t),
            "moving": Active(active.rows[active.num_static :].contiguous(), 0, active.t),
        }
        for name, chosen in kinds.items():
            began = time.process_time()
            trainer.backpropagate(k, chosen)
            found[name].append(time.process_time() - began)
            counts[name].append(len(chosen.rows))
    return {
        name: {"ms": significant(1e3 * statistics.median(values)), "gaussians": statistics.mean(counts[name])}
        for name, values in found.items()
    }


def parts_of_steps(trainer: Trainer, repeat: int) -> dict[str, float]:
    """Milliseconds of the parts of a step, medians; the trainer goes on by ``repeat`` steps."""
    seconds: dict[str, list[float]] = {}
    for _ in range(repeat):
        for name, value in profile(trainer.iterate, DIRECTORS).items():
            seconds.setdefault(name, []).append(value)
    return {name: significant(1e3 * statistics.median(values)) for name, values in seconds.items()}


def main() -> None:
    """Train, and say where the time went."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("--every", type=int, default=100, help="steps between two looks at held-out images")
    parser.add_argument("--images", type=int, default=HELD_OUT_IMAGES, help="held-out images that are looked at")
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="settings of training by their dotted names")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    config = replace(PRESETS["default"], preview_every=0)
    for each in options.set:
        config = with_setting(config, *each.split("=", 1))
    scene = Scene(options.scene)
    observations, tracks = load_observations(scene), scene.tracks if scene.has_tracks else None
    trainer = Trainer(observations, tracks, config)
    began = time.process_time()
    start = trainer.initialize()
    placing = time.process_time() - began
    trainer = Trainer(observations, tracks, config, start=start)
    clock = StageClock(trainer, options.every, HeldoutImages(scene, options.images), PROFILED_STEPS)
    clock.attach()
    trainer.run()
    # What a step costs is that of a trained scene: from here on nothing counts for the result.
    parts, by_class = parts_of_steps(trainer, PROFILED_STEPS), classes(trainer, PROFILED_STEPS)
    figures = {
        "scene": str(options.scene), "size": [scene.width, scene.height], "settings": options.set,
        "gaussians": len(trainer.gaussians), "moving": int(trainer.gaussians.dynamic.sum()),
        "placing_seconds": significant(placing), "training_seconds": significant(clock.seconds),
        "gains": clock.entries, "parts_ms": dict(sorted(parts.items(), key=lambda item: -item[1])), "classes": by_class,
    }  # fmt: skip
    if options.json:
        options.json.write_text(json.dumps(figures, indent=1))
    sys.stdout.write(report(figures))


def report(figures: dict[str, Any]) -> str:
    """Return the figures as Markdown."""
    lines = [
        f"{figures['gaussians']:,} Gaussians, {figures['moving']:,} of them moving; {figures['size'][0]}x{figures['size'][1]}; "
        f"placing them {figures['placing_seconds']:.3g} s, training {figures['training_seconds']:.4g} s of processor time.",
        "", "| step | seconds | dB | moving | dB a second | moving |", "| --- | --- | --- | --- | --- | --- |",
    ]  # fmt: skip
    before: dict[str, Any] | None = None
    for entry in figures["gains"]:
        gains = ["", ""]
        if before is not None:
            took = max(entry["seconds"] - before["seconds"], 1e-9)
            gains = [f"{(entry[name] - before[name]) / took:+.3f}" if name in entry else "" for name in ("all", "moving")]
        moving = f"{entry['moving']:.2f}" if "moving" in entry else ""
        lines.append(f"| {entry['step']} | {entry['seconds']:.1f} | {entry['all']:.2f} | {moving} | {' | '.join(gains)} |")
        before = entry
    total = sum(figures["parts_ms"].values())
    lines += ["", f"| part of a step ({total:.0f} ms) | ms | % |", "| --- | --- | --- |"]
    lines += [f"| {name} | {ms:.1f} | {100 * ms / total:.0f} |" for name, ms in figures["parts_ms"].items() if ms > 0.004 * total]
    lines += ["", "| rendered and differentiated alone | Gaussians | ms |", "| --- | --- | --- |"]
    lines += [f"| {name} | {value['gaussians']:,.0f} | {value['ms']:.1f} |" for name, value in figures["classes"].items()]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
