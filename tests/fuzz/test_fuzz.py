"""Spoiled files of every kind: each is read or refused in one line, soon, in little memory, and nothing else happens.

200 mutations in ``make test``, 3,000 in ``make test-all``; ``pytest tests/fuzz --fuzz 100000`` tries as many, and writes the
figures by reader into ``fuzz.json`` where it was called.
"""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.fuzz.readers import make_originals
from tests.marks import slow

FEW, MANY = 200, 1500
PATIENCE = 90.0
"""Seconds without a word after which a process hangs; slower ones than ``SLOWEST`` are failures of their own."""
pytestmark = pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="the peak of memory is measured on Linux only")


def told_by(arguments: list[str]) -> Iterator[dict[str, Any]]:
    """What a runner says, until it ends, dies or hangs; the last word says so where it was not the end."""
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.fuzz.runner", *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        cwd=Path(__file__).parents[2], env={**os.environ, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"},
    )  # fmt: skip
    lines: queue.Queue[str | None] = queue.Queue()
    assert process.stdout is not None

    def listen() -> None:
        for line in process.stdout or ():
            lines.put(line)
        lines.put(None)

    threading.Thread(target=listen, daemon=True).start()
    try:
        while (line := lines.get(timeout=PATIENCE)) is not None:
            yield json.loads(line)
        process.wait()
        if process.returncode:
            yield {"died": f"exit code {process.returncode}: {process.stderr.read()[-2000:] if process.stderr else ''}"}
    except queue.Empty:
        yield {"died": "it hung"}
    finally:
        process.kill()
        process.wait()


def results(originals: Path, work: Path, first: int, count: int) -> list[dict[str, Any]]:
    """Of these mutations; a runner that dies is a failure of the one at work, and another one goes on behind it."""
    found: list[dict[str, Any]] = []
    end, begun = first + count, {"begins": first - 1, "reader": "start"}
    while first < end:
        last = end
        for told in told_by([str(originals), str(work), str(first), str(end - first)]):
            if "begins" in told:
                begun = told
            elif "died" in told:
                found.append({**begun, "number": begun["begins"], "failed": told["died"], "how": "", "file": ""})
                last = begun["begins"] + 1
                assert begun["begins"] >= first, told["died"]
            else:
                found.append(told)
        first = last
    return found


def figures(found: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """By reader: tried, read, refused, failed, the longest in seconds, the largest in MiB."""
    table: dict[str, dict[str, float]] = {}
    for each in found:
        row = table.setdefault(each["reader"], dict.fromkeys(("tried", "read", "refused", "failed", "seconds", "MiB"), 0))
        row["tried"] += 1
        row["failed" if each["failed"] else each["outcome"]] += 1
        row["seconds"] = max(row["seconds"], round(each.get("seconds", 0), 2))
        row["MiB"] = max(row["MiB"], round(each.get("peak", 0)))
    return table


@pytest.fixture(scope="module")
def originals(tmp_path_factory) -> Path:
    """One of every kind; each mutation is made of a copy."""
    folder = tmp_path_factory.mktemp("fuzz") / "originals"
    make_originals(folder)
    return folder


@pytest.mark.parametrize(("first", "count"), [(0, FEW), slow(FEW, MANY - FEW)])
def test_spoiled_files(originals, tmp_path, request, first, count):
    wanted = request.config.getoption("--fuzz")
    if wanted:
        first, count = (0, wanted) if first else pytest.skip("all are tried at once")
    found = results(originals, tmp_path / "work", first, count)
    whole = [each for each in found if each["number"] < 0]
    assert [each for each in whole if each["outcome"] != "read" or each["failed"]] == []
    spoiled = [each for each in found if each["number"] >= 0]
    if wanted:
        failures = [each for each in spoiled if each["failed"]]
        Path("fuzz.json").write_text(json.dumps({"readers": figures(spoiled), "failures": failures}, indent=1))
    failed = ["{number} {reader}: {file} {how}: {failed}".format(**each) for each in spoiled if each["failed"]]
    assert len(spoiled) == count
    assert not failed, "\n".join(failed[:20])
    assert sum(each["outcome"] == "refused" for each in spoiled) > len(spoiled) / 4, "hardly anything was spoiled"
