"""The licenses of what is installed."""

from __future__ import annotations

import re
from importlib.metadata import PathDistribution
from pathlib import Path

import pytest

from flowsplat.common.errors import InputError
from flowsplat.common.licenses import NOT_SAID, list_licenses, read_license

ROOT = Path(__file__).parents[2]


def make_package(folder: Path, name: str, *lines: str) -> PathDistribution:
    """The metadata of an installed package."""
    path = folder / f"{name}-1.0.dist-info"
    path.mkdir()
    (path / "METADATA").write_text("\n".join(["Metadata-Version: 2.4", f"Name: {name}", "Version: 1.0", *lines, "", ""]))
    return PathDistribution(path)


def test_every_dependency_is_listed():
    found = {each.name.lower(): each for each in list_licenses()}
    asked = (ROOT / "pyproject.toml").read_text().partition("\ndependencies = [")[2].partition("\n]")[0]
    names = re.findall(r'"([\w-]+)>=', asked)
    assert len(names) > 8
    assert [name for name in [*names, "flowsplat"] if name not in found] == []
    assert found["flowsplat"].license == "Apache-2.0"
    assert found["numpy"].license != NOT_SAID


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        (["License-Expression: MIT OR Apache-2.0", "License: other"], "MIT OR Apache-2.0"),
        (["License: see the file", "Classifier: License :: OSI Approved :: BSD License"], "BSD License"),
        (["License: MIT"], "MIT"),
        ([f"License: {'Permission is hereby granted ' * 9}"], NOT_SAID),
        (["Classifier: License :: OSI Approved"], NOT_SAID),
        ([], NOT_SAID),
    ],
)
def test_a_license_is_what_the_package_says(tmp_path, lines, expected):
    assert read_license(make_package(tmp_path, "some", *lines)) == expected


def test_what_is_needed_is_followed(tmp_path, monkeypatch):
    make_package(tmp_path, "top", "Requires-Dist: Middle_one>=2", "Requires-Dist: chosen; extra == 'more'", "Requires-Dist: absent")
    make_package(tmp_path, "middle_one", "Requires-Dist: top", "Requires-Dist: unasked; extra == 'more'")
    for name in ("chosen", "unasked"):
        make_package(tmp_path, name)
    monkeypatch.syspath_prepend(tmp_path)
    assert [each.name for each in list_licenses("top")] == ["chosen", "middle_one", "top"]
    with pytest.raises(InputError, match="not installed"):
        list_licenses("absent")
