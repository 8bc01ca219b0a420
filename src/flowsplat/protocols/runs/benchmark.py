"""All cases of a protocol, one after the other; called again, it continues."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from flowsplat.common.errors import InputError
from flowsplat.common.files import make_folder, read_json, write_json
from flowsplat.common.progress import say
from flowsplat.pipeline.folder import stage_key
from flowsplat.protocols.runs.cases import Case, ProtocolName
from flowsplat.protocols.runs.measure import measure_case
from flowsplat.protocols.runs.report import STRIP, write_report


def run_benchmark(protocol: ProtocolName, cases: Sequence[Case], out: Path, again: bool = False) -> Path:
    """Run and measure cases: ``OUT/<case>/`` is a run, ``OUT/<case>.json`` its figures, ``OUT/<protocol>.md`` and ``.html`` tables.

    A case that cannot be run is told and left out, and the others go on. The tables show all cases that are in OUT.

    Args:
        again: forget what is in OUT of these cases.

    Returns:
        path of the page.

    Raises:
        InputError: the folder cannot be written, or, at the end, which cases could not be run.
    """
    make_folder(out)
    failed: dict[str, str] = {}
    page = out / f"{protocol}.html"
    for k, case in enumerate(cases):
        if again:
            _forget(case, out)
        if _is_measured(case, out):
            say(f"{case.name}: measured already ({k + 1} of {len(cases)}).")
        else:
            say(f"{case.name} ({k + 1} of {len(cases)}) ...")
            try:
                result = measure_case(case, out / case.name, out / f"{case.name}{STRIP}")
                write_json(out / f"{case.name}.json", {**result, "key": _key(case)})
            except InputError as error:
                failed[case.name] = str(error)
                say(f"{case.name} could not be run: {error}")
        page = write_report(protocol, out, results_in(protocol, out), failed)
    say(f"Look at {page}")
    if failed:
        first = next(iter(failed))
        raise InputError(f"{len(failed)} of {len(cases)} scenes could not be run, first {first}: {failed[first]}")
    return page


def results_in(protocol: ProtocolName, out: Path) -> list[dict[str, Any]]:
    """The figures of all cases of a protocol that are in a folder, by name."""
    found = [read_json(path) for path in sorted(out.glob("*.json"))]
    return [value for value in found if isinstance(value, dict) and value.get("protocol") == protocol]


def _key(case: Case) -> str:
    """A short name of everything that the figures of a case depend on."""
    return stage_key(case.source.name, case.config)


def _is_measured(case: Case, out: Path) -> bool:
    path = out / f"{case.name}.json"
    return path.exists() and read_json(path).get("key") == _key(case)


def _forget(case: Case, out: Path) -> None:
    (out / f"{case.name}.json").unlink(missing_ok=True)
    if (out / case.name / "run.json").exists():
        shutil.rmtree(out / case.name)
