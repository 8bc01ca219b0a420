"""Puts what ``--help`` says into the page of commands while the site is built, so that it cannot go stale."""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Iterator, Mapping
from typing import Any
from unittest import mock

from flowsplat import cli

PAGE, MARK = "commands.md", "<!-- what every command says of itself -->"
WIDTH = 100
"""Columns of the help."""
SHORT = 45
"""Lines of a help that is shown without a click."""


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Called by MkDocs for every page."""
    return markdown.replace(MARK, "\n".join(_sections())) if page.file.src_uri == PAGE else markdown


def help_of(*words: str) -> str:
    """What ``flowsplat <words> --help`` prints."""
    printed = io.StringIO()
    plain = {"COLUMNS": str(WIDTH), "NO_COLOR": "1", "TERM": "dumb"}
    with mock.patch.dict(os.environ, plain), contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        cli.main([*words, "--help"])
    return printed.getvalue().strip()


def _sections() -> Iterator[str]:
    for words, function in _all_commands():
        text = help_of(*words)
        lines = text.splitlines()
        name = " ".join(("flowsplat", *words))
        yield f"\n## {name}\n\n{(function.__doc__ or '').split(chr(10))[0]}\n"
        yield f'???{"+" * (len(lines) <= SHORT)} note "{name} --help"\n\n    ```text'
        yield from (f"    {line}" for line in lines)
        yield "    ```\n"


def _all_commands() -> Iterator[tuple[tuple[str, ...], Any]]:
    commands: Mapping[str, Any] = cli._commands([])
    for name, function in commands.items():
        if name != "benchmark":
            yield (name,), function
    for name, function in cli._benchmarks().items():
        yield ("benchmark", name), function
