"""A whole batch, from what was given to the page."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from typing_extensions import TypedDict

from flowsplat.batch.clips import BatchClip, find_clips, of_shard
from flowsplat.batch.engines import engine_of
from flowsplat.batch.options import BatchOptions
from flowsplat.batch.page import NAME, summary, write_results
from flowsplat.batch.records import FOLDER, Records
from flowsplat.batch.run_clip import clip_job
from flowsplat.batch.scheduler import Scheduler
from flowsplat.batch.table import Progress
from flowsplat.batch.upload import open_url
from flowsplat.batch.warming import compile_kernels
from flowsplat.batch.work import Engine
from flowsplat.common.errors import InputError
from flowsplat.common.files import Claims, make_folder, read_json, write_json
from flowsplat.common.files.json_file import Count, Text
from flowsplat.common.progress import report
from flowsplat.common.settings import from_plain, to_plain
from flowsplat.pipeline.config import RunConfig

PLAN = "plan.json"
PAGE = "page"
"""The claim of who writes the page."""
PAGE_INTERVAL = 60.0
"""Seconds, at least, between two pages. Chosen by eye."""
PAGE_INTERVAL_FACTOR = 20
"""Times as long as writing the page took that pass before the next one, so that pages take a twentieth of the time at most.
Chosen by eye."""


class PlanFile(TypedDict):
    """What a batch is of: what the last command gave that named inputs."""

    version: Count
    inputs: list[Text]
    config: dict[str, Any]


def read_plan(out: Path) -> tuple[list[Path], RunConfig] | None:
    """Return the inputs and settings of the batch in a folder; None where there is none.

    Raises:
        InputError: it is damaged.
    """
    path = Path(out) / FOLDER / PLAN
    if not path.exists():
        return None
    value = read_json(path, PlanFile)
    return [Path(each) for each in value["inputs"]], from_plain(RunConfig, value["config"])


def run_batch(
    inputs: Sequence[Path], out: Path | None, config: RunConfig | None = None, options: BatchOptions | None = None
) -> bool:
    """Run every clip of a batch in ``OUT/<id>``; called again, it continues.

    Any number of processes may be called on one OUT at the same time: none is at work on a clip that another one has.

    Args:
        inputs: as ``find_clips``; or OUT alone, of a batch that was begun before.
        out: folder of the batch; None = it stands in ``inputs``.
        config: settings of all runs; None = those that the batch was begun with, or the default preset.
        options: how.

    Returns:
        whether all clips (of this shard, or those of ``only``) are done.

    Raises:
        InputError: inputs or options cannot be used, or nothing can be written.
    """
    options = options or BatchOptions()
    inputs = [Path(source) for source in inputs]
    if out is None:
        if len(inputs) != 1 or read_plan(inputs[0]) is None:
            raise InputError("Where shall it be written? Give -o OUT; OUT alone continues a batch that was begun there.")
        out, inputs = inputs[0], []
    stored = read_plan(out)
    if not inputs and stored is None:
        raise InputError(f"{out} holds no batch: give clips, folders of them, or lists.")
    config = config or (stored[1] if stored else RunConfig())
    given = inputs or (stored[0] if stored else [])
    clips = find_clips(given, config, out)
    chosen = _choose_clips(clips, options)
    if options.status:
        return _status(out, clips, chosen)
    records = Records(make_folder(out))
    plan = {"version": 1, "inputs": [os.path.abspath(each) for each in given], "config": to_plain(config)}
    write_json(records.folder / PLAN, plan)
    if options.upload is not None:
        open_url(options.upload)  # what is wrong with it is said now
    if options.engine == "ray" and options.memory is not None:
        raise InputError("--memory is for --engine embedded: Ray knows the memory of its machines.")
    engine = engine_of(options, out / FOLDER / "logs", config.device, options.workers, options.memory)
    if options.engine == "embedded":
        compile_kernels(config.device)
    return _work(out, clips, chosen, records, engine, options)


def _choose_clips(clips: Sequence[BatchClip], options: BatchOptions) -> list[BatchClip]:
    """Return the clips that this process is to see to."""
    known = {clip.id for clip in clips}
    for name in options.only:
        if name not in known:
            raise InputError(f"--only {name}: there is no clip of that id; flowsplat batch OUT --status names them.")
    mine = of_shard([clip.id for clip in clips], options.shard, os.environ)
    return [clip for clip in clips if clip.id in mine and (not options.only or clip.id in options.only)]


def _work(
    out: Path, clips: Sequence[BatchClip], chosen: Sequence[BatchClip], records: Records, engine: Engine, options: BatchOptions
) -> bool:
    names = {clip.id: str(clip.path) for clip in clips}
    page = _Page(out, records, names)
    jobs = [clip_job(clip, out.absolute(), options.upload) for clip in chosen]
    if len(chosen) < len(clips):
        report(f"{len(chosen)} of {len(clips)} clips are this process's.")
    claims = Claims(records.folder / "claims")
    with Progress() as progress:

        def shown(scheduler: Scheduler) -> None:
            progress.show(scheduler)
            page.refresh()

        scheduler = Scheduler(jobs, engine, records, claims, options.retry, shown)
        if scheduler.ended:
            report(f"{len(scheduler.ended)} of {scheduler.total} clips have ended before: {_format_counts(scheduler.counts)}.")
        try:
            ended = scheduler.run()
        finally:
            page.finish()
    for name, state in ended.items():
        if state != "done":
            record = records.read(name)
            report(f"{name} was {state}: {record['reason'] if record else 'its record is gone'}")
    report(summary(Counter(ended.values())))
    report(f"Look at {out / NAME}")
    return all(state == "done" for state in ended.values())


def _format_counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {state}" for state, count in sorted(counts.items()))


class _Page:
    """Keeps ``batch.json`` and ``index.html`` new; of all who work on a batch one writes at a time."""

    def __init__(self, out: Path, records: Records, names: Mapping[str, str]):
        self._out, self._records, self._names = out, records, names
        self._next, self._number = time.monotonic() + PAGE_INTERVAL / 10, 0
        self._writing = Claims(records.folder / "pages")
        self._claims = Claims(records.folder / "claims")

    def refresh(self) -> None:
        """Write them where it is time and nobody else does."""
        if time.monotonic() < self._next:
            return
        began = time.monotonic()
        if self._take():
            try:
                write_results(self._out, self._records, self._names, self._describe_running())
            except InputError as error:  # the disk is full: who writes a record says so
                report(str(error))
            finally:
                self._writing.release(PAGE)
        self._next = time.monotonic() + max(PAGE_INTERVAL, PAGE_INTERVAL_FACTOR * (time.monotonic() - began))

    def finish(self) -> None:
        """Write them once more, after whoever writes now."""
        self._claims.close()
        ends = time.monotonic() + PAGE_INTERVAL
        while not (mine := self._take()) and time.monotonic() < ends:
            time.sleep(0.2)
        try:
            write_results(self._out, self._records, self._names, self._describe_running())
        except InputError as error:
            report(str(error))
        finally:
            if mine:
                self._writing.release(PAGE)
            self._writing.close()

    def _take(self) -> bool:
        number = self._writing.newest().get(PAGE, 0)
        if number and not self._writing.is_dead(PAGE, number):
            return False
        try:
            return self._writing.take(PAGE, number + 1)
        except InputError:
            return False

    def _describe_running(self) -> dict[str, str]:
        return list_running(self._claims)


def list_running(claims: Claims) -> dict[str, str]:
    """Return who works on what, by id."""
    return {name: claims.who(name, number) for name, number in claims.newest().items() if not claims.is_dead(name, number)}


def _status(out: Path, clips: Sequence[BatchClip], chosen: Collection[BatchClip]) -> bool:
    """Say how far a batch is, and write its results anew."""
    records = Records(out)
    claims = Claims(records.folder / "claims")
    try:
        entries = write_results(out, records, {clip.id: str(clip.path) for clip in clips}, list_running(claims))
    finally:
        claims.close()
    names = {clip.id for clip in chosen}
    found = [entry for entry in entries if entry["id"] in names]
    for entry in found:
        if entry["state"] in ("failed", "refused", "open", "running"):
            why = entry.get("worker") if entry["state"] == "running" else entry["reason"]
            report(f"{entry['id']}: {entry['state']}" + (f", {why}" if why else ""))
    report(summary(Counter(entry["state"] for entry in found)))
    report(f"Look at {out / NAME}")
    return all(entry["state"] == "done" for entry in found)
