"""The scenes of a study: found under a data root, prepared once, and shared by all of its runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

from flowsplat.common.errors import InputError
from flowsplat.pipeline import prepare
from flowsplat.protocols.process import in_own_process
from flowsplat.protocols.roots import open_root, require_scenes
from flowsplat.protocols.runs.cases import Case, davis_cases, rig_cases

FOLDER = "scenes"
"""In OUT, where the prepared scenes are."""


@dataclass(frozen=True)
class StudyScene:
    """A scene under a data root.

    Attributes:
        case: its input, split and priors: a clip of DAVIS with given masks, or a rendered scene with true priors.
        size: long side in pixels; 0 for a rendered scene, which keeps its own.
    """

    case: Case
    size: int

    @property
    def name(self) -> str:
        """Of the scene and its size, for files."""
        return f"{self.case.scene}_{self.size}" if self.size else self.case.scene

    def prepared(self, out: Path) -> Path:
        """The prepared scene in ``out``; what is missing of it is computed, and looked for only once.

        Raises:
            InputError: the input cannot be used.
        """
        return _prepared(self.case, out / FOLDER / self.name)


@cache
def _prepared(case: Case, folder: Path) -> Path:
    return in_own_process(_prepare, case, folder)


def _prepare(case: Case, folder: Path) -> Path:
    return prepare(case.source, folder, case.config).scene_path


def study_scenes(root: Path, names: Sequence[str], size: int) -> list[StudyScene]:
    """The scenes called ``names`` under a data root.

    Args:
        size: long side in pixels of clips of DAVIS.

    Raises:
        InputError: no such folder, or no scene of that name.
    """
    open_root(root, "davis/ and rig/")
    known: dict[str, StudyScene] = {}
    for find, wanted in ((davis_cases, size), (partial(rig_cases, priors="true"), 0)):
        try:
            cases = find(root)
        except InputError:
            continue  # A root may hold one kind only.
        for case in cases:
            options = replace(case.config.input, resize=wanted) if wanted else case.config.input
            known.setdefault(case.scene, StudyScene(replace(case, config=replace(case.config, input=options)), wanted))
    require_scenes(root, names, known)
    return [known[name] for name in dict.fromkeys(names)]
