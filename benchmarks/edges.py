"""Does the method still work at the edges? Unusual clips of the built-in world, each an ordinary run, and what came out.

    python benchmarks/edges.py OUT                                # all of them, about an hour on two cores
    python benchmarks/edges.py OUT --only portrait "static camera"
    python benchmarks/edges.py OUT --read                         # the table of what is there

Every tenth frame is held out and compared with what flow interpolation makes of its neighbours; of the wide pictures, a sixth of
a second apart, every fourth. ``OUT/<edge>/run/`` is the run, ``OUT/<edge>.json`` its figures; the same command again goes on where
it was stopped.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from flowsplat import pipeline
from flowsplat.common.errors import InputError
from flowsplat.common.files import make_folder, write_json
from flowsplat.common.progress import say
from flowsplat.geometry import Camera
from flowsplat.pictures.video import write_mp4
from flowsplat.pipeline import RunConfig
from flowsplat.protocols.process import in_own_process
from flowsplat.scenes import Scene
from flowsplat.scenes.synthetic import SyntheticScene
from flowsplat.scenes.synthetic.world import camera_at


@dataclass(frozen=True)
class RestingCamera(SyntheticScene):
    """The built-in world from where its camera is half a second after the start."""

    def camera(self, i: int) -> Camera:
        """The same for every frame."""
        return camera_at(0.5, self.width, self.height)


def _unchanged(config: RunConfig) -> RunConfig:
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
    change: Callable[[RunConfig], RunConfig] = field(default=_unchanged)
    given_cameras: bool = False


def _holding_out(every: int) -> Callable[[RunConfig], RunConfig]:
    return lambda config: replace(config, input=replace(config.input, holdout=every))


def _all_frames(config: RunConfig) -> RunConfig:
    return replace(config, input=replace(config.input, max_frames=300))


def _full_size(config: RunConfig) -> RunConfig:
    """At the size of the file, and a third of the steps: each has five times the pixels of the default size."""
    train = replace(config.train, iterations=config.train.iterations // 3)
    return replace(config, input=replace(config.input, resize=0), train=train)


EDGES = {
    "12 wide pictures": Edge(SyntheticScene(480, 270, 12, fps=6.0), _holding_out(4)),
    "12 wide pictures, cameras given": Edge(SyntheticScene(480, 270, 12, fps=6.0), _holding_out(4), given_cameras=True),
    "300 frames": Edge(SyntheticScene(426, 240, 300), _all_frames),
    "240p": Edge(SyntheticScene(426, 240, 48)),
    "1080p": Edge(SyntheticScene(1920, 1080, 24), _full_size),
    "portrait": Edge(SyntheticScene(270, 480, 48)),
    "static camera": Edge(RestingCamera(480, 270, 48)),
}


def run_edge(name: str, preset: str, out: Path) -> dict[str, Any]:
    """Film, run and measure.

    Returns:
        ``frames``, ``size``, ``test`` (count), ``ours``, ``interpolation``, ``training_frames`` (each ``psnr``, ``ssim``, and
        ``moving``), ``flow_prior_epe``, ``gaussians``, ``seconds``, ``peak_memory_gib``, ``verdicts``.
    """
    make_folder(out)
    edge = EDGES[name]
    spec, video = edge.clip, out / "clip.mp4"
    if not video.exists():
        pictures = (spec.render(spec.camera(i), time).picture for i, time in enumerate(spec.timestamps))
        write_mp4(video, pictures, spec.fps, crf=12)
    config = edge.change(pipeline.preset(preset))
    if edge.given_cameras:
        cameras = out / "cameras.json"
        write_json(cameras, [_plain(spec.camera(i)) for i in range(spec.frames)])
        config = replace(config, priors=replace(config.priors, given=replace(config.priors.given, cameras=cameras)))
    run = pipeline.prepare(video, out / "run", config)
    pipeline.train(run)
    metrics = pipeline.evaluate_run(run)
    scene = Scene(run.scene_path)
    return {
        "frames": scene.num_frames, "size": [scene.width, scene.height], "test": metrics["heldout_frames"]["count"],
        "ours": metrics["heldout_frames"], "interpolation": metrics["baselines"]["flow_interpolation"],
        **{key: metrics[key] for key in ("training_frames", "flow_prior_epe", "peak_memory_gib")},
        "gaussians": {key: metrics["gaussians"][key] for key in ("total", "active_mean")}, "seconds": run.seconds,
        "verdicts": {name: (scene.prior(name) or {}).get("verdict", "") for name in ("cameras", "depth", "masks")},
    }  # fmt: skip


def _plain(camera: Camera) -> dict[str, Any]:
    return {"viewmat": camera.viewmat.tolist(), "K": camera.K.tolist(), "width": camera.width, "height": camera.height}


def table(results: dict[str, dict[str, Any]]) -> str:
    """Markdown, as it stands in the docs."""
    lines = [
        "| clip | held out: PSNR / SSIM | flow interpolation | training frames | Gaussians (active) | time, peak memory | depth |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for name, r in results.items():
        ours, flow, seconds = r["ours"], r["interpolation"], sum(r["seconds"].values())
        trusted = re.match(r"\d+ ?%", r["verdicts"]["depth"])
        lines.append(
            f"| {name}: {r['frames']} frames of {r['size'][0]}x{r['size'][1]} | {ours['psnr']:.2f} / {ours['ssim']:.3f} | "
            f"{flow['psnr']:.2f} / {flow['ssim']:.3f} | {r['training_frames']['psnr']:.2f} | "
            f"{r['gaussians']['total'] / 1e3:.0f}k ({np.mean(r['gaussians']['active_mean']) / 1e3:.0f}k) | "
            f"{seconds:.0f} s, {r['peak_memory_gib']} GiB | {trusted.group() + ' trusted' if trusted else 'a guess'} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Run what is missing, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, metavar="OUT", help="folder for everything that comes out")
    parser.add_argument("--only", nargs="+", choices=EDGES, default=list(EDGES), metavar="EDGE", help=", ".join(EDGES))
    parser.add_argument("--preset", default="default", help="fast, default, paper or high")
    parser.add_argument("--read", action="store_true", help="measure nothing")
    options = parser.parse_args()
    results = {}
    for name in options.only:
        place = options.out / re.sub(r"\W+", "-", name)
        figures = place.with_suffix(".json")
        if not figures.exists() and not options.read:
            say(f"{name} ...")
            try:
                write_json(figures, in_own_process(run_edge, name, options.preset, place))
            except InputError as error:
                say(f"{name}: {error}")
        if figures.exists():
            results[name] = json.loads(figures.read_text())
    print(table(results))


if __name__ == "__main__":
    main()
