"""The one reader of tables as text: CSV and TSV with a header."""

from __future__ import annotations

import csv
import io
from pathlib import Path

from flowsplat.common.errors import InputError, first_line
from flowsplat.common.files.opening import read_text

MAX_TABLE_BYTES = 64 * 2**20
"""Of a file. Chosen by eye."""


def read_rows(path: Path) -> list[tuple[int, dict[str, str]]]:
    """Return the rows of a table by the names in its header, each with the number of the line that it ends on; empty ones are left
    out.

    Cells are parted by commas, in a ``.tsv`` by tabulators, and quoted as spreadsheets do.

    Raises:
        InputError: not a text, no header, a name that stands twice, or a row with more cells than the header.
    """
    text = read_text(path, MAX_TABLE_BYTES)
    reader = csv.reader(io.StringIO(text, newline=""), "excel-tab" if Path(path).suffix.lower() == ".tsv" else "excel", strict=True)
    header: list[str] = []
    found = []
    try:
        for row in reader:
            cells = [cell.strip() for cell in row]
            if not any(cells):
                continue
            if not header:
                header = cells
                if len(set(header)) < len(header):
                    raise InputError(f"{path}: a name stands twice in the header.")
                continue
            if len(cells) > len(header):
                raise InputError(f"{path}, line {reader.line_num}: {len(cells)} cells, but the header has {len(header)}.")
            found.append((reader.line_num, dict(zip(header, cells, strict=False))))
    except csv.Error as error:
        raise InputError(f"{path}, line {reader.line_num}: {first_line(error)}.") from error
    if not header:
        raise InputError(f"{path} is empty: a table begins with the names of its columns.")
    return found
