"""Puts constants, settings and the list of source files into the pages of the method while the site is built, from the source.

A page names modules or folders below ``src`` in a comment: ``<!-- constants: flowsplat/priors/flow.py -->`` becomes tables of
every constant that has a description, ``<!-- settings: flowsplat/training/config.py RatesConfig -->`` one of the fields of a
dataclass, and ``<!-- source files: flowsplat/priors/masks -->`` one of the files and their first sentences.
"""

from __future__ import annotations

import ast
import itertools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

SOURCE = Path(__file__).parents[2] / "src"
MARK = re.compile(r"<!-- (constants|settings|source files): (.*?) -->", re.S)
Row = tuple[str, str, str]
"""Name, value and description."""
LONGEST = 60
"""Characters of a value that is shown; a longer one stands in its file."""


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Called by MkDocs for every page."""
    if not page.file.src_uri.startswith("method/"):
        return markdown
    makers = {"constants": constants, "settings": settings, "source files": source_files}
    return MARK.sub(lambda match: "\n".join(makers[match[1]](match[2].split())), markdown)


def constants(names: list[str]) -> Iterator[str]:
    """Lines of one folded block with a table for every module that has constants with descriptions."""
    tables: list[tuple[str, list[Row]]] = []
    for path in _modules(names):
        rows = list(_described(ast.parse(path.read_text(encoding="utf-8")).body, upper=True))
        if rows:
            tables.append((path.relative_to(SOURCE).as_posix(), rows))
    yield from _folded(f"{sum(len(rows) for _, rows in tables)} constants, by file", "constant", tables)


def settings(names: list[str]) -> Iterator[str]:
    """Lines of one folded block with the fields of dataclasses: a module, then the names of its classes."""
    path, *classes = names
    tree = ast.parse((SOURCE / path).read_text(encoding="utf-8"))
    found = {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}
    tables = [(f"{path}, {name}", list(_described(found[name].body, upper=False))) for name in classes]
    yield from _folded(f"Settings: {', '.join(classes)}", "setting", tables)


def source_files(names: list[str]) -> Iterator[str]:
    """Lines of a table of files below ``src/flowsplat`` (or ``src``), with the first sentence of each."""
    yield "| file | what it does |\n| --- | --- |"
    for path in _modules(names):
        text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
        if text and path.name != "__init__.py":
            says = re.sub(r"\s*\((?:ours|docs)[^)]*\)", "", text.split("\n\n")[0])  # which page it is on is this one
            yield f"| `{path.relative_to(SOURCE).as_posix().removeprefix('flowsplat/')}` | {_cell(says)} |"


def _modules(names: list[str]) -> Iterator[Path]:
    for name in names:
        path = SOURCE / name
        if not path.exists():
            raise FileNotFoundError(f"docs/method names {name}, which is not in src")
        yield from [path] if path.is_file() else sorted(path.rglob("*.py"))


def _described(body: list[ast.stmt], upper: bool) -> Iterator[Row]:
    """Name, value and description of every assignment that a string follows."""
    for node, after in itertools.pairwise(body):
        if isinstance(node, ast.Assign):
            target, value = node.targets[0], node.value
        elif isinstance(node, ast.AnnAssign) and node.value is not None:
            target, value = node.target, node.value
        else:
            continue
        if not (isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) and isinstance(after.value.value, str)):
            continue
        name = ast.unparse(target).strip("()")
        if upper and not name.replace("_", "").replace(", ", "").isupper():
            continue
        # A setting that is left out of what is stored is given by field(default=...).
        default = {each.arg: each.value for each in getattr(value, "keywords", ())}.get("default", value)
        text = ast.unparse(default)
        yield name, text if len(text) <= LONGEST and "\n" not in text else "", after.value.value


def _folded(title: str, kind: str, tables: list[tuple[str, list[Row]]]) -> Iterator[str]:
    yield f'\n??? note "{title}"\n'
    for name, rows in tables:
        yield f"    **`{name}`**\n\n    | {kind} | value | what it is, and where it comes from |\n    | --- | --- | --- |"
        for constant, value, text in rows:
            yield f"    | `{constant}` | {f'`{_escape(value)}`' if value else ''} | {_cell(text)} |"
        yield ""


def _escape(text: str) -> str:
    return text.replace("|", "\\|")


def _cell(text: str) -> str:
    """One line that may stand in a table, with code as Markdown has it."""
    text = re.sub(r"``(.+?)``", r"`\1`", " ".join(text.split()))
    parts = re.split(r"(`.+?`)", text)
    for i in range(0, len(parts), 2):  # every other one is code
        parts[i] = parts[i].replace("<", "&lt;").replace("*", "\\*").replace("_", "\\_")
    return _escape("".join(parts))
