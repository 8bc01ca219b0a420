"""Prepare all priors of a scene, in the order of their graph: given ones first, then what is missing."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from dataclasses import replace

from flowsplat.common.errors import InputError
from flowsplat.common.progress import report, spinner
from flowsplat.priors.flow import FlowEstimator, dis_estimator
from flowsplat.priors.given import GivenPriors, true_layers
from flowsplat.priors.graph import PRIORS
from flowsplat.priors.kinds.flow import flow_estimator
from flowsplat.priors.learned.networks import describe_choice, describe_time, fill_methods
from flowsplat.priors.objects.hints import Hint, parse_hints
from flowsplat.priors.options import PriorsOptions
from flowsplat.priors.prior import Prior, PriorRequest, Stage
from flowsplat.priors.prompts import FrameNumbers, Prompt, parse_prompts, show_at_once
from flowsplat.scenes import Scene


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
    request = request_of(scene, options, device)
    stale = PRIORS.stale(request)
    _report_what_is_kept(request, stale)
    if options.priors == "auto":
        report(describe_choice(options, request.options, device))
    seconds: dict[str, float] = {}
    if request.wants_truth and (stale or PRIORS.list_missing(scene)):
        true_layers(scene)
        PRIORS.forget(scene, stale)
        seconds["truth"] = _time(lambda: PRIORS.read_truth(request))
        stale = PRIORS.stale(request)
    # Networks are loaded before anything is forgotten or computed: that one is missing is said now, not after minutes of work.
    due = [prior for prior in PRIORS.whole if prior.name in stale or scene.prior(prior.name) is None]
    if any(prior.kind.finds_flow for prior in due):
        request = replace(request, estimate=flow_estimator(request.options, device))
    ready = {prior.name: _ready(request, prior) for prior in due if prior.name not in options.given.named}
    if took := describe_time(request.options, list(ready), len(scene.train_frames), (scene.width, scene.height), device):
        report(took)
    PRIORS.forget(scene, stale)
    missing = PRIORS.list_missing(scene)
    if request.prompts and "masks" in missing:
        with spinner("Looking at clicks and boxes"):
            path = show_at_once(scene, request.prompts, request.estimate)
        report(f"What clicks and boxes mean at first sight, before the clip is known: {path}")
    if options.given != GivenPriors() and missing:
        start = time.perf_counter()
        ready |= PRIORS.read_given(request)
        seconds["given"] = time.perf_counter() - start
    _compute(request, ready, seconds, after)
    PRIORS.clear_scratch(scene)
    _ = scene.similarity  # Computed and stored here, so that training and evaluation share it.
    return seconds


def request_of(scene: Scene, options: PriorsOptions, device: str = "auto") -> PriorRequest:
    """Return what the options ask for, once it is certain that they do not contradict each other.

    Raises:
        InputError: they do, or a click is no click.
    """
    prompts, hints = check_places(scene, options)
    options = fill_methods(options, device)
    if hints and (options.priors == "true" or options.depth != "multiview" or options.given.depth is not None):
        raise InputError("--contact and --same-depth place objects in depth of our own: leave out what takes other depth.")
    monocular = options.object_depth != "none" or options.given.object_depth is not None
    if monocular and (options.priors == "true" or options.depth != "multiview" or options.given.depth is not None):
        raise InputError("--object-depth places objects in depth of our own: leave out what takes other depth.")
    if options.object_depth != "none" and options.given.object_depth is not None:
        raise InputError(
            f"--object-depth {options.object_depth} and --given.object-depth are two sources of one thing: give one of them."
        )
    if prompts and options.given.masks is not None:
        raise InputError("--given.masks and --mask-click or --mask-box both say what moves: give one of them.")
    _require_images_as_they_are(options)
    return PriorRequest(scene, options, prompts, hints, device)


def use_truth(scene: Scene) -> None:
    """Make the truth of a rendered scene its priors, as ``Graph.read_truth`` does.

    Raises:
        InputError: the scene has no truth.
    """
    PRIORS.read_truth(PriorRequest(scene, PriorsOptions()))


def use_given(scene: Scene, given: GivenPriors, estimate: FlowEstimator = dis_estimator) -> dict[str, Stage]:
    """Read the user's files into the scene, as ``Graph.read_given`` does.

    Args:
        estimate: finds the flow between frames that are no neighbors, where depth must be fitted.

    Raises:
        InputError: a file cannot be used.
    """
    return PRIORS.read_given(PriorRequest(scene, PriorsOptions(given=given), estimate=estimate))


def _ready(request: PriorRequest, prior: Prior) -> Stage:
    """Return what computes a prior, with its networks loaded."""
    assert prior.kind.compute is not None
    return prior.kind.compute(request)


def _compute(
    request: PriorRequest, ready: dict[str, Stage], seconds: dict[str, float], after: Callable[[str, float], None] | None
) -> None:
    """Compute what is missing, every step of it.

    Args:
        ready: what computes a prior, where that is no longer to be chosen.
        seconds: gets the seconds of every prior, those of its steps among them.
    """
    scene = request.scene
    for prior in PRIORS:
        is_whole = prior.part_of is None
        if not (scene.prior(prior.name) is None if is_whole else prior.kind.is_due(request)):
            continue
        stage = ready.get(prior.name) or _ready(request, prior)
        with spinner(f"Computing {prior.name.replace('_', ' ')}"):
            took = _time(stage)
        seconds[prior.whole] = seconds.get(prior.whole, 0.0) + took
        if prior.has_record:
            report(f"{prior.name}: {_verdict(scene, prior.name)} ({took:.0f} s)")
        if is_whole and after is not None:
            after(prior.name, seconds[prior.name])


def check_places(scene: FrameNumbers, options: PriorsOptions) -> tuple[list[Prompt], list[Hint]]:
    """Clicks and boxes, and what is said of objects' distances.

    Raises:
        InputError: one of them is none, or not of this clip.
    """
    prompts = parse_prompts(options.mask_click, options.mask_box, scene, options.mask_negative)
    return prompts, parse_hints(options.contact, options.same_depth, scene)


def _require_images_as_they_are(options: PriorsOptions) -> None:
    """Refuse files that belong to the images as they came where these are to be straightened."""
    named = [name for name in options.given.named if name != "masks"]  # which are straightened with them
    if options.cameras.distortion == "radial" and (named or options.priors == "true"):
        files = f"--given.{named[0]}" if named else "--priors true"
        raise InputError(f"{files} belongs to the images as they came: leave out --cameras.distortion radial.")


def _report_what_is_kept(request: PriorRequest, stale: Collection[str]) -> None:
    there = [name for name in PRIORS.names if request.scene.prior(name) is not None]
    for names, what in (
        ([name for name in there if name in stale], "Computed anew, because other ones are asked for or follow"),
        ([name for name in there if name not in stale], "Already there and kept"),
    ):
        if names:
            report(f"{what}: {', '.join(f'{name} ({request.method(name)})' for name in names)}.")


def _time(stage: Stage) -> float:
    start = time.perf_counter()
    stage()
    return time.perf_counter() - start


def _verdict(scene: Scene, name: str) -> str:
    prior = scene.prior(name) or {}
    return str(prior.get("verdict", prior.get("method", "done")))
