"""What is installed to test and to release is what was tested: everything is pinned, with its hash."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]


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
