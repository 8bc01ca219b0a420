"""Does the method still work at the edges? Unusual clips of the built-in world, each an ordinary run, and what came out.

    python -m flowsplat_benchmarks.scripts.edges OUT --preset fast                  # all of them, about an hour on two cores
    python -m flowsplat_benchmarks.scripts.edges OUT --only portrait "static camera"

Every tenth frame is held out and compared with what flow interpolation makes of its neighbors; of the wide images, a sixth of
a second apart, every fourth. ``OUT/<edge>_<preset>/run/`` is the run, ``OUT/<edge>_<preset>.json`` its figures, ``OUT/edges.md``
the table of all presets; the same command again goes on where it was stopped.
"""

from __future__ import annotations

import argparse
import re
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, get_args

import numpy as np

from flowsplat import pipeline
from flowsplat.cli.commands import Preset
from flowsplat.common.errors import InputError
from flowsplat.common.files import make_folder, read_json, write_json, write_text
from flowsplat.common.processes import in_own_process
from flowsplat.common.source import source_state
from flowsplat.geometry import Camera
from flowsplat.images.video import write_mp4
from flowsplat.pipeline import RunConfig
from flowsplat.pipeline.folder import stage_key
from flowsplat.scenes import Scene
from flowsplat.scenes.synthetic import SyntheticScene
from flowsplat.scenes.synthetic.world import camera_at
from flowsplat_benchmarks.priors.measure import compute_pooled_iou
from flowsplat_benchmarks.resume import Job, measure_jobs, results_in
from flowsplat_benchmarks.tables import describe_version

PROTOCOL = "edges"
PRESETS = get_args(Preset)


@dataclass(frozen=True)
class RestingCamera(SyntheticScene):
    """The built-in world from where its camera is half a second after the start."""

    def camera(self, i: int) -> Camera:
        """The same for every frame."""
        return camera_at(0.5, self.width, self.height)


def _keep_settings(config: RunConfig) -> RunConfig:
    return config


@dataclass(frozen=True)
class Edge:
    """An unusual clip.

    Attributes:
        clip: what is filmed.
        change: its settings from those of a preset.
        given_cameras: whether the run is told the cameras, as those of a rig of cameras are.
    """

    clip: SyntheticScene
    change: Callable[[RunConfig], RunConfig] = field(default=_keep_settings)
    given_cameras: bool = False


def _hold_out(every: int) -> Callable[[RunConfig], RunConfig]:
    return lambda config: replace(config, input=replace(config.input, holdout=every))


def _all_frames(config: RunConfig) -> RunConfig:
    return replace(config, input=replace(config.input, max_frames=300))


def _full_size(config: RunConfig) -> RunConfig:
    """At the size of the file, and a third of the steps: each has five times the pixels of the default size."""
    train = replace(config.train, iterations=config.train.iterations // 3)
    return replace(config, input=replace(config.input, resize=0), train=train)


EDGES = {
    "12 wide images": Edge(SyntheticScene(480, 270, 12, fps=6.0), _hold_out(4)),
    "12 wide images, cameras given": Edge(SyntheticScene(480, 270, 12, fps=6.0), _hold_out(4), given_cameras=True),
    "300 frames": Edge(SyntheticScene(426, 240, 300), _all_frames),
    "240p": Edge(SyntheticScene(426, 240, 48)),
    "1080p": Edge(SyntheticScene(1920, 1080, 24), _full_size),
    "portrait": Edge(SyntheticScene(270, 480, 48)),
    "static camera": Edge(RestingCamera(480, 270, 48)),
}


def mask_overlap(spec: SyntheticScene, scene: Scene) -> float:
    """Intersection over union of the scene's masks with the true ones, any object, pooled over the training frames."""

    def pairs() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for i in scene.train_frames:
            k = round(scene.timestamps[i] * spec.fps)
            yield scene.mask(i), spec.cast_rays(spec.camera(k).resize(scene.width, scene.height), spec.timestamps[k])[1]

    return compute_pooled_iou(pairs())


def run_edge(name: str, preset: str, out: Path, key: str) -> dict[str, Any]:
    """Film, run and measure; what is in ``out`` of another ``key`` is forgotten.

    Returns:
        ``name``, ``protocol``, ``preset``, ``flowsplat`` (``source_state``), ``frames``, ``size``, ``test`` (count), ``ours``,
        ``interpolation``, ``training_frames`` (each ``psnr``, ``ssim``, and ``moving``), ``flow_prior_epe``, ``masks_iou``
        (``mask_overlap``), ``gaussians``, ``verdicts``, and ``seconds`` and ``peak_memory_gib``, which are None where the run was
        begun by an earlier process.
    """
    mark = out / "key.json"
    if (out / "clip.mp4").exists() and not (mark.exists() and read_json(mark) == key):
        shutil.rmtree(out)
    edge, is_new = EDGES[name], not out.exists()
    make_folder(out)
    write_json(mark, key)
    spec, video = edge.clip, out / "clip.mp4"
    if not video.exists():
        images = (spec.render(spec.camera(i), time).image for i, time in enumerate(spec.timestamps))
        write_mp4(video, images, spec.fps, crf=12)
    config = edge.change(replace(pipeline.preset(preset), final_fit=False))
    if edge.given_cameras:
        cameras = out / "cameras.json"
        write_json(cameras, [spec.camera(i).to_json() for i in range(spec.frames)])
        config = replace(config, priors=replace(config.priors, given=replace(config.priors.given, cameras=cameras)))
    run = pipeline.prepare(video, out / "run", config)
    pipeline.train(run)
    metrics = pipeline.evaluate_run(run)
    scene = Scene(run.scene_path)
    return {
        "name": name, "protocol": PROTOCOL, "preset": preset, "flowsplat": source_state(),
        "frames": scene.num_frames, "size": [scene.width, scene.height],
        "test": metrics["heldout_frames"]["count"], "ours": metrics["heldout_frames"],
        "interpolation": metrics["baselines"]["flow_interpolation"],
        **{key: metrics[key] for key in ("training_frames", "flow_prior_epe")},
        "masks_iou": round(mask_overlap(spec, scene), 4),
        "gaussians": {key: metrics["gaussians"][key] for key in ("total", "active_mean")},
        "verdicts": {name: (scene.prior(name) or {}).get("verdict", "") for name in ("cameras", "depth", "masks")},
        "seconds": run.seconds if is_new else None, "peak_memory_gib": metrics["peak_memory_gib"] if is_new else None,
    }  # fmt: skip


def table(results: Sequence[Mapping[str, Any]]) -> str:
    """Markdown, for the docs."""
    lines = [
        "| clip | held out: PSNR / SSIM | flow interpolation | training frames | masks: IoU | Gaussians (active) | time, memory "
        "| depth |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for r in results:
        ours, flow = r["ours"], r["interpolation"]
        trusted = re.match(r"\d+ ?%", r["verdicts"]["depth"])
        cost = f"{sum(r['seconds'].values()):.0f} s, {r['peak_memory_gib']} GiB" if r["seconds"] else "-"
        lines.append(
            f"| {r['name']}: {r['frames']} frames of {r['size'][0]}x{r['size'][1]}, {r['preset']} | "
            f"{ours['psnr']:.2f} / {ours['ssim']:.3f} | {flow['psnr']:.2f} / {flow['ssim']:.3f} | "
            f"{r['training_frames']['psnr']:.2f} | {r['masks_iou']:.3f} | "
            f"{r['gaussians']['total'] / 1e3:.0f}k ({r['gaussians']['active_mean'] / 1e3:.0f}k) | {cost} | "
            f"{trusted.group() + ' trusted' if trusted else 'a guess'} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Run what is missing, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, metavar="OUT", help="folder for everything that comes out")
    parser.add_argument("--only", nargs="+", choices=EDGES, default=list(EDGES), metavar="EDGE", help=", ".join(EDGES))
    parser.add_argument("--preset", choices=PRESETS, default="default", help=", ".join(PRESETS))
    options = parser.parse_args()
    out, page = options.out, options.out / f"{PROTOCOL}.md"
    jobs = []
    for name in options.only:
        slug, edge = f"{re.sub(r'[^a-z0-9]+', '-', name)}_{options.preset}", EDGES[name]
        key = stage_key(edge.clip, edge.given_cameras, edge.change(replace(pipeline.preset(options.preset), final_fit=False)))
        jobs.append(Job(slug, key, partial(in_own_process, run_edge, name, options.preset, out / slug, key)))

    def report(failed: Mapping[str, str]) -> Path:
        results = results_in(PROTOCOL, out)
        write_text(page, f"{table(results)}\n\n{describe_version(results)}\n" if results else "")
        return page

    try:
        measure_jobs(jobs, out, report, "clips")
    except InputError as error:
        sys.exit(str(error))
    finally:
        if page.exists():
            print(page.read_text())


if __name__ == "__main__":
    main()
