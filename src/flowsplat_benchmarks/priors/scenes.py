"""The scenes of the priors benchmark: what lies under a data root.

| folder | kind | truth |
| --- | --- | --- |
| ``rig/<scene>`` | ``rig``: a rendered scene (``scenes/formats/rig.py``) | flow, cameras, depth, masks, tracks |
| ``davis/<clip>/images``, ``davis/<clip>/masks`` | ``davis``: a real clip | masks |
| ``flow/<pair>/frame10.png``, ``frame11.png``, ``flow10.flo`` | ``pair``: two real images (Middlebury) | flow |
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from flowsplat.common.errors import InputError
from flowsplat_benchmarks.roots import open_root, require_scenes

TUNED = frozenset({"bear", "camel", "train", "workshop", "garden", "street", "market", "rubberwhale"})
"""Scenes on which settings were chosen; all others are only reported."""
TRUE_FLOW = "flow10.flo"

Kind = Literal["rig", "davis", "pair"]


@dataclass(frozen=True)
class BenchmarkScene:
    """A scene under the data root: ``folder`` is its own, ``source`` what the priors may see of it."""

    name: str
    kind: Kind
    folder: Path

    @property
    def source(self) -> Path:
        """The input: of a DAVIS clip only the images, because its masks are the truth."""
        return self.folder / "images" if self.kind == "davis" else self.folder

    @property
    def is_tuned(self) -> bool:
        """Whether settings were chosen on it."""
        return self.name in TUNED


def find_scenes(root: Path) -> list[BenchmarkScene]:
    """Return all scenes under the data root, in the order of the table above.

    Raises:
        InputError: there is no such folder, or nothing in it.
    """
    root = open_root(root, "rig/, davis/ and flow/")
    needs: list[tuple[str, Kind, tuple[str, ...]]] = [
        ("rig", "rig", ("rgb", "cameras.json")),
        ("davis", "davis", ("images", "masks")),
        ("flow", "pair", (TRUE_FLOW,)),
    ]
    found = [
        BenchmarkScene(path.name, kind, path)
        for group, kind, files in needs
        if (root / group).is_dir()
        for path in sorted((root / group).iterdir())
        if all((path / file).exists() for file in files)
    ]
    if not found:
        raise InputError(f"{root} holds no scenes: looked for rig/*/rgb, davis/*/images with masks, and flow/*/{TRUE_FLOW}.")
    names = [scene.name for scene in found]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(f"{root} has two scenes called {twice[0]}: rename one of them.")
    return found


def choose_scenes(root: Path, names: Sequence[str]) -> list[BenchmarkScene]:
    """Return the scenes called ``names``, or all of them where there are none.

    Raises:
        InputError: as ``find_scenes``, or there is no scene of that name.
    """
    found = {scene.name: scene for scene in find_scenes(root)}
    require_scenes(root, names, found)
    return [scene for name, scene in found.items() if not names or name in names]
