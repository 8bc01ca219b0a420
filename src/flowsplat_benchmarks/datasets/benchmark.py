"""Run all cases of a protocol; called again, it continues."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from flowsplat.common.files import make_folder
from flowsplat.pipeline.folder import stage_key
from flowsplat_benchmarks.datasets.cases import Case, ProtocolName
from flowsplat_benchmarks.datasets.measure import measure_case
from flowsplat_benchmarks.datasets.report import STRIP, write_report
from flowsplat_benchmarks.resume import BenchmarkOptions, Measurement, measure_jobs, results_in


def run_benchmark(
    protocol: ProtocolName, cases: Sequence[Case], out: Path, again: bool = False, options: BenchmarkOptions | None = None
) -> Path:
    """Run and measure cases: ``OUT/<case>/`` is a run, ``OUT/<case>.json`` its figures, ``OUT/<protocol>.md`` and ``.html`` tables.

    A case that cannot be run is told and left out, and the others go on. The tables show all cases that are in OUT.

    Args:
        again: forget what is in OUT of these cases.
        options: how many at a time, and by what.

    Returns:
        path of the page.

    Raises:
        InputError: the folder cannot be written, or, at the end, which cases could not be run.
    """
    make_folder(out)
    if again:
        for case in cases:
            _forget(case, out)
    jobs = [Measurement(case.name, stage_key(case.source.name, case.config), partial(_measure, case, out)) for case in cases]

    def report(failed: Mapping[str, str]) -> Path:
        return write_report(protocol, out, results_in(protocol, out), failed)

    return measure_jobs(jobs, out, report, options=options, device=cases[0].config.device if cases else "cpu")


def _measure(case: Case, out: Path) -> dict[str, Any]:
    return measure_case(case, out / case.name, out / f"{case.name}{STRIP}")


def _forget(case: Case, out: Path) -> None:
    (out / f"{case.name}.json").unlink(missing_ok=True)
    if (out / case.name / "run.json").exists():
        shutil.rmtree(out / case.name)
