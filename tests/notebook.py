"""Run a notebook as a person would, cell after cell in IPython, and keep the images that it shows.

``python -m tests.notebook NOTEBOOK FOLDER`` runs it in a folder, and writes there what each cell shows: ``shown/03.png`` and so on.
"""

from __future__ import annotations

import base64
import json
import os
import re
import sys
from pathlib import Path

from IPython.core.interactiveshell import InteractiveShell


def code_of(notebook: Path) -> list[str]:
    """The sources of its code cells."""
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


def images_of(shown: dict[str, object]) -> list[tuple[str, bytes]]:
    """(suffix, content) of the images in what a cell shows by type."""
    found = []
    if (png := shown.get("image/png")) is not None:
        found.append(("png", png if isinstance(png, bytes) else base64.b64decode(str(png))))
    for kind, data in re.findall(r"data:image/(\w+);base64,([\w+/=]+)", str(shown.get("text/html", ""))):
        found.append((kind, base64.b64decode(data)))
    return found


def main(notebook: Path, folder: Path) -> int:
    """Run it; 1 where a cell fails."""
    cells = code_of(notebook)
    os.chdir(folder)
    Path("shown").mkdir()
    shell = InteractiveShell.instance()
    for k, source in enumerate(cells):
        result = shell.run_cell(source, store_history=True)
        if not result.success:
            print(f"Cell {k} failed: {source}", file=sys.stderr)
            return 1
        shown, _ = shell.display_formatter.format(result.result)
        for suffix, content in images_of(shown):
            Path("shown", f"{k:02d}.{suffix}").write_bytes(content)
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]).resolve(), Path(sys.argv[2])))
