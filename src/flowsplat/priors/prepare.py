"""All priors of a scene, in order: given ones first, then what is missing."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Literal

import tyro

from flowsplat.common.errors import InputError
from flowsplat.common.progress import say
from flowsplat.priors.background.matched_clip import forget_solutions
from flowsplat.priors.cameras import CameraOptions, camera_stage
from flowsplat.priors.depth import depth_stage
from flowsplat.priors.flow import FlowEstimator, dis_estimator, flow_stage
from flowsplat.priors.given import GivenPriors, use_given, use_truth
from flowsplat.priors.learned.weights import ModelOptions, network_device
from flowsplat.priors.masks import mask_stage
from flowsplat.priors.monocular import monocular_stage
from flowsplat.priors.prompts import Prompt, parse_prompts, prompt_stage
from flowsplat.priors.tracks import tracks_stage
from flowsplat.scenes import Scene


@dataclass(frozen=True)
class PriorsOptions:
    """Where the priors come from."""

    priors: Literal["own", "true"] = "own"
    """``own`` computes them from the frames; ``true`` takes those of a rendered scene, as far as it has them."""
    flow: Literal["dis", "raft"] = "dis"
    """Optical flow: dis (no weights) or raft (a network of the extra ``learned``)."""
    masks: Literal["motion", "sam2", "sam3"] = "motion"
    """Masks of what moves: motion (no weights), or what the motion or your clicks and boxes show, followed by a network of the
    extra ``learned``."""
    mask_click: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """A moving object: x,y@frame, in pixels of the prepared frames or as shares of the picture (0.5,0.4@0). Repeat it for more."""
    mask_box: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """A box round a moving object: x0,y0,x1,y1@frame. A click inside it on the same frame belongs to it."""
    depth: Literal["multiview", "depth-anything", "depth-pro"] = "multiview"
    """Depth: multiview (no weights), or a monocular network of the extra ``learned``, fitted to the cameras frame by frame."""
    models: ModelOptions = field(default_factory=ModelOptions)
    """Which weights the learned ones use."""
    given: GivenPriors = field(default_factory=GivenPriors)
    """Your own files, which take the place of either."""
    cameras: CameraOptions = field(default_factory=CameraOptions)
    """How cameras are computed."""


Stage = Callable[[], None]


def prepare_priors(scene: Scene, options: PriorsOptions, device: str = "auto") -> dict[str, float]:
    """Complete the priors of a scene; those that are there are kept, but for those that the options name otherwise.

    Args:
        device: where networks run: auto, cpu or cuda.

    Returns:
        Seconds of every stage that ran.

    Raises:
        InputError: a given file does not fit, the scene has no truth, a network is not there, a click is no click, or no
            cameras can be found.
    """
    prompts = parse_prompts(options.mask_click, options.mask_box, scene)
    if prompts and options.given.masks is not None:
        raise InputError("--given.masks and --mask-click or --mask-box both say what moves: give one of them.")
    _require_pictures_as_they_are(options)
    _set_aside(scene, options, bool(prompts))
    missing = _missing(scene)
    seconds: dict[str, float] = {}
    if options.priors == "true" and missing:
        seconds["truth"] = _timed(lambda: use_truth(scene))
        _set_aside(scene, options, bool(prompts))
        missing = _missing(scene)
    # Networks are loaded before anything is computed: that one is missing is said now, and not after minutes of other work.
    estimate = _flow_estimator(options, device) if {"flow", "masks", "depth"} & set(missing) else dis_estimator
    later: dict[str, Stage] = {}
    if options.given != GivenPriors() and missing:
        start = time.perf_counter()
        later = use_given(scene, options.given, estimate)
        seconds["given"] = time.perf_counter() - start
        missing = _missing(scene)
    chosen = set(missing) - set(later)
    stages = {
        "cameras": lambda: camera_stage(scene, options.cameras),
        "flow": lambda: flow_stage(scene, options.flow, estimate),
        "tracks": lambda: tracks_stage(scene),
        **{name: choose(scene, options, prompts, estimate, device) for name, choose in _CHOICES.items() if name in chosen},
        **later,
    }
    for name in missing:
        seconds[name] = _timed(stages.pop(name))
        say(f"{name}: {_verdict(scene, name)} ({seconds[name]:.0f} s)")
    forget_solutions(scene)
    _ = scene.similarity  # Computed and stored here, so that training and evaluation share it.
    return seconds


def _require_pictures_as_they_are(options: PriorsOptions) -> None:
    """Refuse files that belong to the pictures as they came where these are to be straightened."""
    named = [name for name in ("cameras", "depth", "flow", "tracks") if getattr(options.given, name) is not None]
    if options.cameras.distortion == "radial" and (named or options.priors == "true"):
        files = f"--given.{named[0]}" if named else "--priors true"
        raise InputError(f"{files} belongs to the pictures as they came: leave out --cameras.distortion radial.")


def _missing(scene: Scene) -> list[str]:
    """The priors that are not there, in the order in which they need each other."""
    return [name for name in ("cameras", "flow", "masks", "depth", "tracks") if scene.prior(name) is None]


def _set_aside(scene: Scene, options: PriorsOptions, has_prompts: bool) -> None:
    """Forget priors that the user wants from elsewhere: from clicks, or from files that cannot be read in at once."""
    by_prompts = "clicks" if options.masks == "motion" else options.masks
    wanted = {
        "masks": by_prompts if has_prompts else None,
        "depth": "given" if options.given.depth else None,
        "tracks": "given" if options.given.tracks else None,
    }
    # Motion only shows a network what to follow, so its masks are not yet what was asked for.
    if options.masks != "motion" and (scene.prior("masks") or {}).get("method") == "motion":
        wanted["masks"] = options.masks
    for name in ("cameras", "flow", "masks"):
        existing = scene.prior(name)
        if getattr(options.given, name) is not None and existing is not None and existing.get("method") != "given":
            method = existing.get("method")
            raise InputError(f"The scene has {name} already ({method}), which --given.{name} cannot replace. Start from the clip.")
    for name, method in wanted.items():
        existing = scene.prior(name)
        if method is not None and existing is not None and existing.get("method") != method:
            if name == "masks":
                _forget_what_masks_shaped(scene)
            _forget(scene, name)


def _forget(scene: Scene, name: str) -> None:
    scene.info["priors"].pop(name, None)
    if name == "depth":
        scene.info["similarity"] = None  # It made the old depth's median 1.
    scene.save_info()


def _forget_what_masks_shaped(scene: Scene) -> None:
    """Depth stands movers before what is behind them, and tracks say which of them move: both are made anew with new masks."""
    for name, files in (("depth", scene.folder / "depth"), ("tracks", scene.folder / "tracks.npz")):
        if (scene.prior(name) or {}).get("method") not in ("given", "truth"):
            _forget(scene, name)
            shutil.rmtree(files) if files.is_dir() else files.unlink(missing_ok=True)


def _flow_estimator(options: PriorsOptions, device: str) -> FlowEstimator:
    if options.flow == "dis":
        return dis_estimator
    from flowsplat.priors.learned.raft import raft_estimator

    return raft_estimator(options.models.raft, network_device(device))


def _choose_masks(
    scene: Scene, options: PriorsOptions, prompts: list[Prompt], estimate: FlowEstimator, device: str
) -> Stage:
    if options.masks == "motion":
        return partial(prompt_stage, scene, prompts) if prompts else partial(mask_stage, scene, estimate)
    from flowsplat.priors.learned.sam import load_segmenter, prompts_from_masks, sam_stage

    segmenter = load_segmenter(options.masks, options.models, network_device(device))
    if prompts:
        return partial(sam_stage, scene, segmenter, prompts, "clicks and boxes")

    def found_by_motion() -> None:
        mask_stage(scene, estimate)
        sam_stage(scene, segmenter, prompts_from_masks(scene), "motion")

    return found_by_motion


def _choose_depth(
    scene: Scene, options: PriorsOptions, prompts: list[Prompt], estimate: FlowEstimator, device: str
) -> Stage:
    if options.depth == "multiview":
        return partial(depth_stage, scene, estimate)
    from flowsplat.priors.learned.depth import learned_depth

    source = learned_depth(options.depth, scene, options.models, network_device(device))
    return partial(monocular_stage, scene, source, estimate)


_CHOICES = {"masks": _choose_masks, "depth": _choose_depth}


def _timed(stage: Stage) -> float:
    start = time.perf_counter()
    stage()
    return time.perf_counter() - start


def _verdict(scene: Scene, name: str) -> str:
    prior = scene.prior(name) or {}
    return str(prior.get("verdict", prior.get("method", "done")))
