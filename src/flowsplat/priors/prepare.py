"""All priors of a scene, in order: given ones first, then what is missing."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Annotated, Literal

import tyro

from flowsplat.common.errors import InputError
from flowsplat.common.progress import busy, say
from flowsplat.priors.background.matched_clip import MatchedClip, forget_solutions
from flowsplat.priors.background.static_depth import static_depth
from flowsplat.priors.cameras import CameraOptions, camera_stage
from flowsplat.priors.cameras.stage import OWN, require_lens_in_pictures
from flowsplat.priors.depth import depth_stage
from flowsplat.priors.flow import FlowEstimator, dis_estimator, flow_stage
from flowsplat.priors.given import GivenPriors, true_layers, use_given, use_truth
from flowsplat.priors.learned.weights import ModelOptions, network_device
from flowsplat.priors.masks import mask_stage
from flowsplat.priors.monocular import monocular_stage
from flowsplat.priors.mover_flow import mover_flow_stage
from flowsplat.priors.objects import objects_stage
from flowsplat.priors.objects.hints import Hint, parse_hints
from flowsplat.priors.prompts import Prompt, parse_prompts, prompt_stage, show_at_once, shows
from flowsplat.priors.tracks import complete_tracks, tracks_stage
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
    """A moving object: x,y@frame, in pixels of the prepared frames or as shares of the picture (0.5,0.4@0). Repeat it for more.
    With the number of an object behind it (x,y@frame=1) it corrects that one, on another frame, say: they count from 1, boxes
    first."""
    mask_box: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """A box round a moving object: x0,y0,x1,y1@frame. A click inside it on the same frame belongs to it."""
    mask_not: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """What is none of these objects, or not the one of a number: x,y@frame or x,y@frame=1. Any frame will do."""
    touch: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Where something that moves touches what is still, the ground, say: x,y@frame, as for --mask-click. One such place tells how
    far away it is over the whole clip. Repeat it for more."""
    distance: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """What something that moves is as far away as: x,y@frame=x2,y2, where x2,y2 shows something still in that frame."""
    depth: Literal["multiview", "depth-anything", "depth-pro"] = "multiview"
    """Depth: multiview (no weights), or a monocular network of the extra ``learned``, fitted to the cameras frame by frame."""
    models: ModelOptions = field(default_factory=ModelOptions)
    """Which weights the learned ones use."""
    given: GivenPriors = field(default_factory=GivenPriors)
    """Your own files, which take the place of either."""
    cameras: CameraOptions = field(default_factory=CameraOptions)
    """How cameras are computed."""


Stage = Callable[[], None]

_PRIORS = ("cameras", "flow", "masks", "tracks", "depth")
"""In the order in which they need each other."""
_FOLLOW = {
    "cameras": ("masks", "depth", "tracks"), "flow": ("masks", "depth", "tracks"), "masks": ("depth", "tracks"),
    "depth": ("tracks",), "tracks": (),
}  # fmt: skip
"""What is computed from each of them."""
_OWN_DEPTH = ("multi-view", "guess")


def prepare_priors(
    scene: Scene, options: PriorsOptions, device: str = "auto", after: Callable[[str, float], None] | None = None
) -> dict[str, float]:
    """Complete the priors of a scene.

    Those that are there are kept, and one line says which. But where an option asks for another method than the one that is
    recorded, the prior is computed anew, and with it what follows from it, as far as that would be made as it was; a line
    says this, too. An option that is left at its default asks for nothing. Asked for in this sense are ``--flow``,
    ``--masks``, clicks and boxes, ``--depth``, ``--priors true`` (which goes before the three methods) and given depth and
    tracks; and other ``--cameras`` options than those that our own cameras were computed with. Given, true or calibrated
    cameras are not replaced by such options, which say how cameras are computed, and not whether.

    Args:
        device: where networks run: auto, cpu or cuda.
        after: is told when a prior was computed, and how many seconds that took.

    Returns:
        Seconds of every stage that ran.

    Raises:
        InputError: a given file does not fit, or cannot replace what the scene has; the scene has no truth, a network is not
            there, a click is no click, or no cameras can be found; or the scene has depth that belongs to its cameras and
            cannot be made anew for others.
    """
    prompts, hints = check_places(scene, options)
    if hints and (options.priors == "true" or options.depth != "multiview" or options.given.depth is not None):
        raise InputError("--touch and --distance place movers in depth of our own: leave out what takes other depth.")
    if prompts and options.given.masks is not None:
        raise InputError("--given.masks and --mask-click or --mask-box both say what moves: give one of them.")
    _require_pictures_as_they_are(options)
    unwanted = _unwanted(scene, options, prompts)
    depth = _method(scene, "depth")
    if hints and depth is not None and not _has_hints(scene, hints):
        if depth not in _OWN_DEPTH:
            raise InputError(f"The scene has depth already ({depth}), in which --touch and --distance place nothing.")
        unwanted.add("depth")
    _say_what_is_kept(scene, unwanted)
    seconds: dict[str, float] = {}
    if options.priors == "true" and (unwanted or _missing(scene)):
        true_layers(scene)
        _forget(scene, unwanted)
        seconds["truth"] = _timed(lambda: use_truth(scene))
        unwanted = _unwanted(scene, options, prompts)
    # Networks are loaded before anything is forgotten or computed: that one is missing is said now, not after minutes of work.
    due = {*_missing(scene), *unwanted}
    estimate = flow_estimator(options, device) if {"flow", "masks", "depth"} & due else dis_estimator
    ours = [name for name in _CHOICES if name in due and getattr(options.given, name) is None]
    chosen = {name: _CHOICES[name](scene, options, prompts, hints, estimate, device) for name in ours}
    _forget(scene, unwanted)
    missing = _missing(scene)
    if prompts and "masks" in missing:
        with busy("Looking at clicks and boxes"):
            path = show_at_once(scene, prompts, estimate)
        say(f"What clicks and boxes mean at first sight, before the clip is known: {path}")
    later: dict[str, Stage] = {}
    if options.given != GivenPriors() and missing:
        start = time.perf_counter()
        later = use_given(scene, options.given, estimate)
        seconds["given"] = time.perf_counter() - start
        missing = _missing(scene)
    stages = {
        "cameras": lambda: camera_stage(scene, options.cameras),
        "flow": lambda: flow_stage(scene, options.flow, estimate),
        "tracks": lambda: tracks_stage(scene),
        **chosen,
        **later,
    }
    for name in missing:
        with busy(f"Computing {name}"):
            seconds[name] = _timed(stages.pop(name))
        say(f"{name}: {_verdict(scene, name)} ({seconds[name]:.0f} s)")
        if after is not None:
            after(name, seconds[name])
    if (scene.prior("tracks") or {}).get("incomplete"):
        seconds["tracks"] = seconds.get("tracks", 0.0) + _timed(lambda: complete_tracks(scene))
    if _method(scene, "flow") == "dis" and not (scene.prior("flow") or {}).get("movers"):
        seconds["flow"] = seconds.get("flow", 0.0) + _timed(lambda: mover_flow_stage(scene))
    forget_solutions(scene)
    _ = scene.similarity  # Computed and stored here, so that training and evaluation share it.
    return seconds


def names_places(options: PriorsOptions) -> bool:
    """Whether clicks, boxes or distances are given, which a clip has to be read for."""
    return bool(options.mask_click or options.mask_box or options.mask_not or options.touch or options.distance)


def check_places(scene: Scene, options: PriorsOptions) -> tuple[list[Prompt], list[Hint]]:
    """Clicks and boxes, and what is said of movers' distances.

    Raises:
        InputError: one of them is none, or not of this clip.
    """
    prompts = parse_prompts(options.mask_click, options.mask_box, scene, options.mask_not)
    return prompts, parse_hints(options.touch, options.distance, scene)


def _require_pictures_as_they_are(options: PriorsOptions) -> None:
    """Refuse files that belong to the pictures as they came where these are to be straightened."""
    named = [name for name in ("cameras", "depth", "flow", "tracks") if getattr(options.given, name) is not None]
    if options.cameras.distortion == "radial" and (named or options.priors == "true"):
        files = f"--given.{named[0]}" if named else "--priors true"
        raise InputError(f"{files} belongs to the pictures as they came: leave out --cameras.distortion radial.")


def _missing(scene: Scene) -> list[str]:
    """The priors that are not there, in the order in which they need each other."""
    return [name for name in _PRIORS if scene.prior(name) is None]


def _method(scene: Scene, name: str) -> str | None:
    prior = scene.prior(name)
    return None if prior is None else str(prior.get("method"))


def _has_hints(scene: Scene, hints: list[Hint]) -> bool:
    """Whether the movers that are there were placed with these hints."""
    return (scene.prior("objects") or {}).get("hints", []) == [hint.text for hint in hints]


def _asked(options: PriorsOptions, has_prompts: bool) -> dict[str, str]:
    """The method of every prior for which the options ask."""
    asked: dict[str, str] = {}
    if options.flow != "dis":
        asked["flow"] = options.flow
    if has_prompts or options.masks != "motion":
        asked["masks"] = "clicks" if options.masks == "motion" else options.masks
    if options.depth != "multiview":
        asked["depth"] = options.depth
    if options.priors == "true":
        asked |= {name: "truth" for name in ("cameras", "masks", "depth") if name != "masks" or not has_prompts}
    return asked | {name: "given" for name in _PRIORS if getattr(options.given, name) is not None}


def _unwanted(scene: Scene, options: PriorsOptions, prompts: list[Prompt]) -> set[str]:
    """The priors that are there and must be computed anew: the user asks for other ones, or they follow from such.

    Raises:
        InputError: something that is there cannot be replaced.
    """
    for name in ("cameras", "flow", "masks"):
        method = _method(scene, name)
        if getattr(options.given, name) is not None and method not in (None, "given"):
            raise InputError(f"The scene has {name} already ({method}), which --given.{name} cannot replace. Start from the clip.")
    asked = _asked(options, bool(prompts))
    if options.priors == "true" and _method(scene, "flow") == "truth":
        asked.pop("flow", None)
    found = {name for name, method in asked.items() if _method(scene, name) not in (None, method)}
    if prompts and _method(scene, "masks") == asked.get("masks") and not shows(scene, prompts):
        found.add("masks")
    are_own_other = "cameras" not in asked and _are_other_cameras_asked(scene, options.cameras)
    if are_own_other:
        found.add("cameras")
    follow = dict(_FOLLOW)
    if options.cameras.distortion == "radial" and scene.info.lens is None:
        follow["cameras"] = ("flow", *follow["cameras"])
    # What follows is only computed anew where that is done as it was; the result of clicks, say, is kept without new clicks.
    usual = {"flow": ("dis",), "masks": ("motion",), "depth": ("multi-view", "guess"), "tracks": ("patches",)}
    ways = usual | {name: (method,) for name, method in asked.items()}
    for name in _PRIORS:
        if name in found:
            found |= {other for other in follow[name] if _method(scene, other) != "truth" and _method(scene, other) in ways[other]}
    if are_own_other:
        _require_new_cameras(scene, options.cameras, found)
    return found


def _are_other_cameras_asked(scene: Scene, options: CameraOptions) -> bool:
    """Whether our own cameras are there, but were computed with other settings than those that differ from the defaults."""
    prior, usual = scene.prior("cameras") or {}, asdict(CameraOptions())
    used = prior.get("options", {})
    return prior.get("method") == OWN and any(value not in (usual[name], used.get(name)) for name, value in asdict(options).items())


def _require_new_cameras(scene: Scene, options: CameraOptions, unwanted: set[str]) -> None:
    """Refuse to replace cameras under what was made for them and stays."""
    method = _method(scene, "depth")
    if method is not None and "depth" not in unwanted:
        raise InputError(
            f"The depth of {scene.name} ({method}) belongs to the cameras that are there, and these options would not make it "
            "anew: start from the clip, or leave out what asks for other cameras."
        )
    if options.distortion == "radial" and scene.info.lens is None:
        require_lens_in_pictures(scene, unwanted)


def _say_what_is_kept(scene: Scene, unwanted: set[str]) -> None:
    there = [name for name in _PRIORS if scene.prior(name) is not None]
    for names, what in (
        ([name for name in there if name in unwanted], "Computed anew, because other ones are asked for or follow"),
        ([name for name in there if name not in unwanted], "Already there and kept"),
    ):
        if names:
            say(f"{what}: {', '.join(f'{name} ({_method(scene, name)})' for name in names)}.")


def _forget(scene: Scene, names: set[str]) -> None:
    """Note that priors are not there, and delete those of their files that would be taken for what is being computed."""
    if not names:
        return
    scene.forget_priors({*names, "objects"})
    for path in ("objects.json", "objects.npz"):
        (scene.folder / path).unlink(missing_ok=True)
    for name in names & {"flow", "depth"}:
        shutil.rmtree(scene.folder / name, ignore_errors=True)
    if "tracks" in names:
        (scene.folder / "tracks.npz").unlink(missing_ok=True)


def flow_estimator(options: PriorsOptions, device: str) -> FlowEstimator:
    """What finds flow under these options.

    Raises:
        InputError: a network is not there.
    """
    if options.flow == "dis":
        return dis_estimator
    from flowsplat.priors.learned.raft import raft_estimator

    return raft_estimator(options.models.raft, network_device(device))


def _choose_masks(
    scene: Scene, options: PriorsOptions, prompts: list[Prompt], hints: list[Hint], estimate: FlowEstimator, device: str
) -> Stage:
    if options.masks == "motion":
        return partial(prompt_stage, scene, prompts, estimate) if prompts else partial(mask_stage, scene, estimate)
    from flowsplat.priors.learned.sam import load_segmenter, prompts_from_masks, sam_stage

    segmenter = load_segmenter(options.masks, options.models, network_device(device))
    if prompts:
        return partial(sam_stage, scene, segmenter, prompts, "clicks and boxes")

    def found_by_motion() -> None:
        mask_stage(scene, estimate)
        sam_stage(scene, segmenter, prompts_from_masks(scene), "motion")

    return found_by_motion


def _choose_depth(
    scene: Scene, options: PriorsOptions, prompts: list[Prompt], hints: list[Hint], estimate: FlowEstimator, device: str
) -> Stage:
    if options.depth == "multiview":
        return partial(_objects_and_depth, scene, estimate, hints)
    from flowsplat.priors.learned.depth import learned_depth

    source = learned_depth(options.depth, scene, options.models, network_device(device))
    return partial(monocular_stage, scene, source, estimate)


def _objects_and_depth(scene: Scene, estimate: FlowEstimator, hints: list[Hint]) -> None:
    """Movers first: they have a distance of their own, and the depth of their pixels follows from it."""
    has_masks = all(scene.has_mask(i) for i in scene.train_frames)
    clip = MatchedClip(scene, estimate)
    static = clip, static_depth(clip, has_masks)
    # Depth that is half done belongs to the objects that were found for it.
    same = scene.prior("objects") is not None and (not hints or _has_hints(scene, hints))
    goes_on = same and any(scene.has_depth(i) for i in scene.train_frames)
    if has_masks and scene.has_tracks and not goes_on:
        shutil.rmtree(scene.folder / "depth", ignore_errors=True)
        objects_stage(scene, estimate, static, hints)
        say(f"objects: {_verdict(scene, 'objects')}")
    depth_stage(scene, estimate, static)


_CHOICES = {"masks": _choose_masks, "depth": _choose_depth}


def _timed(stage: Stage) -> float:
    start = time.perf_counter()
    stage()
    return time.perf_counter() - start


def _verdict(scene: Scene, name: str) -> str:
    prior = scene.prior(name) or {}
    return str(prior.get("verdict", prior.get("method", "done")))
