"""The documentation: it builds without a warning, every link and image of it is there, and what it quotes is what we say."""

from __future__ import annotations

import ast
import html
import importlib.util
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

import flowsplat
from flowsplat.cli import main
from flowsplat_benchmarks.results.pages import format_pages
from flowsplat_benchmarks.results.records import read_records
from flowsplat_benchmarks.results.rows import Records

TOP = Path(__file__).parent.parent.parent
DOCS = TOP / "docs"


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """The built site."""
    for package in ("mkdocs", "material", "mkdocstrings", "latex2mathml"):
        pytest.importorskip(package, reason="the site was not built: that needs mkdocs (pip install -e '.[docs]')")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    result = subprocess.run(command, cwd=TOP, env=environment, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stderr
    return folder


class Found(HTMLParser):
    """The addresses that a page asks for, and the places in it that can be linked to."""

    def __init__(self, page: Path):
        super().__init__()
        self.addresses: list[str] = []
        self.names: set[str] = set()
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self.addresses += [values[key] or "" for key in ("href", "src") if key in values]
        self.names |= {values[key] or "" for key in ("id", "name") if key in values}


def test_every_link_and_image_is_there(site):
    pages = {path: Found(path) for path in site.rglob("*.html") if path.name != "404.html"}
    assert len(pages) > 8
    wrong = []
    for page, found in pages.items():
        for address in found.addresses:
            parts = urlsplit(address)
            if parts.scheme or parts.netloc:
                continue
            target = (page.parent / unquote(parts.path)).resolve() if parts.path else page
            target = target / "index.html" if target.is_dir() else target
            named = not parts.fragment or target not in pages or unquote(parts.fragment) in pages[target].names
            if not target.is_file() or not named:
                wrong.append(f"{page.name}: {address}")
    assert wrong == []


def test_nothing_is_fetched_from_elsewhere(site):
    for page in site.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        assert re.findall(r"<(?:script|img|link|iframe)[^>]+(?:src|href)=[\"']?(?:https?:)?//[^\"' >]+", text) == [], page.name


def test_formulas_need_no_script(site):
    page = (site / "method/representation.html").read_text(encoding="utf-8")
    assert page.count("<math") > 60
    assert "munderover" in page
    for path in site.rglob("*.html"):
        text = re.sub(r"<(code|pre)\b.*?</\1>", "", path.read_text(encoding="utf-8"), flags=re.S)
        assert re.findall(r"arithmatex|\$\S[^$<\n]*\\[a-z]+|\\\(|\\\[", text.split("<article", 1)[-1]) == [], path.name


def test_the_search_works_from_disk(site):
    text = (site / "search/search_index.js").read_text(encoding="utf-8")
    assert text.startswith("var __index = {")
    assert "Distance is a matter of choice after training" in text
    page = (site / "method/flow.html").read_text(encoding="utf-8")
    assert 'src="../assets/iframe-worker.js"' in page
    assert (site / "assets/iframe-worker.js").is_file()


ORDER = ["Problem", "Equations", "Algorithm", "Constants", "Source files", "Differences from the paper"]


def test_the_pages_of_the_method_have_one_order(site):
    pages = sorted(path for path in (DOCS / "method").glob("*.md") if path.name != "index.md")
    assert len(pages) == 8
    for path in pages:
        assert re.findall(r"^## (.+)$", path.read_text(encoding="utf-8"), re.M) == ORDER, path.name
        assert "<!--" not in (site / "method" / f"{path.stem}.html").read_text(encoding="utf-8").split("<article")[1], path.name


def test_constants_on_the_pages_are_those_of_the_code(site):
    from flowsplat.splatting import rules
    from flowsplat.training.config import RatesConfig

    for page, name, value in (("flow", "ALPHA_MAX", rules.ALPHA_MAX), ("training", "means_pixels", RatesConfig().means_pixels)):
        text = (site / "method" / f"{page}.html").read_text(encoding="utf-8")
        assert re.search(rf"<td><code>{name}</code></td>\s*<td><code>{value}</code></td>", text), name


def test_pages_that_comments_name_are_there():
    headings, missing = {}, []
    files = [path for folder in ("src", "tests", "examples") for path in (TOP / folder).rglob("*.py")]
    cited = {(name, words) for path in files for name, words in CITED.findall(path.read_text(encoding="utf-8"))}
    assert len(cited) > 15
    for name, words in sorted(cited):
        path = TOP / name
        if not path.is_file():
            missing.append(name)
            continue
        headings[name] = headings.get(name) or re.findall(r"^#+ (.+)$", path.read_text(encoding="utf-8"), re.M)
        section = " ".join(words.split())
        if section and "/method/" in name and section not in headings[name]:
            missing.append(f"{name}, {section}")
    assert missing == []


CITED = re.compile(r'(docs/[\w/-]+\.md)(?:,\s+"([^"]+)")?')


def test_the_drawing_of_the_packages_is_what_they_import():
    specification = importlib.util.spec_from_file_location("drawings", DOCS / "tools" / "drawings.py")
    tool = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(tool)
    assert (DOCS / "images" / "packages.svg").read_text(encoding="utf-8") == tool.draw_packages(), "python docs/tools/drawings.py"


def test_the_site_shows_the_real_help(site, capsys):
    page = html.unescape((site / "commands.html").read_text(encoding="utf-8"))
    with pytest.raises(SystemExit):
        main(["--help"])
    usage = re.search(r"\{([\w,\s-]+)\}", capsys.readouterr().out)
    assert usage is not None
    names = re.sub(r"\s", "", usage[1]).split(",")
    assert len(names) > 8
    for name in [*names, "benchmark priors"]:
        if name != "benchmark":
            assert f"usage: flowsplat {name} " in page
    assert "--render.stereo" in page
    assert "--max-gaussians" in page


def test_pages_that_are_made_say_outside_the_site_where_their_text_is(site):
    pages = [path for path in DOCS.rglob("*.md") if "<!-- outside the site -->" in path.read_text(encoding="utf-8")]
    assert {path.name for path in pages} == {"filming.md", "commands.md", "contributing.md", "changelog.md"}
    for path in pages:
        told = re.findall(r"<!-- outside the site -->\n(.*?)<!-- end -->", path.read_text(encoding="utf-8"), re.S)
        links = re.findall(r"\]\(([^)]+)\)", "".join(told))
        assert len(told) == 1
        assert links, path.name
        assert all((path.parent / link).exists() for link in links), path.name
        assert "<!--" not in (made := (site / f"{path.stem}.html").read_text(encoding="utf-8").split("<article")[1]), path.name
        assert "The site shows" not in made, path.name
    assert "Set up and test" in (site / "contributing.html").read_text(encoding="utf-8")
    assert "One command from a video to a scene" in (site / "changelog.html").read_text(encoding="utf-8")


def test_the_site_shows_docstrings(site):
    page = (site / "api.html").read_text(encoding="utf-8")
    for name in ("splatting.api.rasterize", "gaussians.gaussians4d.Gaussians4D", "scenes.scene.Scene", "pipeline.python_run.run"):
        assert f'id="flowsplat.{name}"' in page


def test_the_site_shows_the_sheet_that_the_studio_shows(site):
    sheet = (TOP / "src/flowsplat/studio/assets/filming.html").read_text(encoding="utf-8")
    sentences = re.findall(r"<li><b>.*?</li>", sheet)
    assert len(sentences) == 7
    page = (site / "filming.html").read_text(encoding="utf-8")
    assert all(sentence in page for sentence in sentences)


def test_what_the_pages_quote_is_what_we_say():
    said = "\n".join(_texts(Path(flowsplat.__file__).parent))
    quoted = re.findall("“([^”]+)”", (DOCS / "why_clips_fail.md").read_text(encoding="utf-8"))
    assert len(quoted) > 20
    assert [text for text in quoted if text not in said] == []


def test_every_sentence_on_cameras_is_explained():
    page = (DOCS / "why_clips_fail.md").read_text(encoding="utf-8")
    quoted = re.findall("“([^”]+)”", page)
    tree = ast.parse((Path(flowsplat.__file__).parent / "priors/cameras/checks.py").read_text(encoding="utf-8"))
    function = next(node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == "verdict")
    sentences = [text for text in _strings(function) if text.endswith(".") and text.count(" ") > 3 and "\n" not in text]
    praise = ("pixels (median), field of view", " degrees.")
    unexplained = [text for text in sentences if not any(q in text or text.strip() in q for q in (*quoted, *praise))]
    assert len(sentences) > 7
    assert unexplained == []


def test_the_results_pages_say_what_the_records_say():
    pages = format_pages(Records(read_records(DOCS / "results" / "records")))
    assert {path.stem for path in (DOCS / "results").glob("*.md")} == set(pages)
    for name, text in pages.items():
        path = DOCS / "results" / f"{name}.md"
        assert path.read_text(encoding="utf-8") == text, (
            f"{name}: write it anew, flowsplat benchmark all DATA -o OUT --report-only --docs docs/results"
        )
        assert path.stat().st_size < 8192, name
    assert len(pages["index"].splitlines()) < 60, "it is to be seen on one screen"


def test_no_image_is_left_over():
    pages = "".join(path.read_text(encoding="utf-8") for path in [*DOCS.rglob("*.md"), TOP / "README.md"])
    assert [path.name for path in (DOCS / "images").iterdir() if path.name not in pages] == []


def test_the_links_of_the_readme():
    text = (TOP / "README.md").read_text(encoding="utf-8")
    for address in re.findall(r"\]\(([^)#]+)", text):
        if not urlsplit(address).scheme:
            assert (TOP / address).exists(), address


def _texts(package: Path) -> list[str]:
    found = []
    for path in sorted(package.rglob("*.py")):
        found += _strings(ast.parse(path.read_text(encoding="utf-8")))
    return found


def _strings(tree: ast.AST) -> list[str]:
    """All strings, the parts of an f-string as far as nothing is put in between."""
    return [node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)]


def test_the_same_browsers_are_looked_for_everywhere():
    def names(file: str, variable: str) -> tuple[str, ...]:
        tree = ast.parse((TOP / file).read_text())
        assigned = (node for node in tree.body if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == variable)
        return ast.literal_eval(next(assigned).value)

    wanted = names("tests/browser.py", "NAMES")
    assert names("docs/tools/images.py", "PROGRAMS") == wanted
    assert names("docs/tools/images.py", "FLAGS") == names("tests/browser.py", "FLAGS")
    assert f"command -v {' '.join(wanted)} " in (TOP / ".ci" / "run").read_text()
