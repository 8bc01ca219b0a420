"""Write the common parts of the reports of ablations and caps: how they name scenes, and what they say of the runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from flowsplat_benchmarks.reports import Report, failures
from flowsplat_benchmarks.tables import Result, Table, describe_version, label, plain


def write_ablation_report(
    out: Path, name: str, title: str, verdict: str, remarks: Sequence[str], tables: Sequence[Table], failed: Mapping[str, str],
    others: int = 0, scenes: Sequence[Mapping[str, Any]] = (),
) -> Path:  # fmt: skip
    """Write ``OUT/<name>.md``, ``.html`` and the charts of the tables, and return the path of the page.

    Args:
        verdict: the result in a sentence.
        failed: runs that could not be made, and why.
        others: how many results in ``out`` are left out.
        scenes: sections under the tables, as from ``scene_section``.

    Raises:
        InputError: the folder cannot be written.
    """
    if others:
        remarks = [*remarks, f"Results in this folder that have other settings or scenes, and are left out here: {others}."]
    remarks = [*remarks, *failures(failed)]
    return Report(name, title, verdict, remarks, tables, scenes, template="ablations.html.jinja", verdict_is_remark=True).write(out)


def scene_names(results: Sequence[Result]) -> dict[str, str]:
    """Return the scenes of some results, with what to call them."""
    found = {result["scene"]: result for result in results}
    return {name: plain(label(result)) for name, result in sorted(found.items())}


def how_measured(results: Sequence[Result]) -> str:
    """Return which images were measured, and by which code, in some sentences."""
    parts = []
    for name in scene_names(results):
        result = next(result for result in results if result["scene"] == name)
        width, height = result["size"]
        kind = "held-out frames" if result["test"]["kind"] == "frames" else "images by held-out cameras"
        parts.append(f"{name} at {width}x{height}: {result['test']['count']} {kind}")
    cameras = "Cameras are used as they were estimated, or as they are given."
    return f"Measured are {'; '.join(parts)}. {cameras} {describe_version(results)}"
