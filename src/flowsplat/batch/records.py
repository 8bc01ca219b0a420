"""Record the state of every piece of work of a batch in ``OUT/.batch``; any number of processes read and write it.

    done/ID.json, failed/ID.json, refused/ID.json    ended, with the result
    open/ID.json                                     something went wrong, and there is to be another attempt
    claims/ID.NUMBER                                 somebody works on attempt NUMBER (``common.files.Claims``)
    logs/ID.log, thumbs/ID.jpg, plan.json            what the run said, its image in the page, what the batch is of

Names of files tell how far the batch is: who looks for work lists folders, and reads no files.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta
from typing_extensions import NotRequired, TypedDict

from flowsplat.common.errors import InputError
from flowsplat.common.files import make_folder, read_json, write_json
from flowsplat.common.files.json_file import Count, Text

FOLDER = ".batch"
"""In OUT; no id begins with a dot."""
END_STATES = ("done", "failed", "refused")
STATES = (*END_STATES, "open")
VERSION = 1

MAX_CRASH_RESTARTS = 3
"""How often a run that crashed or was killed is continued. Chosen by eye."""
MAX_WORKER_LOSSES = 10
"""How often one is continued whose whole worker died: a machine that was taken away says little about the clip. Chosen by eye."""

How = Literal["done", "refused", "crashed", "outgrew", "busy", "stopped", "lost", "unwritable"]
"""How an attempt ended: it is done; its input cannot be used; it crashed or was killed; it took more memory than it may; somebody
else has its folder; it was asked to stop; its machine was lost; nothing can be written."""


class RecordFile(TypedDict):
    """A piece of work; more may stand there."""

    version: Count
    id: Text
    key: Text
    state: Literal["done", "failed", "refused", "open"]
    attempt: Count
    crashes: Count
    orphaned: Count
    fewer: bool
    reason: Text
    seconds: Annotated[float, Meta(ge=0, le=1e9)]
    peak_memory_gib: NotRequired[float | None]
    result: dict[str, Any]


Record = Mapping[str, Any]


@dataclass(frozen=True)
class Outcome:
    """How an attempt ended.

    Attributes:
        how: see ``How``.
        reason: in a sentence, where it is not done.
        result: what the work returned.
        seconds: it took.
        peak_memory_gib: of its process; None where nobody knows.
    """

    how: How
    reason: str = ""
    result: Mapping[str, Any] | None = None
    seconds: float = 0.0
    peak_memory_gib: float | None = None


def after_attempt(before: Record | None, name: str, key: str, number: int, outcome: Outcome) -> dict[str, Any]:
    """Return the record of a piece of work after attempt ``number``: whether it has ended, or there is to be another one.

    What cannot be used is never tried again. A crash is continued ``MAX_CRASH_RESTARTS`` times, an attempt that outgrew its memory
    once more, with fewer Gaussians. Being stopped, or in somebody's way, counts for nothing.
    """
    known = before if before is not None and before["key"] == key and before["state"] == "open" else {}
    crashes, fewer, state = known.get("crashes", 0), known.get("fewer", False), "open"
    # Numbers in between are of workers that died with their claim.
    missing = number - 1 - before["attempt"] if before is not None else number - 1
    orphaned = known.get("orphaned", 0) + max(missing, 0) + (outcome.how == "lost")
    reason = outcome.reason
    if outcome.how in ("done", "refused"):
        state = outcome.how
    elif outcome.how == "crashed":
        crashes += 1
        if crashes > MAX_CRASH_RESTARTS:
            state = "failed"
    elif outcome.how == "outgrew":
        state, fewer = ("failed", True) if fewer else ("open", True)
    if state == "open" and orphaned > MAX_WORKER_LOSSES:
        state, reason = "failed", f"its worker died {orphaned} times"
    earlier, peak = known.get("seconds", 0.0), [outcome.peak_memory_gib, known.get("peak_memory_gib")]
    return {
        "version": VERSION, "id": name, "key": key, "state": state, "attempt": number, "crashes": crashes, "orphaned": orphaned,
        "fewer": fewer, "reason": reason, "seconds": round(earlier + outcome.seconds, 2),
        "peak_memory_gib": max((value for value in peak if value is not None), default=None), "result": dict(outcome.result or {}),
    }  # fmt: skip


class Records:
    """The records of a batch."""

    def __init__(self, out: Path):
        """
        Raises:
            InputError: the folders cannot be made.
        """
        self.folder = Path(out) / FOLDER
        for state in STATES:
            make_folder(self.folder / state)

    def states(self) -> dict[str, str]:
        """Return the state of every piece of work that has a record, by names of files alone."""
        found: dict[str, str] = {}
        for state in reversed(STATES):  # what has ended counts where a process died between writing and deleting
            with contextlib.suppress(OSError):
                for name in os.listdir(self.folder / state):
                    if name.endswith(".json") and not name.startswith("."):
                        found[name[:-5]] = state
        return found

    def read(self, name: str) -> Record | None:
        """Return the latest record of a piece of work; None where there is none, or none that can be read."""
        latest: Record | None = None
        for state in STATES:
            path = self.folder / state / f"{name}.json"
            if not path.exists():
                continue
            try:
                value = read_json(path, RecordFile)
            except InputError:  # the work itself knows what is done of it
                continue
            if latest is None or value["attempt"] > latest["attempt"]:
                latest = value
        return latest

    def write(self, record: Record) -> None:
        """Put a record in the place of the earlier one.

        Raises:
            WritingError: it cannot be written.
        """
        name, state = record["id"], record["state"]
        write_json(self.folder / state / f"{name}.json", record)
        for other in STATES:
            if other != state:
                with contextlib.suppress(OSError):
                    (self.folder / other / f"{name}.json").unlink()
