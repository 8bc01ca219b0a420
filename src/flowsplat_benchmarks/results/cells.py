"""List the cells: what is measured for the results pages, with an estimate of how long each takes."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from flowsplat.common.errors import InputError
from flowsplat_benchmarks.ablations.benchmark import SEEDS as ABLATION_SEEDS
from flowsplat_benchmarks.ablations.claims import FULL, PAPER_ORDERS, choose_claims, list_needed_variants
from flowsplat_benchmarks.datasets.cases import OWN_SUFFIX
from flowsplat_benchmarks.models.lineup import BASE, LINEUP

CLIP_SIDE = 427
"""Long side in pixels of what is measured of clips at half size."""
MASKED_CLIPS = ("bear", "train", "camel", "lucia", "dance-twirl")
"""Clips of DAVIS of which masks are given."""
CLIPS = (*MASKED_CLIPS, "lady-running")
RENDERED = ("workshop", "garden", "street", "market")
PAIR = "rubberwhale"
ABLATION_SCENES = ("bear", "workshop")
OWN_ROWS = ("no-gains", "one-color", "spheres", "even-detail", "samples-7", "even-rates", "no-coverage", "no-depth", "static")
"""Rows of the ablations beside the paper's own: what we added, and a scene that stands still."""
PAPER_ROWS = ("representation", "training", "orders")
MODEL_SCENES = ("bear", "street", "workshop", f"street{OWN_SUFFIX}", "dance-twirl")
MODEL_SEEDS = {"bear": (0, 1), "street": (0, 1)}
"""Seeds of the series and the splines, by scene; one seed where it is not named, and of the other models."""
FIELD_TIMES = (1, 10)
"""How many times as long as ``default`` each field is trained."""
ORACLES = ("own", "outline", "background")
"""Of benchmark oracles: own priors; masks and depth of objects true; depth of what rests true, too."""
CAPS = (50_000, 100_000, 0)
"""Gaussians at most; 0 = as many as ``default`` takes."""
STEP_COUNTS = (400, 800, 3200)
WORLDS = {"plain": range(900, 910), "crowd": range(900, 905), "dancers": range(900, 905)}
"""Seeds of random worlds by their kind. Those from 900 on decide between versions."""
GROWTH = {"frames": (100, 200, 400, 800), "pixels": (427, 640, 854)}
"""Runs of the built-in clip: so many frames of 320 pixels, and 16 frames with so many pixels of the long side."""
MODEL_SECONDS = {"series": 100, "linear": 170, "splines": 115, "marbles": 80, "bases": 145, "deformation": 290, "hexplane": 390}
"""Estimates of a training with each model."""


@dataclass(frozen=True)
class Cell:
    """One benchmark on one clip with one seed.

    Attributes:
        benchmark: which.
        scene: its clip, rendered scene or world.
        variant: what else tells it from others of that benchmark.
        seed: of every random choice.
        seconds: how long it takes, about, on two cores of an AMD EPYC by two threads.
        needs: the folder of the data root that holds the scene; empty = it is drawn.
    """

    benchmark: str
    scene: str
    variant: str
    seed: int
    seconds: float
    needs: str = ""

    @property
    def folder(self) -> str:
        """Of its scene, below the data root."""
        return f"{self.needs}/{self.scene.removesuffix(OWN_SUFFIX)}"

    @property
    def name(self) -> str:
        """Of its file."""
        parts = (self.benchmark, self.scene, self.variant, f"seed{self.seed}")
        return "_".join(re.sub(r"[^\w.-]+", "-", part) for part in parts if part)


def list_cells() -> list[Cell]:
    """Return all cells, short ones first, so that a night that is too short has left out as few as possible."""
    return sorted(_cells(), key=lambda cell: cell.seconds)


def choose_cells(cells: Sequence[Cell], only: Sequence[str], seeds: Sequence[int]) -> list[Cell]:
    """Return the cells that are asked for.

    Args:
        only: benchmarks, scenes or whole names of cells; none = all.
        seeds: none = all.

    Raises:
        InputError: no cell has such a name or seed.
    """
    for word in only:
        if not any(_is_called(cell, word) for cell in cells):
            known = ", ".join(dict.fromkeys(cell.benchmark for cell in cells))
            raise InputError(
                f"--only {word}: no benchmark, scene or cell is called so. Benchmarks are {known}; --dry-run lists cells."
            )
    for seed in seeds:
        if all(cell.seed != seed for cell in cells):
            raise InputError(f"--seeds {seed}: cells have the seeds {', '.join(map(str, sorted({cell.seed for cell in cells})))}.")
    return [
        cell for cell in cells if (not only or any(_is_called(cell, word) for word in only)) and (not seeds or cell.seed in seeds)
    ]


def _is_called(cell: Cell, word: str) -> bool:
    return word in (cell.benchmark, cell.scene, cell.name)


def _cells() -> Iterator[Cell]:
    for name in CLIPS:
        for seed in (0, 1):
            yield Cell("davis", name, f"given-{CLIP_SIDE}", seed, 280, "davis")
        yield Cell("davis", name, "given", 0, 950, "davis")
    for name in ("bear", "train", "lucia"):
        yield Cell("davis", name, f"own-{CLIP_SIDE}", 0, 300, "davis")
    for name in RENDERED:
        yield Cell("rig", name, "true", 0, 260, "rig")
        for seed in (0, 1):
            yield Cell("rig", name, "own", seed, 330, "rig")
        yield Cell("priors", name, "", 0, 100, "rig")
    yield Cell("priors", PAIR, "", 0, 10, "flow")
    for name in MASKED_CLIPS:
        yield Cell("priors", name, "", 0, 180, "davis")
    for name in ("workshop", "garden"):
        for oracle in ORACLES:
            yield Cell("oracles", name, oracle, 0, 200, "rig")
    yield from _trainings()
    for kind, seeds in WORLDS.items():
        for world in seeds:
            yield Cell("objects", f"{kind}-{world}", "", 0, 90)
    for kind, counts in GROWTH.items():
        for count in counts:
            yield Cell("growth", f"{kind}-{count}", "", 0, 60 + (count if kind == "frames" else count / 10))
    yield Cell("demo", "street", "", 0, 110)


def _trainings() -> Iterator[Cell]:
    """Cells that share prepared scenes."""
    folders = dict.fromkeys(CLIPS, "davis") | dict.fromkeys(RENDERED, "rig")
    of_paper = {variant.name for variant in list_needed_variants(choose_claims(PAPER_ROWS))} | {FULL.name, PAPER_ORDERS.name}
    for name in ABLATION_SCENES:
        for variant in list_needed_variants(choose_claims((*PAPER_ROWS, *OWN_ROWS))):
            for seed in ABLATION_SEEDS if variant.name in of_paper else (0,):
                yield Cell("ablations", name, variant.name, seed, 60 if variant.name == "static" else 130, folders[name])
    for name in MODEL_SCENES:
        for entrant in LINEUP:
            kind = entrant.variant.name
            for seed in MODEL_SEEDS.get(name, (0,)) if kind in (BASE.variant.name, "splines") else (0,):
                yield Cell("models", name, kind, seed, MODEL_SECONDS[kind], folders[name.removesuffix(OWN_SUFFIX)])
    for name in ABLATION_SCENES:
        for cap in CAPS:
            yield Cell("caps", name, f"{cap or 'free'}", 0, {50_000: 70, 100_000: 100, 0: 150}[cap], folders[name])
        for count in STEP_COUNTS:
            yield Cell("caps", name, f"{count}-steps", 0, 20 + count / 10, folders[name])
    for field in ("t-nerf", "hypernerf"):
        for times in FIELD_TIMES:
            yield Cell("fields", "bear", name_field(field, times), 0, 470 + 35 * times, "davis")


def name_field(field: str, times: int) -> str:
    """Return the variant of a cell of fields: which field, and how many times as long as ``default`` it is trained."""
    return field if times == 1 else f"{field}-{times}-times"
