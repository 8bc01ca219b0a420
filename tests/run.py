"""What ``make test`` and ``make test-all`` do: lint, format and types, then every test.

``python tests/run.py`` leaves out what is marked ``slow``; ``--all`` leaves out nothing. Kernels are compiled and one small run is
trained before the tests begin. Then come three groups: most tests, in two processes that have one thread each; those marked
``all_cores``, and those marked ``browser``, alone and one after the other (a browser that has to wait for the processor fails tests
of what a person sees in time).
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from flowsplat.common.kernel_cache import kernels_folder

ROOT = Path(__file__).resolve().parents[1]
ONE_THREAD = dict.fromkeys(
    ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"), "1"
)
WORKERS = 2
SLOWEST = 40
"""Tests that are named at the end with what they took."""
LONG = 10.0
"""Seconds of the processor above which a test should be marked ``slow``."""
NOTHING = 5
"""What pytest ends with where a group has no test."""
INTERRUPTED = 130
_PATIENCE = 20.0
"""Seconds that pytest has to end after Ctrl-C, which reaches it, too."""
CHECKS = {
    "lint": ["ruff", "check", "."],
    "format": ["ruff", "format", "--check", "."],
    "types": ["mypy"],
}
"""Programs that lie beside this Python."""


@dataclass
class Test:
    """What became of one."""

    outcome: str = "passed"
    seconds: float = 0.0
    processor: float = 0.0
    slow: bool = False


@dataclass
class Tally:
    """What became of all, by name."""

    tests: dict[str, Test] = field(default_factory=dict)

    def add(self, lines: Iterable[str]) -> None:
        """Read what ``tests/plugin.py`` wrote: a line for each of the phases of each test. The worst of them is its outcome."""
        order = ("passed", "skipped", "failed")
        for line in lines:
            found = json.loads(line)
            test = self.tests.setdefault(found["test"], Test(slow=found["slow"]))
            test.outcome = max(test.outcome, found["outcome"], key=order.index)
            test.seconds += found["seconds"]
            test.processor += found["processor"]

    def count(self, outcome: str) -> int:
        """How many ended like that."""
        return sum(test.outcome == outcome for test in self.tests.values())

    def line(self) -> str:
        """The last line."""
        return ", ".join(f"{self.count(outcome)} {outcome}" for outcome in ("passed", "failed", "skipped"))

    def slowest(self) -> list[str]:
        """A line for each of those that took longest."""
        longest = sorted(self.tests.items(), key=lambda item: -item[1].seconds)[:SLOWEST]
        return [f"{test.seconds:7.1f} s, {test.processor:6.1f} of the processor  {name}" for name, test in longest]

    def to_be_marked(self) -> list[str]:
        """A line for each that took long and is not marked so."""
        return [f"{test.processor:7.1f} s  {name}" for name, test in self.tests.items() if test.processor > LONG and not test.slow]


@dataclass(frozen=True)
class Group:
    """Tests that are run in one way."""

    name: str
    marked: str
    options: tuple[str, ...] = ()
    environment: dict[str, str] = field(default_factory=dict)

    def command(self, everything: bool, measured: Path, files: Sequence[str] = ()) -> list[str]:
        """What runs it, in all files or in these."""
        marked = self.marked if everything else f"{self.marked} and not slow"
        plugin = ["-p", "tests.plugin", "--measured", str(measured)]
        return [sys.executable, "-m", "pytest", *plugin, "-m", marked, *self.options, *files]


GROUPS = (
    Group(
        "two at a time",
        "not browser and not all_cores",
        ("-n", str(WORKERS), "--dist", "loadfile", "--no-loadscope-reorder"),
        ONE_THREAD,
    ),
    Group("with all cores", "all_cores and not browser"),
    Group("in a browser", "browser"),
)


def code_of(codes: Sequence[int], tally: Tally) -> int:
    """What to end with: 0 where every group ended well and there were tests."""
    return int(any(code not in (0, NOTHING) for code in codes) or tally.count("failed") > 0 or not tally.count("passed"))


class Run:
    """Begins processes, and ends them when it is asked to stop."""

    was_told: bool = True
    """Whether Ctrl-C reached those that were begun, too, as it does in a terminal."""

    def __init__(self) -> None:
        self._begun: list[subprocess.Popen[bytes]] = []

    def begin(self, command: list[str], environment: dict[str, str], **how: object) -> subprocess.Popen[bytes]:
        """In the folder of the repository."""
        self._begun.append(subprocess.Popen(command, cwd=ROOT, env={**os.environ, **environment}, **how))  # type: ignore[call-overload]
        return self._begun[-1]

    def stop(self) -> None:
        """Let what was interrupted end, and end what does not."""
        deadline = time.monotonic() + _PATIENCE
        left = [process for process in self._begun if process.poll() is None]
        for process in left if not self.was_told else ():
            process.send_signal(signal.SIGINT)
        for process in left:
            with suppress(subprocess.TimeoutExpired):
                process.wait(max(deadline - time.monotonic(), 0.1))
                continue
            process.terminate()
            with suppress(subprocess.TimeoutExpired):
                process.wait(5)
                continue
            process.kill()
            process.wait()

    def at_once(self, commands: dict[str, list[str]], environment: dict[str, str]) -> list[str]:
        """Run all at the same time; the names of those that failed, whose words are shown."""
        with tempfile.TemporaryDirectory() as folder:
            files = {name: (Path(folder) / name).open("w+b") for name in commands}
            begun = {
                name: self.begin(command, environment, stdout=files[name], stderr=subprocess.STDOUT)
                for name, command in commands.items()
            }
            failed = []
            for name, process in begun.items():
                if process.wait():
                    failed.append(name)
                    files[name].seek(0)
                    print(files[name].read().decode(errors="replace"), flush=True)
                files[name].close()
        return failed


def report(text: str, began: float) -> None:
    """A line with the minutes so far."""
    seconds = round(time.monotonic() - began)
    print(f"\n=== {seconds // 60}:{seconds % 60:02} {text}", flush=True)


def run(everything: bool, work: Path, running: Run, tally: Tally) -> int:
    """All of it; the code to end with."""
    began = time.monotonic()
    programs = Path(sys.executable).parent
    checks = {name: [str(programs / command[0]), *command[1:]] for name, command in CHECKS.items()}
    shared = {
        "FLOWSPLAT_TESTS_SHARED": str(work / "shared"), "FLOWSPLAT_CACHE": str(work / "cache"),
        "NUMBA_CACHE_DIR": str(kernels_folder()),
    }  # fmt: skip
    report("lint, format, types; kernels are compiled, and a small run is trained", began)
    before = {
        part: [sys.executable, "-m", "tests.shared", part, str(work / "shared")] for part in ("kernels", "others", "finished")
    }
    finished = {"finished": before.pop("finished")}
    if failed := [*running.at_once({**checks, **before}, shared), *running.at_once(finished, shared)]:
        print(f"Failed: {', '.join(failed)}. No test was run.")
        return 1
    codes, files = [], list[str]()
    for number, group in enumerate(GROUPS):
        report(f"tests, {group.name}", began)
        measured = work / f"{number}.jsonl"
        try:
            process = running.begin(group.command(everything, measured, files), {**shared, **group.environment})
            codes.append(process.wait())
        finally:
            if measured.exists():
                tally.add(measured.read_text(encoding="utf-8").splitlines())
        if number == 0 and measured.with_suffix(".alone").exists():
            files = json.loads(measured.with_suffix(".alone").read_text(encoding="utf-8"))
        if codes[-1] not in (0, 1, NOTHING):
            print(f"Pytest ended with code {codes[-1]}: not all of these tests were run.")
    report("the slowest", began)
    print("\n".join(tally.slowest()))
    if long := tally.to_be_marked():
        report(f"these took more than {LONG:g} seconds of the processor and are not marked slow", began)
        print("\n".join(long))
    report("done", began)
    return code_of(codes, tally)


def main() -> int:
    """What the command does."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--all", action="store_true", help="slow tests, too")
    everything = parser.parse_args().all
    running, tally = Run(), Tally()

    def stop(number: int, _: object) -> None:
        running.was_told = number == signal.SIGINT
        raise KeyboardInterrupt

    for number in (signal.SIGINT, signal.SIGTERM):  # the first of which a shell's background jobs ignore
        signal.signal(number, stop)
    with tempfile.TemporaryDirectory(prefix="flowsplat-tests-") as work:
        try:
            code = run(everything, Path(work), running, tally)
        except KeyboardInterrupt:
            code = INTERRUPTED
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, signal.SIG_IGN)  # what is ended now is ended once
            print("\nStopped.", flush=True)
            running.stop()
    print(tally.line())
    return code


if __name__ == "__main__":
    sys.exit(main())
