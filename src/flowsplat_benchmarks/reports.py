"""The report of a benchmark: its tables, remarks and scenes, as Markdown and as a page that needs no network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from flowsplat.common.files import write_text
from flowsplat.images.charts import svg_file
from flowsplat.images.html import image_tag, shrink_to_page, table
from flowsplat.output.page import write_page
from flowsplat_benchmarks.tables import Result, Table, format_page, plain

MAX_IMAGE_WIDTH = 1600
"""Pixels of an image of a scene in the page, at most. Chosen by eye."""


@dataclass(frozen=True)
class Report:
    """What a benchmark found.

    Attributes:
        name: of its files, ``OUT/<name>.md`` and ``OUT/<name>.html``.
        title: of both.
        verdict: the result in a sentence; it stands on top of the page.
        remarks: what has to be known of the tables.
        tables: in order; each chart of one is a file of its own, too.
        scenes: what became of each, under the tables of the page (``scene_section``).
        template: of the page, in ``templates``.
        verdict_is_remark: whether the Markdown has the verdict, as its first remark.
    """

    name: str
    title: str
    verdict: str
    remarks: Sequence[str]
    tables: Sequence[Table]
    scenes: Sequence[Mapping[str, Any]] = ()
    template: str = "report.html.jinja"
    verdict_is_remark: bool = False

    def write(self, out: Path) -> Path:
        """Write it into the folder ``out`` and return the path of the page.

        Raises:
            InputError: the folder cannot be written.
        """
        for each in self.tables:
            for chart in each.charts:
                write_text(out / chart.file, svg_file(chart.drawing))
        remarks = [self.verdict, *self.remarks] if self.verdict_is_remark else self.remarks
        write_text(out / f"{self.name}.md", format_page(self.title, remarks, self.tables))
        page = out / f"{self.name}.html"
        write_benchmark_page(
            page, self.template, title=self.title, verdict=self.verdict, remarks=self.remarks,
            tables=[_on_page(each) for each in self.tables], scenes=self.scenes,
        )  # fmt: skip
        return page


def write_benchmark_page(page: Path, template: str, **values: Any) -> None:
    """Fill a template of this package (``templates``) and write the page.

    Raises:
        InputError: it cannot be written.
    """
    write_page(page, template, package="flowsplat_benchmarks", **values)


def _on_page(each: Table) -> dict[str, Any]:
    rows = [[plain(cell) for cell in row] for row in (each.header, *each.rows)]
    return {
        "title": each.title, "note": each.note, "charts": [chart.drawing for chart in each.charts],
        "table": table(rows[0], rows[1:], each.strong),
    }  # fmt: skip


def failures(failed: Mapping[str, str], done: str = "run") -> list[str]:
    """Return a remark on each of those that failed, from their names and why; ``done``: what could not be done with them."""
    return [f"{name} could not be {done}: {reason}" for name, reason in failed.items()]


def runs_measured(results: Sequence[Result], failed: Mapping[str, str]) -> str:
    """Return how many runs there are and how many are missing, in a sentence.

    >>> runs_measured([{}, {}], {}), runs_measured([], {"bear": "it is torn"})
    ('Runs measured: 2.', 'Runs measured: 0; that could not be run: 1.')
    """
    return f"Runs measured: {len(results)}" + (f"; that could not be run: {len(failed)}." if failed else ".")


def scene_section(
    out: Path, title: str, facts: str, page: str, images: Sequence[tuple[np.ndarray, str]] = (), widest: int = MAX_IMAGE_WIDTH,
    shown: str = "The test image of median PSNR, and under it the worst one",
) -> dict[str, Any]:  # fmt: skip
    """Return what the page says of a scene.

    Args:
        page: of the scene, in ``out``; there is a link to it where it is there.
        images: [H, W, 3] each, with what it shows.
        widest: pixels of one in the page, at most.
        shown: what the images are.
    """
    strip = Markup().join(image_tag(shrink_to_page(image, widest), what) for image, what in images)
    return {"title": title, "facts": facts, "strip": strip or None, "shown": shown, "page": page if (out / page).exists() else None}
