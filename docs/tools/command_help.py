"""Puts what ``--help`` says into the page of commands while the site is built, so that it cannot go stale."""

from __future__ import annotations

import contextlib
import io
import os
import re
from collections.abc import Iterator
from typing import Any
from unittest import mock

from flowsplat import cli

PAGE, MARK = "commands.md", "<!-- what every command says of itself -->"
WIDTH = 100
"""Columns of the help."""
GROUPS = ("benchmark",)
"""Commands that have commands of their own."""
SHORT = 45
"""Lines of a help that is shown without a click."""


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Called by MkDocs for every page."""
    return markdown.replace(MARK, "\n".join(_sections())) if page.file.src_uri == PAGE else markdown


def help_of(*words: str) -> str:
    """What ``flowsplat <words> --help-all`` prints."""
    printed = io.StringIO()
    plain = {"COLUMNS": str(WIDTH), "NO_COLOR": "1", "TERM": "dumb"}
    with mock.patch.dict(os.environ, plain), contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        cli.main([*words, "--help-all"])
    return printed.getvalue().strip()


def all_commands(*words: str) -> Iterator[tuple[str, ...]]:
    """The words of every command, read from the help: ``("run",)``, ..., ``("benchmark", "priors")``, ..."""
    usage = help_of(*words).split("\n\n")[0]
    choices = re.search(r"\{([\w,-]+)\}", "".join(usage.split()))
    for name in choices[1].split(",") if choices else []:
        below = list(all_commands(*words, name)) if name in GROUPS else []
        yield from below or [(*words, name)]


def _sections() -> Iterator[str]:
    for words in all_commands():
        text = help_of(*words)
        lines = text.splitlines()
        name = " ".join(("flowsplat", *words))
        yield f"\n## {name}\n\n{text.split(chr(10) * 2)[1]}\n"
        yield f'???{"+" * (len(lines) <= SHORT)} note "{name} --help-all"\n\n    ```text'
        yield from (f"    {line}" for line in lines)
        yield "    ```\n"
