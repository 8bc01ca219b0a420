"""What a first run compiles: ``python benchmarks/compiling.py``, on a small rendered clip, with an empty cache.

Prints every kernel with the processor seconds that it took to compile, those of what it calls left out. What a second process
compiles ahead is not among them: ``--alone`` lets the run compile it. ``--warm`` runs once more with the cache that is there then.
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

from cpu_parts.timing import tell

_RUN = """
import json, sys, threading, time
began = time.perf_counter()
from numba.core import event
found, own = [], threading.local()

class Listener(event.Listener):
    def on_start(self, given):
        own.waiting = getattr(own, "waiting", [])
        own.waiting.append([time.thread_time(), 0.0])
    def on_end(self, given):
        since, inside = own.waiting.pop()
        took = time.thread_time() - since
        if own.waiting:
            own.waiting[-1][1] += took
        function = given.data["dispatcher"].py_func
        found.append((function.__module__ + "." + function.__name__, took - inside, time.perf_counter() - began))

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
print(json.dumps([time.perf_counter() - began, found]))
"""


def first_run(folder: Path, name: str, cache: Path, alone: bool) -> tuple[float, list[tuple[str, float, float]]]:
    """Seconds of a whole run in a fresh process, and the kernels that it compiled: name, seconds, and when that was done."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache), "FLOWSPLAT_CACHE": str(cache / "flowsplat")}
    command = [sys.executable, "-c", _RUN, str(folder), name, "alone" if alone else ""]
    told = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE, text=True).stdout
    total, found = json.loads(told.splitlines()[-1])
    return total, found


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--warm", action="store_true", help="and once more with a full cache")
    parser.add_argument("--alone", action="store_true", help="no second process that compiles")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        began = time.perf_counter()
        total, found = first_run(folder, "cold", folder / "cache", options.alone)
        tell(f"{time.perf_counter() - began:.1f} s")
        seconds: dict[str, list[float]] = {}
        for name, took, _ in found:
            seconds.setdefault(name, []).append(took)
        print(f"{total:.1f} s in all, {sum(map(sum, seconds.values())):.1f} s of them compiling {len(found)} functions.\n")
        print("| function | versions | seconds |\n| --- | --- | --- |")
        for name, took in sorted(seconds.items(), key=lambda item: -sum(item[1])):
            if sum(took) >= 0.1:
                print(f"| {name.removeprefix('flowsplat.')} | {len(took)} | {sum(took):.2f} |")
        if options.warm:
            total, found = first_run(folder, "warm", folder / "cache", options.alone)
            print(f"\nWith what is compiled: {total:.1f} s in all, {sum(took for _, took, _ in found):.1f} s of them compiling.")


if __name__ == "__main__":
    main()
