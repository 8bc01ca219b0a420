"""A process that gives spoiled files to the readers, one after the other, and says what came of each on a line of JSON.

``python -m tests.fuzz.runner ORIGINALS WORK FIRST COUNT [READER]``: mutations FIRST, FIRST + 1, ... It is a process of its own, so
that whoever started it can end one that hangs, and so that one that dies is noticed.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import sys
import tempfile
import time
import traceback
from pathlib import Path
from typing import Any

import numpy as np

from flowsplat.common.errors import MAX_MESSAGE_CHARACTERS, InputError
from tests.fuzz.mutations import fresh, mutate
from tests.fuzz.readers import READERS, Reader

SLOWEST = 5.0
"""Seconds."""
MOST_MEMORY = 512
"""MiB above the process after its imports."""


def _memory(field: str) -> float:
    """MiB that /proc/self/status tells."""
    with open("/proc/self/status") as status:
        return next(int(line.split()[1]) / 1024 for line in status if line.startswith(field + ":"))


def _forget_peak() -> None:
    with open("/proc/self/clear_refs", "w") as file:
        file.write("5")


def _outside(folder: Path) -> list[str]:
    """What lies beside the folder that a reader was given, or two folders above it; it may write ``ingested``."""
    here, above = folder.parent, folder.parent.parent
    beside = {path.name for path in here.iterdir()} - {folder.name, "ingested"}
    return sorted(beside | {path.name for path in above.iterdir()} - {here.name})


def _told(error: InputError) -> str | None:
    """What is wrong with a message; None where it is one line."""
    text = str(error)
    return (
        None
        if text.isprintable() and 0 < len(text) <= MAX_MESSAGE_CHARACTERS + 100
        else f"a message that is no line: {text[:200]!r}"
    )


@contextlib.contextmanager
def _listening() -> Any:
    """What native code writes to stderr, past Python."""
    kept = os.dup(2)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 2)
        heard: list[str] = []
        try:
            with contextlib.redirect_stderr(io.StringIO()) as python, contextlib.redirect_stdout(io.StringIO()):
                yield heard
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            file.seek(0)
            heard.append(file.read(500).decode(errors="replace"))
            heard.append(python.getvalue())


def one(reader: Reader, originals: Path, work: Path, rng: np.random.Generator | None) -> dict[str, Any]:
    """Spoil one file (or none, without ``rng``) and read it."""
    folder = fresh(originals / reader.originals, work / "in" / "here" / Path(reader.originals).name)
    files = sorted({path for pattern in reader.files for path in folder.glob(pattern) if path.is_file()})
    changed, how = None, "as it is"
    if rng is not None:
        changed = files[int(rng.integers(len(files)))]
        how = mutate(rng, changed)
    failed, outcome = None, "read"
    _forget_peak()
    started, cpu = time.perf_counter(), time.process_time()
    with _listening() as heard:
        try:
            reader.read(folder)
        except InputError as error:
            outcome, failed = "refused", _told(error)
        except Exception:
            failed = traceback.format_exc()
    seconds = min(time.perf_counter() - started, time.process_time() - cpu)
    peak = _memory("VmHWM")
    if failed is None and heard[0]:
        failed = f"chatter: {heard[0]!r}"
    elif failed is None and ("Warning" in heard[1] or "Traceback" in heard[1]):
        failed = f"warnings: {heard[1][:500]!r}"
    if failed is None and (escaped := _outside(folder)):
        failed = f"wrote outside: {escaped[:3]}"
    name = None if changed is None else str(changed.relative_to(folder))
    return {"file": name, "how": how, "outcome": outcome, "failed": failed, "seconds": seconds, "peak": peak}


def run(originals: Path, work: Path, first: int, count: int, only: str | None) -> None:
    """Write a line before, and one after each mutation."""
    readers = [reader for reader in READERS if only is None or reader.name == only]
    base = _memory("VmRSS")
    for reader in readers if first == 0 else ():
        found = one(reader, originals, work, None)
        print(json.dumps({"reader": reader.name, "number": -1, **found, "peak": 0.0}), flush=True)
    for number in range(first, first + count):
        reader = readers[number % len(readers)]
        print(json.dumps({"begins": number, "reader": reader.name}), flush=True)
        found = one(reader, originals, work, np.random.default_rng([number, 25]))
        if found["seconds"] > SLOWEST:  # Numba may have compiled what it then keeps: what takes as long again is slow
            found = one(reader, originals, work, np.random.default_rng([number, 25]))
        found["peak"] -= base
        if found["failed"] is None and found["seconds"] > SLOWEST:
            found["failed"] = f"{found['seconds']:.1f} s"
        if found["failed"] is None and found["peak"] > MOST_MEMORY:
            found["failed"] = f"{found['peak']:.0f} MiB"
        print(json.dumps({"reader": reader.name, "number": number, **found}), flush=True)


if __name__ == "__main__":
    run(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]), sys.argv[5] if len(sys.argv) > 5 else None)
