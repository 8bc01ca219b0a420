"""Names and words that do not come back: what they became stands in the issue that renamed them, and in the sources."""

from __future__ import annotations

import ast
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
BRITISH = (
    "colour", "centre", "neighbour", "grey", "normalis", "stabilis", "initialis", "recognis", "judgement", "travell", "metre",
)  # fmt: skip
MODULES = (
    "priors/objects/rematch.py", "priors/prompts/walking.py", "priors/masks/plate.py", "priors/masks/unexplained.py",
    "priors/masks/sweep.py", "priors/background/agreement.py", "priors/background/edges.py", "training/rays", "training/residuals",
    "training/average.py", "protocols", "cli/benchmarks", "pipeline/first.py", "gaussians/fading.py", "gaussians/support.py",
    "gaussians/lit.py", "priors/objects/card.py", "priors/objects/relief.py", "priors/objects/course.py", "training/picture_loss",
    "pictures",
)  # fmt: skip
OPTIONS = ("--touch", "--distance ", "--mask-not", "--render.fading", "--render.distances", "--render.slow ", "--first-scene")
WORDS = re.compile(
    r"\b_?movers?\b|_movers?\b|\bmovers?_|\bMovers?[A-Z]?|\bpictures?\b|_pictures?\b|\bpictures?_|\bPictures?[A-Z]|picture_loss"
    r"|\breliefs?\b|\bcourses?_|_courses?\b|\bFADING\b|\bSUPPORT\b|\bin_words\b|METHOD [0-9]|\bdeeds\.py|test_a_day"
)
"""What became *object*, *image*, *shape offset*, *depth trajectory*, ... (docs/glossary.md)."""
BEFORE = {"docs/glossary.md", "src/flowsplat/pipeline/renamed_options.py", "tests/test_words.py", "tests/test_cli.py"}
"""Files that may name what things were called before."""
PARTICIPLES = re.compile(
    r"(?!(?:read|feed|need|embed|shed|exceed|proceed|bring|ring|string)$)(?:[a-z]+(?:ed|ing)"
    r"|seen|shown|drawn|thrown|known|grown|given|taken|chosen|written|driven|hidden|broken|held|kept|made|found|told|lost|built|sent"
    r"|spent|bent|sought|brought|thought|caught|taught|worn|torn|born|done|gone|swollen|stolen|frozen|woken|led|met|laid|paid|said)"
)
VERBS = {"training", "viewing"}
"""Functions that are parts of a measurement, found by their names."""
VAGUE = {
    "AGREE", "AGREED", "AGREEING", "AGREEMENT", "AGREES", "AHEAD", "ALIKE", "ALLOWED", "ALONE", "ANOTHER", "APART", "APPARENT",
    "AROUND", "ASIDE", "ATTEMPTS", "AVERAGED", "BANDED", "BEAT", "BELIEF", "BELOW", "BESIDE", "BETTER", "BEYOND", "BLANK",
    "BLURRED", "BRIGHTEST", "BUSY", "CALMER", "CALMEST", "CENTRAL", "CHOICE", "CLEAR", "COARSE", "COARSEST", "COLLAPSE",
    "COLLAPSED", "CONTINUED", "CONTRADICTED", "COPIED", "COVERED", "CREDIBLE", "CROWDED", "DANCING", "DARKER", "DEEPEST",
    "DIFFERENCES", "DIFFERS", "DOUBT", "DOUBTED", "DRAWN", "DULL", "ELDER", "ENOUGH", "EVEN", "EVERY", "FADED", "FADING",
    "FAINTEST", "FAR", "FARTHER", "FARTHEST", "FASTEST", "FEW", "FEWEST", "FINE", "FIRST", "FLAT", "FLATTEST", "FLOOR",
    "FOLLOWS", "FRESH", "FURTHEST", "GATHERED", "GOOD", "GRACE", "GROUP", "HELD", "HELP", "INFLATE", "INLIER", "INSIDE", "JUMP",
    "KEEP", "KEPT", "LARGEST", "LASTS", "LEAST", "LIKE", "LIKENESS", "LISTED", "LONG", "LONGEST", "LOOK",
    "LOST", "LOWEST", "MANY", "MARGIN", "MENDED", "MISSES", "MOST", "MOSTLY", "MOVES", "MULTIPLE", "MUTED", "NEAR", "NEAREST",
    "NEGLIGIBLE", "NEXT", "NICE", "NOISY", "NOTICEABLE", "NUDGE", "OLD", "ON", "OPAQUE", "ORPHANED", "OTHERS", "OUTSIDE",
    "PATIENCE", "PROFILED", "PURE", "QUIET", "REACH", "REACHES", "REFITS", "REJECTED", "RENEWED", "RESERVE", "RESTING", "RESTS",
    "RIDGE", "RISE", "ROUGH", "ROUNDS", "SAME", "SEARCHED", "SEEN", "SETTLE", "SETTLED", "SHARE", "SHARED",
    "SHARES", "SHARPNESS", "SHORTEST", "SHOWN", "SIMPLER", "SLACK", "SLIP", "SLOWEST", "SMALL", "SMALLEST", "SMOOTH",
    "SMOOTHED", "SMOOTHING", "SMOOTHNESS", "SPAN", "SPARSER", "STAGGER", "STANCE", "STEEPEST", "STICKS", "STIFFNESS", "STILL",
    "STOPS", "STRONGEST", "SUCCESSES", "SUNNY", "SUPPORTED", "SUPPOSED", "SURE", "SUREST", "TELL", "TELLING", "THIN", "TIED",
    "TIMED", "TINY", "TOGETHER", "TOUCHED", "TRUST", "TRUSTED", "UNKNOWN", "UNSEEN", "UNSURE", "UNTOLD", "UNTRIED", "USUAL",
    "VOTERS", "WAIT", "WATCH", "WIDEST", "WITNESSES", "WORST", "WORTH", "WRONG", "ZIPPED",
}  # fmt: skip
"""Names of constants that do not say of what."""
EXTREMES = {"MOST", "LEAST", "FEWEST", "LARGEST", "SMALLEST", "LONGEST", "SHORTEST", "WIDEST"}
"""What their names do not begin with: it is MAX and MIN."""
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


def test_words_of_before_do_not_come_back():
    found = []
    for name in tracked():
        if name in BEFORE or Path(name).suffix not in READ - {".json"}:
            continue
        text = (ROOT / name).read_text(encoding="utf-8")
        found += [f"{name}: {match.group()}" for match in WORDS.finditer(text)][:3]
        found += [f"{name}: {option}" for option in OPTIONS if option in text and not name.startswith("tests/")]
    assert not found, "\n".join(found[:40])


def functions(node: ast.AST) -> Iterator[ast.FunctionDef]:
    """Functions of modules and classes, properties left out."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.ClassDef | ast.If):
            yield from functions(child)
        elif isinstance(child, ast.FunctionDef) and not any("property" in ast.unparse(each) for each in child.decorator_list):
            yield child


def test_functions_are_no_participles():
    found = []
    for name in tracked():
        if name.startswith("src/") and name.endswith(".py"):
            for function in functions(ast.parse((ROOT / name).read_text(encoding="utf-8"))):
                first = function.name.strip("_").split("_")[0]
                if PARTICIPLES.fullmatch(first) and function.name not in VERBS:
                    found.append(f"{name}: {function.name}")
    assert not found, "\n".join(found)


def test_constants_say_of_what():
    found = []
    for name in tracked():
        if name.startswith("src/") and name.endswith(".py"):
            for statement in ast.parse((ROOT / name).read_text(encoding="utf-8")).body:
                if isinstance(statement, ast.Assign | ast.AnnAssign):
                    targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
                    names = {each.id.strip("_") for target in targets for each in ast.walk(target) if isinstance(each, ast.Name)}
                    found += [f"{name}: {each}" for each in names if each in VAGUE or each.split("_")[0] in EXTREMES]
    assert not found, "\n".join(found)
