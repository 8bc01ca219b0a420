"""A plugin of pytest that writes what became of each test at once: a run that is killed has told what it knew."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest

SHOWN_CHARACTERS = 700
"""Characters of how a test failed. Chosen by eye."""


class GpuTestReport:
    """Writes a line for each test, to the file that ``FLOWSPLAT_TEST_REPORT`` names."""

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """A phase of a test is over."""
        _write(report)


def pytest_configure(config: pytest.Config) -> None:
    """In the process that was begun by hand: its workers hand their reports to it."""
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(GpuTestReport())


def _write(report: pytest.TestReport) -> None:
    if report.when != "call" and report.outcome == "passed":
        return
    said = str(report.longrepr)[-SHOWN_CHARACTERS:] if report.failed else ""
    line = {"test": report.nodeid, "outcome": report.outcome, "seconds": report.duration, "said": said}
    with Path(os.environ["FLOWSPLAT_TEST_REPORT"]).open("a", encoding="utf-8") as file:
        file.write(json.dumps(line) + "\n")


def summary(file: Path) -> dict[str, Any]:
    """Return how many passed, what failed and how, and what took longest (with its compiling)."""
    text = file.read_text(encoding="utf-8") if file.exists() else ""
    lines = [json.loads(line) for line in text.splitlines(keepends=True) if line.endswith("\n")]
    by_outcome = {name: [line for line in lines if line["outcome"] == name] for name in ("passed", "failed", "skipped")}
    slowest = sorted(lines, key=lambda line: -line["seconds"])[:8]
    return {
        **{name: len(found) for name, found in by_outcome.items()},
        "failures": {line["test"]: line["said"] for line in by_outcome["failed"]},
        "slowest": {line["test"]: round(line["seconds"], 1) for line in slowest},
    }
