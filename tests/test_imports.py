"""The way of the data is the way of the imports: every package may only use the packages before it."""

import ast
import graphlib
from collections.abc import Iterator
from pathlib import Path

import pytest

import flowsplat

PACKAGE = Path(flowsplat.__file__).parent
BENCHMARKS = "flowsplat_benchmarks"
"""The package beside it, which may import it, but never the other way round."""

FIRST = ("common", "images", "geometry")
MAY_IMPORT = {
    "common": (),
    "images": ("common",),
    "geometry": ("common", "images"),
    # Splatting knows no time and no video, scenes know no splats.
    "splatting": FIRST,
    "scenes": FIRST,
    "priors": (*FIRST, "scenes"),
}
for name in ("gaussians", "training", "evaluation", "output", "pipeline", "batch", "studio", "cli"):
    MAY_IMPORT[name] = tuple(MAY_IMPORT)
# What stands in for operators of gsplat: nothing of ours needs it.
MAY_IMPORT["gsplat_ops"] = (*FIRST, "splatting")
MAY_IMPORT["__main__"] = tuple(MAY_IMPORT)
# ``flowsplat`` itself shows what its packages offer; commands are not for importing.
MAY_IMPORT["__init__"] = tuple(name for name in MAY_IMPORT if name not in ("cli", "__main__"))


def imported_packages(source: str, package: str) -> Iterator[tuple[int, str]]:
    """(line, package) of every import of flowsplat in ``source``, wherever in the file it stands; of its benchmarks, too.

    Args:
        package: the dotted package that the module is in, to resolve relative imports.
    """
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            targets = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")[: len(package.split(".")) + 1 - node.level] if node.level else []
            base = ".".join([*parents, *([node.module] if node.module else [])])
            targets = [f"{base}.{alias.name}" for alias in node.names] if base == "flowsplat" else [base]
        else:
            continue
        for target in targets:
            if target.split(".")[0] == "flowsplat":
                yield node.lineno, (target.split(".") + ["__init__"])[1]
            elif target.split(".")[0] == BENCHMARKS:
                yield node.lineno, BENCHMARKS


def violations(name: str, source: str) -> list[str]:
    """The offending lines of a module, given as ``package/module.py``."""
    parts = Path(name).with_suffix("").parts
    package = parts[0]
    if package not in MAY_IMPORT:
        return [f"{name}: {package!r} is no package that is listed (CONTRIBUTING.md)"]
    dotted = ".".join(["flowsplat", *parts[:-1]])
    lines = source.splitlines()
    return [
        f"{name}:{line}: {package} must not import {target}: {lines[line - 1].strip()}"
        for line, target in imported_packages(source, dotted)
        if target not in (package, *MAY_IMPORT[package], "__version__")
    ]


def test_imports_run_with_the_data():
    modules = sorted(PACKAGE.rglob("*.py"))
    assert modules
    found = [
        line for path in modules for line in violations(path.relative_to(PACKAGE).as_posix(), path.read_text(encoding="utf-8"))
    ]
    assert not found, "\n" + "\n".join(found)


@pytest.mark.parametrize(
    ("name", "source"),
    [
        ("scenes/layers.py", "from flowsplat.splatting import api"),
        ("splatting/api.py", "from flowsplat.scenes.scene import Scene"),
        ("priors/flow.py", "import flowsplat.gaussians.render"),
        ("training/trainer.py", "from flowsplat import evaluation"),
        ("training/trainer.py", "def f():\n    from ..output import report"),
        ("training/photometric_loss/cpu.py", "from ...output.report import write"),
        ("common/files.py", "from flowsplat.images import video"),
        ("pipeline.py", "from .cli import main"),
        ("geometry/cameras.py", "from flowsplat import Scene"),
        ("geometry/cameras.py", "import flowsplat"),
        ("__init__.py", "from flowsplat.cli import main"),
        ("extras/new.py", ""),
        ("cli/command.py", "from flowsplat_benchmarks.commands import davis"),
        ("cli/entry.py", "def f():\n    import flowsplat_benchmarks"),
    ],
)
def test_a_step_against_the_order_is_found(name, source):
    assert len(violations(name, source)) == 1


@pytest.mark.parametrize(
    ("name", "source"),
    [
        ("scenes/scene.py", "from flowsplat.scenes.layers import Layers\nfrom .layers import Depth"),
        ("gaussians/render.py", "from flowsplat.splatting.api import rasterize\nfrom flowsplat.scenes import Scene"),
        ("training/photometric_loss/cpu.py", "from ...splatting.cpu import simd\nfrom . import reference\nfrom .. import losses"),
        ("output/report.py", "from flowsplat import __version__, evaluation"),
        ("cli.py", "import flowsplat.batch.work\nimport numpy"),
    ],
)
def test_a_step_along_the_order_is_fine(name, source):
    assert violations(name, source) == []


@pytest.mark.parametrize(("package", "others"), [("background", ("masks", "depth")), ("masks", ("depth",)), ("depth", ("masks",))])
def test_the_priors_do_not_import_each_other_in_circles(package, others):
    """Masks and depth both use the static scene of ``priors.background``, and nothing of each other."""
    modules = sorted((PACKAGE / "priors" / package).glob("*.py"))
    assert modules
    imports = "\n".join(line for path in modules for line in path.read_text(encoding="utf-8").splitlines() if "import" in line)
    for other in others:
        assert f"priors.{other}" not in imports


def files_at_import(path: Path) -> set[Path]:
    """Files of both packages that importing this one imports, those under TYPE_CHECKING, too; not what its functions import.

    What the package as a whole offers (its ``__init__``) is named there for type checkers only.
    """
    body = list(ast.parse(path.read_text(encoding="utf-8")).body)
    if path != PACKAGE / "__init__.py":
        body += [inner for node in body if isinstance(node, ast.If) for inner in node.body]
    names = []
    for node in body:
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in ("flowsplat", BENCHMARKS):
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                names.append(inner if file_of(inner) else node.module)
        elif isinstance(node, ast.Import):
            names += [alias.name for alias in node.names if alias.name.split(".")[0] in ("flowsplat", BENCHMARKS)]
    return {file for name in names if (file := file_of(name)) and file != path}


def file_of(module: str) -> Path | None:
    """The file of a module of one of them."""
    base = PACKAGE.parent.joinpath(*module.split("."))
    return next((file for file in (base.with_suffix(".py"), base / "__init__.py") if file.is_file()), None)


def test_no_files_import_each_other_in_circles():
    graph = {path: files_at_import(path) for package in (PACKAGE, PACKAGE.parent / BENCHMARKS) for path in package.rglob("*.py")}
    assert sum(map(len, graph.values())) > 1000
    graphlib.TopologicalSorter(graph).prepare()
