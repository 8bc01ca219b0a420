"""The engine that options name."""

from __future__ import annotations

from pathlib import Path

from flowsplat.batch.embedded import Embedded
from flowsplat.batch.on_ray import OnRay
from flowsplat.batch.options import EngineOptions
from flowsplat.batch.work import Engine
from flowsplat.common.devices import pick_device
from flowsplat.common.files import make_folder


def engine_of(
    options: EngineOptions, logs: Path, device: str, workers: int | None = None, memory: float | None = None, threads: int = 1
) -> Engine:
    """Make it.

    Args:
        logs: folder for what each piece of work says, ``ID.log``.
        device: on which the work computes, as ``--device`` has it: a GPU does one at a time, and Ray is asked for one.
        workers: at a time; None = as many as there is room for.
        memory: GiB for all of them together; None = most of what is free. Ray knows the memory of its machines.
        threads: of each; one with Ray.

    Raises:
        InputError: a number is none, the folder cannot be made, or there is no Ray.
    """
    make_folder(logs)
    if options.engine == "ray":
        return OnRay(logs.absolute(), workers, options.ray_address, 1 if device == "cuda" else 0)
    if workers is None and pick_device(device).type == "cuda":
        workers = 1
    return Embedded(logs, workers, memory, threads)
