"""The page of an ablation: tables with a picture under each, as HTML, as Markdown, and the pictures as files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup

from flowsplat.common.files import write_text
from flowsplat.output.page import write_page
from flowsplat.pictures.charts import svg_file
from flowsplat.pictures.html import table
from flowsplat_benchmarks.ablations.training_runs import Result
from flowsplat_benchmarks.tables import TUNED_MARK, Table, made_by, markdown


@dataclass(frozen=True)
class Section:
    """A table and the drawing that belongs to it.

    Attributes:
        name: short, for the file of the drawing.
        table: its texts.
        chart: an SVG drawing.
    """

    name: str
    table: Table
    chart: Markup


def write_ablation_page(
    out: Path,
    name: str,
    title: str,
    verdict: str,
    remarks: Sequence[str],
    sections: Sequence[Section],
    failed: Mapping[str, str],
    others: int = 0,
) -> Path:
    """Write ``OUT/<name>.md``, ``.html`` and a ``<name>_<section>.svg`` for every section, and return the path of the page.

    Args:
        verdict: the result in a sentence.
        failed: runs that could not be made, and why.
        others: how many results in ``out`` are left out.

    Raises:
        InputError: the folder cannot be written.
    """
    if others:
        remarks = [*remarks, f"Results in this folder that have other settings or scenes, and are left out here: {others}."]
    remarks = [verdict, *remarks, *(f"{run} could not be run: {reason}" for run, reason in failed.items())]
    pictures = {section.table.title: out / f"{name}_{section.name}.svg" for section in sections}
    for section in sections:
        write_text(pictures[section.table.title], svg_file(section.chart))
    write_text(out / f"{name}.md", markdown(title, remarks, [section.table for section in sections], pictures))
    page = out / f"{name}.html"
    shown = [
        {
            "title": section.table.title, "note": section.table.note, "chart": section.chart,
            "table": table(section.table.header, section.table.rows, section.table.strong),
        }
        for section in sections
    ]  # fmt: skip
    write_page(page, "ablations.html.jinja", title=title, verdict=verdict, remarks=remarks[1:], sections=shown)
    return page


def scene_names(results: Sequence[Result]) -> dict[str, str]:
    """The scenes of some results, with what to call them."""
    found = {result["scene"]: result for result in results}
    return {name: f"{name}, {TUNED_MARK.strip('*')}" if result["tuned"] else name for name, result in sorted(found.items())}


def how_measured(results: Sequence[Result]) -> str:
    """Which pictures were measured, and by which code, in some sentences."""
    parts = []
    for name in scene_names(results):
        result = next(result for result in results if result["scene"] == name)
        width, height = result["size"]
        kind = "held-out frames" if result["test"]["kind"] == "frames" else "pictures by held-out cameras"
        parts.append(f"{name} at {width}x{height}: {result['test']['count']} {kind}")
    cameras = "Cameras are used as they were estimated, or as they are given."
    return f"Measured are {'; '.join(parts)}. {cameras} {made_by(results)}"
