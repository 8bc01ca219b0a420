"""List what flowsplat is installed with, and under which license each of it is, as the packages themselves say."""

from __future__ import annotations

import re
from dataclasses import dataclass
from importlib.metadata import Distribution, PackageNotFoundError, distribution

from flowsplat.common.errors import InputError

MAX_LICENSE_CHARS = 60
"""Characters up to which the field ``License`` is a name: some packages have the whole text there. Chosen by eye."""
NOT_SAID = "not said"
"""What stands where a package does not name its license."""


@dataclass(frozen=True)
class PackageLicense:
    """A package that is installed.

    Attributes:
        name: as it calls itself.
        version: of it.
        license: an SPDX expression or a name, ``NOT_SAID`` where its metadata has none.
    """

    name: str
    version: str
    license: str


def list_licenses(package: str = "flowsplat") -> list[PackageLicense]:
    """Return a package and all that it needs and is installed, in the order of their names; of its own extras, too.

    Raises:
        InputError: the package is not installed, as where only its source is on the path.
    """
    found: dict[str, PackageLicense] = {}
    waiting = [package]
    while waiting:
        name = waiting.pop()
        if _normalize(name) in found:
            continue
        try:
            installed = distribution(name)
        except PackageNotFoundError:  # of an extra that nobody asked for, or of another system
            continue
        found[_normalize(name)] = PackageLicense(installed.metadata["Name"], installed.version, read_license(installed))
        waiting += _list_requirements(installed, with_extras=name == package)
    if not found:
        raise InputError(f"{package} is not installed as a package, so nothing says what it needs: pip install -e .")
    return [found[name] for name in sorted(found)]


def read_license(installed: Distribution) -> str:
    """Return the license that the metadata of a package names: the expression, else the classifiers, else a short field."""
    metadata = installed.metadata
    if expression := metadata.get_all("License-Expression"):
        return expression[0]
    classifiers = [text.split(" :: ")[-1] for text in metadata.get_all("Classifier") or () if text.startswith("License :: ")]
    if named := [text for text in classifiers if text != "OSI Approved"]:
        return ", ".join(named)
    field = "".join(metadata.get_all("License") or ()).strip()
    return field if field and len(field) <= MAX_LICENSE_CHARS and "\n" not in field else NOT_SAID


def _list_requirements(installed: Distribution, with_extras: bool) -> list[str]:
    """Return the names of what a package asks for; a package that is asked for without extras does not ask for theirs."""
    names = []
    for requirement in installed.requires or ():
        words, _, condition = requirement.partition(";")
        if with_extras or "extra" not in condition:
            names.append(re.split(r"[^\w.-]", words.strip(), maxsplit=1)[0])
    return names


def _normalize(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()
