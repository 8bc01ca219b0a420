"""Do all there is to do on a machine with a card, within a few minutes: each part in a process of its own, with a limit of its own.

What a part has found is in the result's file at once, so a part that fails, hangs or is killed costs its own figures and no
others. ``rehearse`` runs the same parts with tiny sizes in Triton's interpreter, on a machine without a card.
"""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, TypedDict

from flowsplat.common.files import make_folder, read_json, write_json
from flowsplat.common.files.json_file import Text
from flowsplat.common.process_control import end_group, group_options, pause_group
from flowsplat_benchmarks.scripts.cpu_parts.machine import commit
from flowsplat_benchmarks.scripts.cpu_parts.timing import tell

FOLDER = Path(__file__).parent
COMMAND = ("-m", "flowsplat_benchmarks.scripts.gpu")
"""What runs a part, behind the name of Python."""
SHOWN_LINES = 15
"""Lines of a failed part's output that are kept. Chosen by eye."""
GRACE_SECONDS = 3.0
"""Seconds for writing the last result, and for a part that is asked to stop. Chosen by eye."""


class FoundPart(TypedDict):
    """What became of a part."""

    outcome: Text
    figures: dict[str, Any]


class Found(TypedDict):
    """What a result's file has at least."""

    date: Text
    parts: dict[str, FoundPart]


@dataclass(frozen=True)
class GpuPart:
    """One thing to do.

    Attributes:
        name: by which it is chosen.
        weight: its share of the time, beside those of the parts that come after it.
        what: for the person who waits, and for the plan.
    """

    name: str
    weight: float
    what: str


PARTS = (
    GpuPart("kernels", 26, "every kernel against its oracle, values and gradients"),
    GpuPart("step", 12, "a training step, its kernels, and what other numbers of warps would make of it"),
    GpuPart("frames", 14, "frames a second of drawn Gaussians, stage by stage, with and without flow"),
    GpuPart("agreement", 10, "the same model after 200 steps on the CPU and on the card"),
    GpuPart("memory", 6, "milliseconds and memory of ever more Gaussians"),
    GpuPart("gsplat", 10, "the same images by gsplat's own kernels"),
    GpuPart("training", 20, "whole runs on the card, their quality beside the CPU's"),
    GpuPart("viewing", 6, "frames a second of what was trained, as a viewer draws it"),
)


def plan(minutes: float, parts: Sequence[GpuPart] = PARTS) -> list[tuple[GpuPart, float]]:
    """Each part and the seconds that it may take if all before it take theirs; what one leaves over, the others share."""
    total = sum(part.weight for part in parts)
    return [(part, 60 * minutes * part.weight / total) for part in parts]


def limit_of(index: int, left: float, parts: Sequence[GpuPart] = PARTS) -> float:
    """Return seconds for a part when so many are left for it and for all that come after it."""
    return max(left - GRACE_SECONDS, 0.0) * parts[index].weight / sum(part.weight for part in parts[index:])


def measure(
    out: Path, minutes: float, parts: Sequence[GpuPart] = PARTS, scenes: Sequence[Path] = (), rehearse: bool = False,
    broken: bool = False, keep: Path | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Do these parts, one after the other, and write ``out`` after each.

    Args:
        out: a JSON file; parts that it has and that are not done now stay in it, unless all are done.
        minutes: for everything together.
        parts: what to do.
        scenes: prepared scenes that are trained, too.
        rehearse: tiny, in Triton's interpreter.
        broken: the kernel that blends raises an error: to see that the rest still comes.
        keep: a folder for what the parts print, and for their runs; None = they are deleted.

    Raises:
        InputError: a file is there that is none of this, or it cannot be written.
    """
    began = time.monotonic()
    before = dict(read_json(out, Found)["parts"]) if len(parts) < len(PARTS) and out.exists() else {}
    about = {"date": datetime.now(timezone.utc).isoformat(timespec="seconds"), **commit(FOLDER)}
    result: dict[str, Any] = {
        "format": 2, **about,
        "minutes": minutes, "rehearsal": rehearse, "broken": broken, "parts": before,
    }  # fmt: skip
    with tempfile.TemporaryDirectory(prefix="flowsplat-gpu-") as temporary, _Compiler(not rehearse) as compiler:
        folder = Path(temporary) if keep is None else make_folder(keep)
        for index, part in enumerate(parts):
            compiler.go_on(part)
            limit = limit_of(index, 60 * minutes - (time.monotonic() - began), parts)
            tell(f"{time.monotonic() - began:5.0f} s  {part.name}: {part.what} (at most {limit:.0f} s)")
            # Parts of an earlier commit may stay beside this one: each says of which it is.
            result["parts"][part.name] = found = {**about, **_run(part, folder, limit, scenes, rehearse, broken)}
            if "machine" in found["figures"]:
                result["machine"] = found["figures"].pop("machine")
            result["seconds"] = round(time.monotonic() - began, 1)
            write_json(out, result)
            tell(f"         {found['outcome']} after {found['seconds']} s")
    return result


class _Compiler:
    """gsplat compiles its kernels when it is first imported, for minutes: beside what is not timed, and before it is needed."""

    def __init__(self, wanted: bool) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        if not wanted or importlib.util.find_spec("gsplat") is None:
            return
        import torch

        os.environ.setdefault("TORCH_CUDA_ARCH_LIST", ".".join(map(str, torch.cuda.get_device_capability())))
        program = "from flowsplat.common.process_control import give_way; give_way(15); import gsplat.cuda._backend"
        command = [sys.executable, "-c", program]
        quiet = subprocess.DEVNULL
        self._process = subprocess.Popen(command, stdout=quiet, stderr=quiet, **group_options())

    def go_on(self, part: GpuPart) -> None:
        """It runs beside the tests, stands still while something is timed, and ends before what it is for."""
        if self._process is not None and self._process.poll() is None:
            pause_group(self._process.pid, waits=part.name not in ("kernels", "gsplat"))

    def __enter__(self) -> _Compiler:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process is not None:
            end_group(self._process, GRACE_SECONDS)


def _run(part: GpuPart, folder: Path, limit: float, scenes: Sequence[Path], rehearse: bool, broken: bool) -> dict[str, Any]:
    """Return one part in its process; what it found until it ended or was ended."""
    figures, log = folder / f"{part.name}.json", folder / f"{part.name}.log"
    command = [sys.executable, *COMMAND, "--part", part.name, "--out", str(figures), "--work", str(folder)]
    command += ["--seconds", f"{limit:.0f}", *(word for scene in scenes for word in ("--scene", str(scene)))]
    command += ["--rehearse"] * rehearse + ["--broken"] * broken
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    if rehearse:
        # The interpreter has one state for all threads of a process.
        environment |= {"TRITON_INTERPRET": "1", "CUDA_VISIBLE_DEVICES": "", "NUMBA_NUM_THREADS": "1"}
    began = time.monotonic()
    with log.open("wb") as output:
        process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT, env=environment, **group_options())
        try:
            outcome = "done" if process.wait(limit) == 0 else f"failed with code {process.returncode}"
        except subprocess.TimeoutExpired:
            outcome = f"stopped: it took longer than {limit:.0f} s"
        finally:
            end_group(process, GRACE_SECONDS)
    found = json.loads(figures.read_text(encoding="utf-8")) if figures.exists() else {}
    result: dict[str, Any] = {"outcome": outcome, "seconds": round(time.monotonic() - began, 1), "figures": found}
    if outcome != "done":
        text = log.read_text(encoding="utf-8", errors="replace").replace(f"{FOLDER.parents[3]}{os.sep}", "")
        result["output"] = text.splitlines()[-SHOWN_LINES:]
        tell("\n".join(f"         | {line}" for line in result["output"]))
    return result
