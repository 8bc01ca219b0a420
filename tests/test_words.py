"""Names and words that do not come back: what they became stands in the issue that renamed them, and in the sources."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
BRITISH = (
    "colour", "centre", "neighbour", "grey", "normalis", "stabilis", "initialis", "recognis", "judgement", "travell", "metre",
)  # fmt: skip
MODULES = (
    "priors/objects/rematch.py", "priors/prompts/walking.py", "priors/masks/plate.py", "priors/masks/unexplained.py",
    "priors/masks/sweep.py", "priors/background/agreement.py", "priors/background/edges.py", "training/rays", "training/residuals",
    "training/average.py", "protocols", "cli/benchmarks",
)  # fmt: skip
READ = {".py", ".md", ".js", ".css", ".html", ".jinja", ".toml", ".yml", ".json"}
ALLOWED = re.compile(r"blue grey|parametre|diametre")
"""A name of the theme of the documentation, and the list above."""


def tracked() -> list[str]:
    """Files of the repository, those that are new among them."""
    try:
        command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("this is no checkout")
    return [name for name in done.stdout.splitlines() if (ROOT / name).is_file()]


def test_spelling_is_american():
    word = re.compile("|".join(BRITISH), re.IGNORECASE)
    found = []
    for name in tracked():
        if Path(name).suffix in READ and name != "tests/test_words.py":
            text = ALLOWED.sub("", (ROOT / name).read_text(encoding="utf-8"))
            found += [f"{name}: {match.group()}" for match in word.finditer(text)][:3]
        found += [name] if word.search(name) else []
    assert not found, "\n".join(found[:40])


def test_modules_have_the_names_of_the_field():
    assert [name for name in MODULES if (ROOT / "src" / "flowsplat" / name).exists()] == []
