"""Define the options of a batch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True)
class EngineOptions:
    """What does the work, and which part of it."""

    engine: Literal["embedded", "ray"] = "embedded"
    """embedded (processes of this machine) or ray (those of a Ray cluster, which needs the extra ``ray``)."""
    shard: str | None = None
    """Only this part of the work: i/n, from 1/n to n/n. Tasks of a SLURM array know their part by themselves."""
    ray_address: str | None = None
    """With --engine ray: the cluster to join, as ``ray.init`` takes it (auto, or host:6379); the default is one that is started
    here."""


@dataclass(frozen=True)
class BatchOptions(EngineOptions):
    """How a batch is done: what does it, which part of it, and what is done once more."""

    workers: int | None = None
    """How many clips at a time, each in a process with one thread; the default is one for every core, one in all on a GPU, and as
    many as there are resources with --engine ray."""
    memory: float | None = None
    """GiB for all of them together; the default is nine tenths of what is free in the beginning."""
    only: tuple[str, ...] = ()
    """Only the clips of these ids."""
    retry: Annotated[tuple[Literal["failed", "refused", "done"], ...], tyro.conf.arg(metavar="STATE [...]")] = ()
    """Try once more what has ended so: failed (crashed too often), refused (its input could not be used) or done."""
    status: bool = False
    """Only show how far it is, and write OUT/batch.json and OUT/index.html anew."""
    upload: str | None = None
    """Copy every run that is done to this folder, too: a URL as fsspec takes it (s3://bucket/folder, gs://..., file:///...), which
    needs the extra ``upload``. The last file of a run is manifest.json: where it is, all of it is there."""
