"""What is installed to test and to release is what was tested: everything is pinned, with its hash."""

from __future__ import annotations

import re
import tarfile
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SUFFIXES = {".py", ".typed", ".json", ".jinja", ".js", ".css", ".html", ".vert", ".frag", ".glsl"}
"""Of the files that the packages consist of."""


def locked_in(name: str) -> dict[str, str]:
    """The lines of a lock file, by the name and version that they begin with."""
    lock = (ROOT / name).read_text().replace("\\\n", " ")
    return {line.split()[0]: line for line in lock.splitlines() if line.strip()}


def test_the_lock_has_every_pin_and_a_hash_for_each():
    locked = locked_in("requirements.lock")
    assert all("--hash=sha256:" in line for line in locked.values())
    pins = {line.split(";")[0].strip() for line in (ROOT / "constraints.txt").read_text().splitlines() if line and line[0] != "#"}
    assert {pin for pin in pins if pin not in locked} == {pin for pin in pins if pin.startswith("torch==")}


def test_the_lock_of_those_who_only_use_it_names_the_same():
    whole, part = (
        {name: set(re.findall(r"sha256:\w+", line)) for name, line in locked_in(file).items()}
        for file in ("requirements.lock", "requirements.view.lock")
    )
    assert {name: whole.get(name) for name in part} == part
    assert all(part.values())
    versions = {name.partition("==")[0] for name in part}
    dependencies = (ROOT / "pyproject.toml").read_text().partition("\ndependencies = [")[2].partition("\n]")[0]
    wanted = {*re.findall(r'"([\w-]+)>=', dependencies), "viser", "tornado"}
    assert wanted - versions == {"torch"}
    assert not versions & {"pytest", "ruff", "mypy", "playwright"}


def test_it_is_what_is_installed():
    makefile = (ROOT / "Makefile").read_text()
    install = makefile.partition("define install")[2].partition("endef")[0]
    assert all(f"{program} install" in install for program in ("uv pip", "python -m pip"))
    for packages in ("--no-deps --require-hashes -r requirements.lock", "--no-deps --no-build-isolation -e ."):
        assert f"$(call install,{packages})" in makefile
    assert "pip install --quiet --require-hashes -r requirements.uv.lock" in makefile
    image = (ROOT / "Dockerfile").read_text()
    assert "--no-deps --require-hashes -r requirements.view.lock" in image
    assert "--no-deps --no-build-isolation ." in image


def test_both_packages_are_installed():
    """``pip install`` installs the benchmarks beside flowsplat."""
    pyproject = (ROOT / "pyproject.toml").read_text()
    packages = re.findall(r'"([^"]+)"', pyproject.partition("\npackages = [")[2].partition("]")[0])
    assert packages == sorted(path.parent.relative_to(ROOT).as_posix() for path in (ROOT / "src").glob("*/__init__.py"))


def files_of(folder: Path) -> set[str]:
    """Everything below it but what Python compiles, by name."""
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts}


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> tuple[Path, Path]:
    """The wheel and the archive of the sources, of this tree."""
    building = pytest.importorskip("hatchling.build", reason="hatchling is not installed: pip install hatchling")
    folder = tmp_path_factory.mktemp("built")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        return folder / building.build_wheel(str(folder)), folder / building.build_sdist(str(folder))


def test_the_wheel_has_both_packages_whole_and_nothing_else(built):
    with zipfile.ZipFile(built[0]) as wheel:
        names = set(wheel.namelist())
        about = next(name for name in names if name.endswith(".dist-info/METADATA")).removesuffix("METADATA")
        metadata = Parser().parsestr(wheel.read(f"{about}METADATA").decode())
        points = wheel.read(f"{about}entry_points.txt").decode()
        license_text = wheel.read(f"{about}licenses/LICENSE").decode()
    assert {name for name in names if not name.startswith(about)} == files_of(ROOT / "src")
    assert {Path(name).suffix for name in names if not name.startswith(about)} == SUFFIXES
    assert sum(name.endswith(".jinja") for name in names) > 5
    assert "flowsplat = flowsplat.cli:main" in points
    assert license_text == (ROOT / "LICENSE").read_text()
    assert metadata["License-Expression"] == "Apache-2.0"
    assert metadata["Requires-Python"] == ">=3.10"
    assert built[0].name.endswith("-py3-none-any.whl")
    assert built[0].stat().st_size < 2_500_000


def test_the_sources_can_be_built_and_tested_from_their_archive(built):
    with tarfile.open(built[1]) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    wanted = {f"src/{name}" for name in files_of(ROOT / "src")} | {f"tests/{name}" for name in files_of(ROOT / "tests")}
    assert wanted - names == set()
    assert {"pyproject.toml", "README.md", "LICENSE", "CHANGELOG.md", "constraints.txt", "Makefile"} <= names
    assert [name for name in names if name.startswith((".git/", ".venv", "out/", "shared/"))] == []
