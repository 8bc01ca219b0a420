"""The main job on a drawn clip: as a user would run it (with fewer steps), and with true priors beside it."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Literal

from flowsplat.common.devices import pick_device
from flowsplat.common.durations import format_duration, get_beginning
from flowsplat.common.errors import InputError
from flowsplat.common.files import make_folder, read_json, write_bytes, write_json
from flowsplat.common.progress import report
from flowsplat.evaluation.scores import pick
from flowsplat.pipeline.compare import NAME, compare
from flowsplat.pipeline.compiling import compile_ahead
from flowsplat.pipeline.config import RunConfig
from flowsplat.pipeline.fitting import train
from flowsplat.pipeline.folder import RunFolder
from flowsplat.pipeline.preparing import link_files, prepare
from flowsplat.pipeline.stages import render_run
from flowsplat.pipeline.summary import next_steps
from flowsplat.scenes import Scene
from flowsplat.scenes.synthetic import DrawnClip, StreetScene, SyntheticScene, encode_frames, write_synthetic

DEMO_ITERATIONS = 600
"""Training steps of the demo's run. Chosen by eye."""

World = Literal["street", "floating"]
"""``street``: what people film. ``floating``: three things that float in a room, whose distance no camera can tell."""

SCENE_WORDS: dict[World, str] = {
    "street": "a street where someone walks, a cart rolls and a ball bounces",
    "floating": "a room where three things float, how far away nobody can tell",
}

TRUE_ITERATIONS: dict[World, int] = {"street": 300, "floating": DEMO_ITERATIONS}
"""Of the run with true priors. It is there to compare with, and needs half as many to be ahead. The room's stay as they were, so
that its figures can be compared with those of earlier versions."""


def run_demo(out: Path, width: int = 320, frames: int = 40, world: World = "street") -> None:
    """Draw a clip, run on its video, run with true priors, and say in a few lines what came of it.

    Raises:
        InputError: a clip of that size or length is none, or the folder cannot be written, or holds another clip.
    """
    begun = get_beginning()
    if not 64 <= width <= 1920 or not 3 <= frames <= 1000:
        raise InputError(f"A demo of {frames} frames of {width} pixels cannot be made: --size 64 to 1920, --frames 3 to 1000.")
    spec, record = _clip_of(world, width, frames)
    make_folder(out)
    if (out / "clip.json").exists() and read_json(out / "clip.json") != record:
        raise InputError(
            f"{out} holds the demo of another world, or with another size or number of frames: choose another folder with -o."
        )
    write_json(out / "clip.json", record)
    config = RunConfig()
    config = replace(config, train=replace(config.train, iterations=DEMO_ITERATIONS))
    with compile_ahead(pick_device(config.device).type) as ahead:
        truth = _draw_clip(out, spec, config)
        report("Running on the video, as on any clip.")
        own = prepare(out / "clip.mp4", out / "own", config)
        ahead.wait()
    _lend_truth(truth, own.scene_path)
    train(own)
    own_metrics = render_run(own)
    report("Running with the true cameras, depth, masks and flow.")
    true = prepare(truth.folder, out / "true", _to_compare(config, TRUE_ITERATIONS[world]))
    train(true)
    true_metrics = render_run(true)
    compare(own.path, true.path)
    for line in _describe_result(out, world, spec, own, own_metrics, true_metrics, time.perf_counter() - begun):
        report(line)


def _clip_of(world: World, width: int, frames: int) -> tuple[DrawnClip, dict[str, Any]]:
    """Return the clip, and what tells it from others."""
    height = width * 9 // 16
    if world == "street":
        street = StreetScene(width=width, height=height, frames=frames)
        return street, {"world": world, **asdict(street)}
    room = SyntheticScene(width=width, height=height, frames=frames)
    return room, asdict(room)


def _draw_clip(out: Path, spec: DrawnClip, config: RunConfig) -> Scene:
    """Return the clip with its truth in ``OUT/truth``, and its frames as ``OUT/clip.mp4``."""
    folder, video = out / "truth", out / "clip.mp4"
    if not (folder / "complete").exists():
        write_synthetic(folder, spec, holdout=config.input.holdout)
        (folder / "complete").touch()
    truth = Scene(folder)
    if not video.exists():
        encode_frames(video, truth)
    return truth


def _to_compare(config: RunConfig, iterations: int) -> RunConfig:
    """Return the settings of the run with true priors. It is there to compare with: one video shows enough."""
    return replace(
        config, final_fit=False, train=replace(config.train, iterations=iterations),
        render=replace(config.render, paths=("input",)), priors=replace(config.priors, priors="true"),
    )  # fmt: skip


def _lend_truth(truth: Scene, scene: Path) -> None:
    """Let the evaluation (and nothing else) of the run on the video see the truth of the clip and its held-out views."""
    for name in ("truth", "views"):
        if not (scene / name).exists():
            link_files(truth.folder / name, scene / name)
    write_bytes(scene / "views.json", (truth.folder / "views.json").read_bytes())


def _describe_result(
    out: Path, world: World, spec: DrawnClip, own: RunFolder, metrics: Mapping[str, Any], true: Mapping[str, Any], seconds: float
) -> Iterator[str]:
    """Tell what was made, a figure along the path, one from aside, and what to do next."""
    yield ""
    yield f"Made in {format_duration(seconds)}: {out / 'clip.mp4'}, {spec.frames} frames of {SCENE_WORDS[world]},"
    yield f"became a 4D scene by its images alone, as your own clip would: {own.path}."
    frames, between = (pick(metrics, *path, "psnr") for path in (("heldout_frames",), ("baselines", "flow_interpolation")))
    if frames is not None:
        beside = "" if between is None else f"; interpolating their neighbors by optical flow gives {between:.1f}"
        yield f"  Along the path: frames that it never saw are rendered at {frames:.1f} dB{beside}."
    (views, moving), (best, best_moving) = (
        (pick(of, "heldout_views", "psnr"), pick(of, "heldout_views", "moving", "psnr")) for of in (metrics, true)
    )
    if views is not None and best is not None:
        what, truly = ("" if each is None else f" ({each:.1f} where it moves)" for each in (moving, best_moving))
        steps = TRUE_ITERATIONS[world]
        yield f"  From aside: cameras that stood beside the path see {views:.1f} dB{what}; true cameras, depth, masks and flow"
        yield f"  give {best:.1f}{truly}, with {steps} steps of training. Side by side: {out / NAME}."
    yield "Go on with"
    yield from next_steps(own.path)
