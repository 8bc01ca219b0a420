"""The tables of the paper beside ours, from the newest record of each cell (``flowsplat_benchmarks.paper``)."""

from __future__ import annotations

import re
from dataclasses import replace

from flowsplat.common.errors import InputError
from flowsplat.images.html import NOTHING
from flowsplat_benchmarks import paper
from flowsplat_benchmarks.datasets.tables import read_published
from flowsplat_benchmarks.results.records import Record
from flowsplat_benchmarks.results.rows import Records, Row, add_missing
from flowsplat_benchmarks.tables import Table

WORDY = re.compile(
    r"our preset default but for this; |motion alone, in our trainer; |; gaps of held-out times|given masks, default; | at \d+x\d+"
)
"""What the page says of all rows together."""


def list_paper_tables(records: Records) -> list[Table]:
    """Return the paper's tables, with ours of the newest records; where a benchmark has failed, its table says so.

    Raises:
        InputError: a record is damaged.
    """
    published = read_published()["davis"]["scenes"]
    newest: dict[tuple[str, str, str, int], Record] = {}
    for each in records.all:
        is_shown = each.benchmark != "davis" or (each.variant == "given" and each.scene in published)
        if each.benchmark in paper.PROTOCOLS and is_shown:
            newest[each.benchmark, each.scene, each.variant, each.seed] = each
    found = [each for each in newest.values() if each.failure is None]
    try:
        tables = paper.list_tables([dict(each.result or {}) for each in found])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"A record of {' or '.join(paper.PROTOCOLS)} is damaged: {error!r}.") from error
    row = Row(found, records.used)
    for each in found:
        row.note_commit(each.commit)
    commits = {name: dict.fromkeys(each.commit for each in found if each.benchmark == name) for name in paper.PROTOCOLS}
    failed = [f"{each.benchmark} {each.scene} {each.variant}" for each in newest.values() if each.failure is not None]
    told = "; ".join(f"{name} at {', '.join(known)}" for name, known in commits.items() if known)
    note = f"Ours in all tables: {told or paper.NOT_MEASURED}." + (f" Failed: {', '.join(failed)}." if failed else "")
    shown = [_shorten(each, with_scenes="Table 5" not in each.title) for each in tables]
    return [
        replace(each, note="\n\n".join(part for part in (note if each is shown[0] else "", each.note) if part)) for each in shown
    ]


def _shorten(table: Table, with_scenes: bool) -> Table:
    """Leave out columns in which nothing is measured, and what the page says once of all rows; rows of motion alone in which
    nothing is measured are named in the note.

    Args:
        with_scenes: whether the column stays that tells what is measured.
    """
    empty = {paper.NOT_MEASURED, ""}
    header = [name.replace("LPIPS (AlexNet)", "LPIPS").replace("what differs", "ours of") for name in table.header]
    kept = [
        k for k in range(len(header)) if any(row[k] not in empty for row in table.rows) and (with_scenes or header[k] != "ours of")
    ]
    rows: list[tuple[str, ...]] = []
    strong: list[int] = []
    absent: list[str] = []
    for number, row in enumerate(table.rows):
        if row[0].endswith(paper.MOTION_ALONE) and all(cell in empty for cell in row[1:-1]):
            absent.append(row[0])
            continue
        if number in table.strong:
            strong.append(len(rows))
        cells = [WORDY.sub("", row[k]) for k in kept]
        missing = [k for k, cell in enumerate(cells) if cell == paper.NOT_MEASURED]
        has_ours = any(cell not in empty for cell in cells[1:-1]) and row[0].endswith((", ours", paper.MOTION_ALONE))
        for k in missing[0 if has_ours else 1 :]:
            cells[k] = NOTHING
        rows.append(tuple(cells))
    return replace(table, note=add_missing("", absent), header=tuple(header[k] for k in kept), rows=rows, strong=tuple(strong))
