"""A plugin of pytest, which ``tests/run.py`` names.

It writes what became of each test, and the processor's seconds that it took; and it gives workers those files first that are long.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

PROPERTY = "seconds of the processor"
ALONE = ("browser", "all_cores")
"""Marks of tests that are run one after the other."""
SLOW_WEIGHT = 50
"""Of a slow test, where an ordinary one has 1."""
_BEFORE = pytest.StashKey[float]()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Where it is written to."""
    parser.addoption("--measured", type=Path, default=None, metavar="FILE", help="append JSON for each phase of each test")


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Workers take files as they come: what is long must not come last, when nothing is left for the others."""
    if hasattr(config, "workerinput"):
        weights = Counter[Path]()
        for item in items:
            weights[item.path] += SLOW_WEIGHT if item.get_closest_marker("slow") else 1
        items.sort(key=lambda item: -weights[item.path])


def pytest_deselected(items: list[pytest.Item]) -> None:
    """Write which files have tests of the other groups: reading all files takes long, and those groups have few."""
    config = items[0].config
    file = config.getoption("--measured")
    if file is not None and getattr(config, "workerinput", {}).get("workerid", "gw0") == "gw0":
        found = {str(item.path) for item in items if any(item.get_closest_marker(name) for name in ALONE)}
        file.with_suffix(".alone").write_text(json.dumps(sorted(found)), encoding="utf-8")


def processor_seconds() -> float:
    """Of all threads of this process, and of all processes that it has begun and waited for."""
    spent = os.times()
    return spent.user + spent.system + spent.children_user + spent.children_system


def pytest_runtest_protocol(item: pytest.Item) -> None:
    """A test begins."""
    item.config.stash[_BEFORE] = processor_seconds()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Iterator[None]:
    """Add what was spent since the phase before. A worker hands it on with the report."""
    report = yield
    now = processor_seconds()
    report.user_properties.append((PROPERTY, now - item.config.stash[_BEFORE]))
    item.config.stash[_BEFORE] = now
    return report


class Record:
    """Writes a line for each report."""

    def __init__(self, file: Path):
        self._file = file

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        spent = dict(report.user_properties).get(PROPERTY, 0.0)
        self._write(report.nodeid, report.when, report.outcome, report.duration, spent, "slow" in report.keywords)

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        """What cannot even be imported has failed."""
        if report.failed:
            self._write(report.nodeid, "collect", report.outcome, 0.0, 0.0, False)

    def _write(self, test: str, phase: str, outcome: str, seconds: float, processor: float, slow: bool) -> None:
        values = {"test": test, "phase": phase, "outcome": outcome, "seconds": seconds, "processor": processor, "slow": slow}
        with self._file.open("a", encoding="utf-8") as file:
            file.write(json.dumps(values) + "\n")


def pytest_configure(config: pytest.Config) -> None:
    """Write where a file is named; what workers hand on arrives in the process that began them."""
    file = config.getoption("--measured")
    if file is not None and not hasattr(config, "workerinput"):
        config.pluginmanager.register(Record(file))
