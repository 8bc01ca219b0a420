"""The tables of a protocol as Markdown, and with pictures as a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from flowsplat.common.files import write_text
from flowsplat.output.page import fitted, write_page
from flowsplat.pictures.html import picture, table
from flowsplat.scenes.layers import read_image
from flowsplat_benchmarks.datasets.cases import ProtocolName
from flowsplat_benchmarks.datasets.tables import Result, tables
from flowsplat_benchmarks.tables import TUNED_MARK, Table, label, made_by, markdown

TITLES = {"davis": "DAVIS", "rig": "Rendered scenes with truth", "nvidia": "NVIDIA Dynamic Scenes"}
RULES = {
    "davis": (
        "Every tenth frame is held out (9, 19, ..., never the last). Of these frames only the camera is known: cameras are "
        "estimated from the whole clip, as in the paper, and the masks of held-out frames are seen by the evaluation alone."
    ),
    "rig": (
        "All frames train; the test is held-out cameras. With own priors a held-out camera stands to the estimated camera of its "
        "time as the true one does, with one scale a clip."
    ),
    "nvidia": (
        "Cameras are calibrated and given; the other cameras of the rig are the test. Masks, flow, depth and tracks are our own. "
        "Where the clip's camera stands still, nothing tells the scale of its depth."
    ),
}
MARKS = "Scenes on which settings were chosen are marked tuned. Predictions without a model stand beside ours, from the same runs."
STRIP = ".png"
WIDEST = 1600
"""Pixels of a strip in the page, at most."""


def write_report(protocol: ProtocolName, out: Path, results: Sequence[Result], failed: Mapping[str, str]) -> Path:
    """Write ``OUT/<protocol>.md`` and ``.html`` and return the path of the page.

    Args:
        results: the JSON of every case.
        failed: cases that could not be run, and why.

    Raises:
        InputError: the folder cannot be written.
    """
    remarks = [RULES[protocol], MARKS]
    remarks += [made_by(results)] if results else []
    remarks += sorted({str(result["lpips_reason"]) for result in results if result["lpips_reason"]})
    remarks += [f"{name} could not be run: {reason}" for name, reason in failed.items()]
    found = tables(protocol, results)
    write_text(out / f"{protocol}.md", markdown(TITLES[protocol], remarks, found))
    page = out / f"{protocol}.html"
    write_page(
        page,
        "protocol.html.jinja",
        title=TITLES[protocol],
        verdict=f"Runs measured: {len(results)}" + (f"; that could not be run: {len(failed)}." if failed else "."),
        remarks=remarks,
        tables=[_shown(each) for each in found],
        scenes=[_scene(out, result) for result in results],
    )
    return page


def _shown(each: Table) -> dict[str, Any]:
    plain = [[cell.replace(TUNED_MARK, "tuned") for cell in row] for row in (each.header, *each.rows)]
    return {"title": each.title, "note": each.note, "table": table(plain[0], plain[1:], each.strong)}


def _scene(out: Path, result: Result) -> dict[str, Any]:
    name = str(result["name"])
    path, report = out / f"{name}{STRIP}", out / name / "report.html"
    shown = picture(fitted(read_image(path), WIDEST), f"{name}: test pictures") if path.exists() else None
    verdicts = [f"{prior}: {verdict}" for prior, verdict in result["verdicts"].items() if verdict]
    return {
        "title": label(result).replace(TUNED_MARK, "tuned"),
        "facts": "; ".join([result["variant"], result["settings"], *verdicts]),
        "strip": shown,
        "page": f"{name}/report.html" if report.exists() else None,
    }
