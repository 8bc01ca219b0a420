"""The networks that ``--priors learned`` and ``auto`` take: which are there, what fetching others brings, how long they take."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from flowsplat.common.durations import format_duration
from flowsplat.common.errors import describe_install
from flowsplat.common.threads import thread_count
from flowsplat.priors.learned.raft import MIN_SIDE
from flowsplat.priors.learned.weights import ModelOptions, looks_like_path, network_device

if TYPE_CHECKING:
    from flowsplat.priors.options import PriorsOptions


@dataclass(frozen=True)
class Network:
    """What a network needs.

    Attributes:
        packages: that must be installed.
        megabytes: of the weights that ``ModelOptions`` names where it is left as it is.
        license: of these weights.
        seconds: of one thread for a training frame: flow of 854 x 480 pixels, an object's mask once, depth.
        per_pixel: whether the time grows with the number of pixels; others give their networks images of one size.
    """

    packages: tuple[str, ...]
    megabytes: int
    license: str
    seconds: float
    per_pixel: bool


NETWORKS: Mapping[tuple[str, str], Network] = {
    ("flow", "raft"): Network(("torchvision",), 20, "BSD-3-Clause", 50.0, True),
    ("masks", "edgetam"): Network(("transformers", "torchvision", "timm"), 56, "Apache-2.0", 2.5, False),
    ("masks", "sam2"): Network(("transformers", "torchvision"), 156, "Apache-2.0", 7.5, False),
    ("object_depth", "depth-anything"): Network(("transformers", "torchvision"), 99, "Apache-2.0", 2.8, False),
}
"""By prior and method. Megabytes are four for a million weights, which were counted; seconds are those of the processor with random
weights on a Xeon with AVX-512 that others used, too: of flow five pairs of 10.2 s, as many as a frame of a random world took (10
frames, still camera), two of them for the flow itself and the others for masks."""

SMALL_SHARE = 0.27
"""Of RAFT's time that the small network takes (2.7 of 10.2 s a pair, measured as above)."""

MAX_SMALL_BYTES = 10_000_000
"""Of a file with the small network's weights, which are 4 MB; those of the large one are 20 MB."""

TIMED_PIXELS = 854 * 480
"""At which ``Network.seconds`` of flow was measured."""

OWN_METHODS = {"flow": "dis", "masks": "motion", "depth": "multiview", "object_depth": "none"}
"""Methods without weights, by the fields of ``PriorsOptions``."""


def list_candidates(prior: str, device: torch.device) -> list[str]:
    """Return the networks for a prior, the preferred one first: on a CPU EdgeTAM, which takes a third of SAM 2's time."""
    found = [method for of, method in NETWORKS if of == prior]
    return found if device.type == "cpu" else [method for method in found if method != "edgetam"]


def is_installed(network: Network, method: str) -> bool:
    """Return whether the packages of a network are there, and transformers is recent enough to have it."""
    if any(importlib.util.find_spec(package) is None for package in network.packages):
        return False
    return method != "edgetam" or importlib.util.find_spec("transformers.models.edgetam_video") is not None


def has_weights(method: str, models: ModelOptions) -> bool:
    """Return whether the weights of a network lie in the user's cache, or are the user's; nothing is fetched."""
    source = str(getattr(models, method.replace("-", "_")))
    if method == "raft":
        if source not in ("large", "small"):
            return os.path.isfile(source)
        from torchvision.models import optical_flow

        weights = optical_flow.Raft_Large_Weights if source == "large" else optical_flow.Raft_Small_Weights
        return (Path(torch.hub.get_dir()) / "checkpoints" / Path(weights.DEFAULT.url).name).is_file()
    if looks_like_path(source):
        return os.path.isdir(source)
    from huggingface_hub import try_to_load_from_cache

    return all(isinstance(try_to_load_from_cache(source, name), str) for name in ("config.json", "model.safetensors"))


def fill_methods(options: PriorsOptions, device: str) -> PriorsOptions:
    """Return options that name the method of every prior: where they name none, as ``--priors`` says.

    ``learned`` takes the first network of each prior that is there, else the first that is installed, else the first: a line then
    says what it lacks. ``auto`` takes the first that is there, else the method without weights.
    """
    chosen: dict[str, Any] = {}
    for prior, own in OWN_METHODS.items():
        if getattr(options, prior) is not None:
            continue
        candidates = list_candidates(prior, network_device(device)) if options.priors in ("learned", "auto") else []
        if prior == "object_depth" and not _places_objects(options):
            candidates = []
        installed = [method for method in candidates if is_installed(NETWORKS[prior, method], method)]
        there = [method for method in installed if has_weights(method, options.models)]
        wanted = there if options.priors == "auto" else [*there, *installed, *candidates]
        chosen[prior] = next(iter(wanted), own)
    return replace(options, **chosen)


def _places_objects(options: PriorsOptions) -> bool:
    """Return whether depth is of our own, and nothing is given that tells of objects."""
    return options.depth in (None, OWN_METHODS["depth"]) and options.given.depth is None and options.given.object_depth is None


def describe_choice(asked: PriorsOptions, filled: PriorsOptions, device: str) -> str:
    """Return one line: which methods ``--priors auto`` took, and what fetching the networks that it lacks would bring."""
    parts = [f"{_name(prior)} by {getattr(filled, prior)}" for prior in OWN_METHODS]
    lacking = [
        method
        for prior, own in OWN_METHODS.items()
        if getattr(asked, prior) is None and getattr(filled, prior) == own
        for method in list_candidates(prior, network_device(device))[:1]
    ]
    line = f"--priors auto: {', '.join(parts)}."
    if lacking:
        brings = [f"{method} ({each.megabytes} MB, {each.license})" for (_, method), each in NETWORKS.items() if method in lacking]
        line += f" --priors learned would fetch {' and '.join(brings)}"
        needed = {package for (_, method), each in NETWORKS.items() if method in lacking for package in each.packages}
        missing = sorted(package for package in needed if importlib.util.find_spec(package) is None)
        line += f", once there is {', '.join(missing)} ({describe_install('learned')})." if missing else "."
    return line


def _name(prior: str) -> str:
    return prior.replace("_", " ")


def _is_small_raft(source: str) -> bool:
    return source == "small" or (os.path.isfile(source) and os.path.getsize(source) < MAX_SMALL_BYTES)


def describe_time(filled: PriorsOptions, priors: Sequence[str], frames: int, size: tuple[int, int], device: str) -> str | None:
    """Return one line: how long networks take on a CPU; None where none computes there.

    Args:
        priors: those that will be computed.
        frames: training frames.
        size: width and height of one.
    """
    if network_device(device).type != "cpu":
        return None
    parts, total = [], 0.0
    pixels = size[0] * size[1] * max(1.0, MIN_SIDE / min(size)) ** 2
    for prior in (*priors, *(["object_depth"] if "depth" in priors else [])):
        network = NETWORKS.get((prior, str(getattr(filled, prior, None))))
        if network is None:
            continue
        seconds = network.seconds * (pixels / TIMED_PIXELS if network.per_pixel else 1.0) / thread_count()
        if prior == "flow" and _is_small_raft(filled.models.raft):
            seconds *= SMALL_SHARE
        parts.append(f"{_name(prior)} by {getattr(filled, prior)} {seconds:.1f} s a frame")
        total += seconds * frames
    if not parts:
        return None
    return f"Networks on the CPU: about {format_duration(total)} or more for {frames} frames ({', '.join(parts)})."
