"""Measure what a first run compiles: ``python -m flowsplat_benchmarks.scripts.compiling``, on a small rendered clip, with an empty
cache.

Prints every kernel with the processor seconds that it took to compile, those of what it calls left out. What a second process
compiles ahead is not among them: ``--alone`` lets the run compile it. ``--warm`` runs once more with the cache that is there then.
``--write`` makes the list anew that says what is compiled ahead (``src/flowsplat/pipeline/signatures.json``).
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from flowsplat.common.files import write_text
from flowsplat.pipeline.compiling import SIGNATURES
from flowsplat_benchmarks.scripts.cpu_parts.timing import tell

_RUN = """
import json, sys, threading, time
began = time.perf_counter()
from numba.core import event, types
from flowsplat.common.kernel_cache import KernelCache
found, kernels, own = [], [], threading.local()

def notation(kind):
    if isinstance(kind, types.Array):
        dims = [":"] * (kind.ndim - 1) + ["::1" if kind.layout == "C" else ":"]
        return f"{notation(kind.dtype)}[{', '.join(dims)}]"
    if isinstance(kind, types.UniTuple):
        return f"UniTuple({notation(kind.dtype)}, {kind.count})"
    return {"bool": "boolean", "Tuple()": "Tuple(())"}.get(str(kind), str(kind))

class Listener(event.Listener):
    def on_start(self, given):
        own.waiting = getattr(own, "waiting", [])
        own.waiting.append([time.thread_time(), 0.0])
    def on_end(self, given):
        since, inside = own.waiting.pop()
        took = time.thread_time() - since
        if own.waiting:
            own.waiting[-1][1] += took
        dispatcher = given.data["dispatcher"]
        function = dispatcher.py_func
        found.append((function.__module__ + "." + function.__name__, took - inside, time.perf_counter() - began))
        if not own.waiting and isinstance(dispatcher._cache, KernelCache):
            kernels.append((function.__module__.removeprefix("flowsplat.") + "." + function.__name__, dispatcher))

event.register("numba:compile", Listener())
from dataclasses import replace
from pathlib import Path
from flowsplat.pipeline.config import RunConfig
from flowsplat.pipeline.stages import run
from flowsplat.scenes.synthetic import SyntheticScene, write_synthetic_video
if sys.argv[3]:
    from flowsplat.pipeline import compiling
    compiling.is_noted = lambda *_: True
clip, out = Path(sys.argv[1]) / "clip.mp4", Path(sys.argv[1]) / sys.argv[2]
if not clip.exists():
    write_synthetic_video(clip, SyntheticScene(width=160, height=90, frames=24))
config = RunConfig()
run(clip, out, replace(config, train=replace(config.train, iterations=60)))
seconds, listed = time.perf_counter() - began, {}
for name, dispatcher in kernels:
    for signature in dispatcher.signatures:
        listed[name, ", ".join(map(notation, signature))] = None
print(json.dumps([seconds, found, list(listed)]))
"""


Compiled = tuple[str, float, float]
"""Name of a function, seconds that it took to compile, and seconds from the start until that was done."""


def first_run(folder: Path, name: str, cache: Path, alone: bool) -> tuple[float, list[Compiled], list[tuple[str, str]]]:
    """Return seconds of a whole run in a fresh process, what it compiled, and its kernels with the types of their arguments."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache), "FLOWSPLAT_CACHE": str(cache / "flowsplat")}
    command = [sys.executable, "-c", _RUN, str(folder), name, "alone" if alone else ""]
    told = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE, text=True).stdout
    total, found, listed = json.loads(told.splitlines()[-1])
    return total, found, listed


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--warm", action="store_true", help="and once more with a full cache")
    parser.add_argument("--alone", action="store_true", help="no second process that compiles")
    parser.add_argument("--write", action="store_true", help="write the list of what is compiled ahead")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        began = time.perf_counter()
        total, found, listed = first_run(folder, "cold", folder / "cache", options.alone or options.write)
        if options.write:
            lines = ",\n".join(f" {json.dumps(entry)}" for entry in listed)
            write_text(SIGNATURES, f"[\n{lines}\n]\n")
        tell(f"{time.perf_counter() - began:.1f} s")
        seconds: dict[str, list[float]] = {}
        for name, one, _ in found:
            seconds.setdefault(name, []).append(one)
        print(f"{total:.1f} s in all, {sum(map(sum, seconds.values())):.1f} s of them compiling {len(found)} functions.\n")
        print("| function | versions | seconds |\n| --- | --- | --- |")
        for name, took in sorted(seconds.items(), key=lambda item: -sum(item[1])):
            if sum(took) >= 0.1:
                print(f"| {name.removeprefix('flowsplat.')} | {len(took)} | {sum(took):.2f} |")
        if options.warm:
            total, found, _ = first_run(folder, "warm", folder / "cache", options.alone)
            print(f"\nWith what is compiled: {total:.1f} s in all, {sum(took for _, took, _ in found):.1f} s of them compiling.")


if __name__ == "__main__":
    main()
