"""The main job on the built-in clip: as a user would run it (with fewer steps), and with true priors beside it."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

from flowsplat.common.errors import InputError
from flowsplat.common.files import make_folder, read_json, write_bytes, write_json
from flowsplat.common.progress import console, say
from flowsplat.common.run_paths import RunPaths
from flowsplat.output.report import verdict
from flowsplat.pipeline.config import RunConfig
from flowsplat.pipeline.fitting import train
from flowsplat.pipeline.preparing import link_files, prepare
from flowsplat.pipeline.stages import render_run
from flowsplat.pipeline.summary import figures_table, next_steps
from flowsplat.scenes import Scene
from flowsplat.scenes.synthetic import SyntheticScene, write_synthetic, write_synthetic_video

ITERATIONS = 600


def run_demo(out: Path, width: int = 320, frames: int = 40) -> None:
    """Render the built-in clip to a video, run on that video, run with true priors, and print both results side by side.

    Raises:
        InputError: a clip of that size or length is none, or the folder cannot be written, or holds another clip.
    """
    if not 64 <= width <= 1920 or not 3 <= frames <= 1000:
        raise InputError(f"A demo of {frames} frames of {width} pixels cannot be made: --size 64 to 1920, --frames 3 to 1000.")
    spec = SyntheticScene(width=width, height=width * 9 // 16, frames=frames)
    make_folder(out)
    video, truth, record = out / "clip.mp4", out / "truth", out / "clip.json"
    if record.exists() and read_json(record) != asdict(spec):
        raise InputError(f"{out} holds the demo with another size or number of frames: choose another folder with -o.")
    write_json(record, asdict(spec))
    if not video.exists():
        write_synthetic_video(video, spec)
    if not (truth / "complete").exists():
        write_synthetic(truth, spec, holdout=RunConfig().input.holdout)
        (truth / "complete").touch()
    config = RunConfig()
    config = replace(config, train=replace(config.train, iterations=ITERATIONS))
    say("Running on the video, as on any clip.")
    own = prepare(video, out / "own", config)
    _lend_truth(Scene(truth), own.scene_path)
    train(own)
    own_metrics = render_run(own)
    say("Running with the true cameras, depth, masks and flow.")
    # It is there to compare with: one video shows enough.
    render = replace(config.render, paths=("input",))
    compared = replace(config, final_fit=False, render=render, priors=replace(config.priors, priors="true"))
    true = prepare(truth, out / "true", compared)
    train(true)
    true_metrics = render_run(true)
    console.print(figures_table({"own priors": own_metrics, "true priors": true_metrics}))
    say(f"Own priors. {verdict(own_metrics)}")
    say(f"True priors. {verdict(true_metrics)} {RunPaths(out / 'true').report_path}")
    for line in next_steps(out / "own"):
        say(line)


def _lend_truth(truth: Scene, scene: Path) -> None:
    """Let the evaluation (and nothing else) of the run on the video see the truth of the clip and its held-out views."""
    for name in ("truth", "views"):
        if not (scene / name).exists():
            link_files(truth.folder / name, scene / name)
    write_bytes(scene / "views.json", (truth.folder / "views.json").read_bytes())
