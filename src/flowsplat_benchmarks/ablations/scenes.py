"""The scenes of the ablations: found under a data root, prepared once, and shared by all of its runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from flowsplat.common.errors import InputError
from flowsplat_benchmarks.datasets.cases import Case, davis_cases, rig_cases
from flowsplat_benchmarks.roots import open_root, require_scenes
from flowsplat_benchmarks.shared_scenes import prepare_scene

FOLDER = "scenes"
"""In OUT, where the prepared scenes are."""


@dataclass(frozen=True)
class AblationScene:
    """A scene under a data root.

    Attributes:
        case: its input, split and priors: a clip of DAVIS with given masks, or a rendered scene with true priors.
        size: long side in pixels; 0 = as it is, None for a rendered scene, which keeps its own.
    """

    case: Case
    size: int | None

    @property
    def name(self) -> str:
        """Of the scene, its size and what is held out where that is chosen, for files."""
        sized = self.case.scene if self.size is None else f"{self.case.scene}_{self.size}"
        return f"{sized}_gaps" if self.case.config.input.holdout_frames else sized

    def prepare(self, out: Path) -> Path:
        """Return the prepared scene in ``out``; what is missing of it is computed.

        Raises:
            InputError: the input cannot be used.
        """
        return prepare_scene(self.case, out / FOLDER / self.name)


def choose_scenes(root: Path, known: Sequence[AblationScene], names: Sequence[str]) -> list[AblationScene]:
    """Return those called ``names`` among the scenes of a data root.

    Raises:
        InputError: there is no scene of that name.
    """
    by_name = {scene.case.scene: scene for scene in known}
    require_scenes(root, names, by_name)
    return [by_name[name] for name in dict.fromkeys(names)]


def ablation_scenes(root: Path, size: int) -> list[AblationScene]:
    """Return all scenes under a data root.

    Args:
        size: long side in pixels of clips of DAVIS; 0 = as they are.

    Raises:
        InputError: no such folder.
    """
    open_root(root, "davis/ and rig/")
    known: dict[str, AblationScene] = {}
    for find, wanted in ((davis_cases, size), (partial(rig_cases, priors="true"), None)):
        try:
            cases = find(root)
        except InputError:
            continue  # A root may hold one kind only.
        for case in cases:
            options = case.config.input if wanted is None else replace(case.config.input, resize=wanted)
            known.setdefault(case.scene, AblationScene(replace(case, config=replace(case.config, input=options)), wanted))
    return list(known.values())
