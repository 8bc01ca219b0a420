"""Define the cases of each protocol: the scenes under a data root, and the settings that the protocol fixes.

| protocol | looked for under DATA_ROOT | test |
| --- | --- | --- |
| davis | ``davis/<clip>/images`` (and ``masks``), or DAVIS itself (``JPEGImages/480p``) | every tenth frame, never the last |
| rig | ``rig/<scene>`` | the held-out cameras; all frames train |
| nvidia | ``nvidia/<scene>`` in one of three forms (``scenes/formats/nvidia.py``, ``nerfies.py``) | the other cameras |
| dycheck | ``dycheck/<scene>`` with ``camera/`` and ``splits/`` (``nerfies.py``) | the other cameras, where the clip saw the same |

Without a folder of that name the root itself is searched. What the protocol fixes is the input (all frames, their size, the
split) and the baselines; how it is trained is free.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from flowsplat.common.errors import InputError
from flowsplat.common.settings import flat, to_plain
from flowsplat.pipeline import RunConfig, preset
from flowsplat.scenes.clip import InputOptions
from flowsplat.scenes.formats.davis import IMAGES, sequence_folders
from flowsplat.scenes.formats.images import read_input_image
from flowsplat.scenes.formats.nerfies import is_nerfies
from flowsplat.scenes.formats.nvidia import RAW_IMAGES, is_nvidia
from flowsplat.scenes.ingest import open_clip
from flowsplat.training.config import select_result_settings
from flowsplat_benchmarks.datasets.learned_like import StandIn
from flowsplat_benchmarks.priors.scenes import TUNED
from flowsplat_benchmarks.roots import open_root, require_scenes

ALL_FRAMES = InputOptions(every=1, max_frames=100_000)
NSFF_TIMES, NSFF_HEIGHT = 24, 288
"""Frames, and pixels of height, of the protocol of NSFF."""
TWELVE_WIDTH = 480
"""Pixels of width of the protocol with twelve images."""
MARBLES_SCALE = 2
"""Dynamic Gaussian Marbles measures on images of half the size, and so does DyCheck."""
OWN_SUFFIX = "-own"
"""Behind the name of a rendered scene whose priors are our own, where it stands beside the same with true ones."""

ProtocolName = Literal["davis", "rig", "nvidia", "dycheck"]
FORMS = {
    "nerfies": "Marbles' form, half size",
    "twelve": "twelve images, 480x270",
    "raw": "NSFF's form, height 288",
}
"""Forms of an NVIDIA scene, for people."""


@dataclass(frozen=True)
class Case:
    """One run of a protocol.

    Attributes:
        protocol: which.
        scene: its name.
        form: of an NVIDIA scene, a key of ``FORMS``; else empty.
        variant: what of the priors is given, for people: ``given masks``.
        settings: the preset, and what differs from it, for people.
        source: the input.
        config: every setting of the run.
        lent: an input with masks, and how to open it: those of held-out frames are shown to the evaluation, and to nothing else.
    """

    protocol: ProtocolName
    scene: str
    form: str
    variant: str
    settings: str
    source: Path
    config: RunConfig
    lent: tuple[Path, InputOptions] | None = None

    @property
    def name(self) -> str:
        """Name of its folder and files."""
        parts = (self.scene, self.form, self.variant, self.settings.split(",")[0])
        return "_".join(re.sub(r"[^\w.-]+", "-", part) for part in parts if part)

    @property
    def is_tuned(self) -> bool:
        """Whether settings were chosen on this scene."""
        return self.scene.removesuffix(OWN_SUFFIX) in TUNED


def protocol_config(name: str, config: RunConfig | None, holdout: int | None) -> tuple[RunConfig, str]:
    """Return the settings of a run on all frames of its input, and their name: the preset, and what differs from it in training.

    Args:
        config: with the training and the device to use; None = the preset's.
        holdout: every how many frames one is held out; None = none.
    """
    start = preset(name)
    config = config or start
    base, wanted = flat(to_plain(start.train)), select_result_settings(flat(to_plain(config.train)))
    changed = [f"{key} {value}" for key, value in wanted.items() if base.get(key) != value]
    options = replace(ALL_FRAMES, holdout=holdout)
    fixed = replace(config, input=options, priors=RunConfig().priors, baselines="all", refine_poses=True, final_fit=False)
    return fixed, ", ".join([name, *changed])


def _places(root: Path, group: str) -> list[Path]:
    """Return the folders to look at, sorted by name."""
    root = open_root(root, f"{group}/")
    parent = root / group if (root / group).is_dir() else root
    return sorted(path for path in parent.iterdir() if path.is_dir())


def _choose_cases(root: Path, cases: Sequence[Case], names: Sequence[str], looked_for: str) -> list[Case]:
    if not cases:
        raise InputError(f"{root} holds no scenes: looked for {looked_for}.")
    require_scenes(root, names, [case.scene for case in cases])
    return [case for case in cases if not names or case.scene in names]


# -- DAVIS


def davis_cases(
    root: Path,
    names: Sequence[str] = (),
    masks: Literal["given", "own"] = "given",
    preset_name: str = "default",
    config: RunConfig | None = None,
) -> list[Case]:
    """Return the clips of DAVIS, or of that form. One without masks runs with its own, whatever ``masks`` says.

    Raises:
        InputError: no such folder, no clips in it, or none of that name.
    """
    config, settings = protocol_config(preset_name, config, holdout=10)
    cases = []
    for name, with_masks, images, options in _davis_clips(Path(root), config.input):
        given = with_masks is not None and masks == "given"
        source = with_masks if given else images
        assert source is not None
        case = Case(
            "davis", name, "", "given masks" if given else "own masks", settings, source,
            replace(config, input=options if given else config.input),
            lent=(with_masks, options) if with_masks is not None and not given else None,
        )  # fmt: skip
        cases.append(case)
    return _choose_cases(root, cases, names, f"davis/*/images and {IMAGES}")


def _davis_clips(root: Path, options: InputOptions) -> Iterator[tuple[str, Path | None, Path, InputOptions]]:
    """Yield (name, the input with masks or None, the folder of the images, how to open the input with masks)."""
    for path in _places(root, "davis"):
        if (path / "images").is_dir():
            yield path.name, path if (path / "masks").is_dir() else None, path / "images", options
    for base in (root, root / "davis"):
        if (base / IMAGES).is_dir():
            for path in sorted((base / IMAGES).iterdir()):
                if path.is_dir():
                    images, masks = sequence_folders(base, path.name)
                    yield path.name, base if masks else None, images, replace(options, sequence=path.name)


# -- rig


def rig_cases(
    root: Path,
    names: Sequence[str] = (),
    priors: Literal["true", "own", "learned-like"] = "own",
    preset_name: str = "default",
    config: RunConfig | None = None,
    stand_in: tuple[StandIn, Path] | None = None,
) -> list[Case]:
    """Return rendered scenes with truth and held-out cameras.

    Args:
        stand_in: with ``learned-like`` priors, which, and the folder that they are written into.

    Raises:
        InputError: no such folder, no scenes in it, or none of that name.
    """
    config, settings = protocol_config(preset_name, config, holdout=None)
    if priors != "learned-like":
        config = replace(config, priors=replace(config.priors, priors=priors))
    cases = [
        Case("rig", path.name, "", f"{priors} priors", settings, path, config)
        for path in _places(root, "rig")
        if (path / "rgb").is_dir() and (path / "cameras.json").exists()
    ]
    chosen = _choose_cases(root, cases, names, "rig/*/rgb with cameras.json")
    if stand_in is None:
        return chosen
    what, folder = stand_in
    return [
        replace(
            case, variant=what.words,
            config=replace(config, priors=what.give(case.source, config.input, folder / case.scene, config.priors)),
        )
        for case in chosen
    ]  # fmt: skip


# -- NVIDIA


def nvidia_cases(
    root: Path, names: Sequence[str] = (), preset_name: str = "default", config: RunConfig | None = None
) -> list[Case]:
    """NVIDIA Dynamic Scenes in any of their forms, each under the protocol that is usual for its form.

    Raises:
        InputError: no such folder, no scenes in it, or none of that name.
    """
    config, settings = protocol_config(preset_name, config, ALL_FRAMES.holdout)
    cases = []
    for path in _places(root, "nvidia"):
        form = _form(path)
        if form:
            own = replace(config, input=_nvidia_input(path, form))
            cases.append(Case("nvidia", path.name, form, "given cameras", settings, path, own))
    return _choose_cases(root, cases, names, "nvidia/* with poses_bounds.npy, or with camera/ and splits/")


# -- DyCheck


def dycheck_cases(
    root: Path, names: Sequence[str] = (), preset_name: str = "default", config: RunConfig | None = None
) -> list[Case]:
    """Return the scenes of DyCheck: all frames of the clip train, at half of their size.

    Raises:
        InputError: no such folder, no scenes in it, or none of that name.
    """
    config, settings = protocol_config(preset_name, config, ALL_FRAMES.holdout)
    cases = [
        Case("dycheck", path.name, "", "given cameras", settings, path, replace(config, input=_nvidia_input(path, "nerfies")))
        for path in _places(root, "dycheck")
        if is_nerfies(path)
    ]
    return _choose_cases(root, cases, names, "dycheck/* with camera/ and splits/")


def _form(path: Path) -> str:
    if is_nerfies(path):
        return "nerfies"
    if is_nvidia(path):
        return "raw" if (path / RAW_IMAGES).is_dir() else "twelve"
    return ""


def _nvidia_input(path: Path, form: str) -> InputOptions:
    if form == "twelve":
        return replace(ALL_FRAMES, resize=TWELVE_WIDTH)
    try:
        if form == "raw":
            height, width = read_input_image(path / RAW_IMAGES / "00000" / "cam01.jpg").shape[:2]
            long_side = round(NSFF_HEIGHT * max(width, height) / height)
            return replace(ALL_FRAMES, max_frames=NSFF_TIMES, resize=long_side)
        clip = open_clip(path, replace(ALL_FRAMES, resize=0))
        return replace(ALL_FRAMES, resize=max(clip.width, clip.height) // MARBLES_SCALE)
    except InputError:
        return ALL_FRAMES  # The run says what is wrong with it, and the other scenes go on.
