"""The tables of the paper beside ours, row by row: from the results that other benchmarks left, and what of it is not measured."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flowsplat.common.errors import InputError
from flowsplat.evaluation.scores import mean_of, pick
from flowsplat_benchmarks.ablations.claims import CLAIMS
from flowsplat_benchmarks.ablations.page import write_ablation_report
from flowsplat_benchmarks.datasets.tables import DIGITS, NAMES, read_published
from flowsplat_benchmarks.models.lineup import LINEUP
from flowsplat_benchmarks.resume import results_in
from flowsplat_benchmarks.tables import Result, Table, describe_version, text

TITLE = "The paper's tables beside ours"
NOT_MEASURED = "not measured"
NO_SCENES = "we do not have these scenes"
PROTOCOLS = ("davis", "nvidia", "ablations", "models", "fields")
METRICS = tuple(DIGITS)
FIELDS = {"T-NeRF": "t-nerf", "HyperNeRF": "hypernerf"}
"""Rows of the paper, and what benchmark fields calls them."""
MODELS = {entrant.paper.replace("Dynamic Gaussian Marbles", "DG Marbles"): entrant.variant.name for entrant in LINEUP}
"""Rows of the paper whose motion benchmark models has. The paper's Deformable 3DGS is Deformable 3D Gaussians."""
MODELS["Deformable 3DGS"] = MODELS.pop("Deformable 3D Gaussians")
OURS = "Flow Splatting"
MOTION_ALONE = "motion alone"
"""Behind the name of a method whose motion was measured in our trainer. Such rows compare with each other alone."""
REMARKS = (
    "Published figures are the paper's, of its own scenes, priors, hardware and splits; ours are of the scenes that are named, by "
    "this implementation. A row compares only as far as its last column allows. What was not measured says so.",
    "Rows *motion alone* are motion models, also that of Flow Splatting, in our trainer: same start, priors, losses and steps, "
    "held-out times in gaps (benchmark models). They compare with each other and with no other row, and are no reproduction of "
    "those systems.",
)


@dataclass(frozen=True)
class _Ours:
    """What was measured for a row: its results, where in each the scores are, and what differs from the paper."""

    results: Sequence[Result]
    path: tuple[str, ...]
    differs: str

    def score(self, metric: str, scene: str | None = None) -> str:
        """Return the mean over scenes, or over the runs of one of them."""
        chosen = [result for result in self.results if scene is None or str(result["scene"]).casefold() == scene.casefold()]
        scenes = dict.fromkeys(str(result["scene"]) for result in chosen)
        means = [mean_of(pick(each, *self.path, metric) for each in chosen if each["scene"] == name) for name in scenes]
        return _say(mean_of(means), DIGITS[metric])


def write_paper(folders: Sequence[Path], out: Path) -> Path:
    """Write ``OUT/paper.md`` and ``.html``, and return the path of the page.

    Args:
        folders: in which benchmarks left their results.

    Raises:
        InputError: a folder is none, or ``out`` cannot be written.
    """
    for folder in folders:
        if not folder.is_dir():
            raise InputError(f"{folder} is no folder: give those in which benchmarks left their results.")
    results = [result for protocol in PROTOCOLS for folder in folders for result in results_in(protocol, folder)]
    tables = list_tables(results)
    cells = [cell for table in tables for row in table.rows for cell in row]
    said = f"{len(results)} results; {cells.count(NOT_MEASURED)} cells are not measured."
    remarks = [*REMARKS, describe_version(results)] if results else list(REMARKS)
    return write_ablation_report(out, "paper", TITLE, said, remarks, tables, {})


def list_tables(results: Sequence[Result]) -> list[Table]:
    """Return the paper's Tables 1, 2, 3, 5 and 6, with ours in each."""
    known = read_published()
    return [
        _tabulate_nvidia(known["nvidia"], results),
        _tabulate_davis("Table 2: DAVIS, PSNR", known["davis"], results, "psnr"),
        _tabulate_ablation("Table 3a: representation", known["representation"], results),
        _tabulate_ablation("Table 3b: training", known["training"], results),
        *(
            _tabulate_davis(f"Table 5: DAVIS, {NAMES[metric].removesuffix(' (AlexNet)')}", known["davis"], results, metric)
            for metric in ("ssim", "lpips")
        ),
        _tabulate_ablation("Table 6: orders of the series", known["orders"], results),
    ]  # fmt: skip


def _say(value: float | None, digits: int) -> str:
    return NOT_MEASURED if value is None else text(value, digits)


def _of(results: Sequence[Result], protocol: str, variant: str | None = None) -> list[Result]:
    return [result for result in results if result["protocol"] == protocol and variant in (None, result["variant"])]


def _tell(results: Sequence[Result]) -> str:
    """Return the scenes of some results, with their seeds and steps where they have some."""
    scenes = ", ".join(sorted({f"{result['scene']} at {result['size'][0]}x{result['size'][1]}" for result in results}))
    steps = ", ".join(f"{count:,}" for count in sorted({result["iterations"] for result in results if "iterations" in result}))
    seeds = len({result["seed"] for result in results if "seed" in result})
    return scenes + (f"; {steps} steps" if steps else "") + (f"; {seeds} seeds" if seeds > 1 else "")


def _find_ours(method: str, results: Sequence[Result], scenes: Sequence[str]) -> _Ours:
    """Return what was measured on these scenes of a method's motion or field, all methods by the same test."""
    results = [result for result in results if str(result["scene"]).casefold() in {scene.casefold() for scene in scenes}]
    if method in FIELDS:
        found = _of(results, "fields", FIELDS[method])
        cores = sorted({str(result["cores"]) for result in found})
        return _Ours(found, (), f"{_tell(found)}; as long as default, and longer, on {' or '.join(cores)} cores" if found else "")
    name = MODELS.get(method)
    found = [] if name is None else _of(results, "models", name)
    return _Ours(found, ("times",), f"motion alone, in our trainer; {_tell(found)}; gaps of held-out times" if found else "")


# -- comparisons with others


def _tabulate_nvidia(known: dict[str, Any], results: Sequence[Result]) -> Table:
    rows, strong = [], []
    for method, values in known["methods"].items():
        published = [text(value, digits) for value, digits in zip(values[:3], (2, 2, 2), strict=True)]
        if method != OURS:
            # Motion models and fields are measured on other scenes, whose figures would say nothing beside these.
            rows.append((method, *published, *[NOT_MEASURED] * len(METRICS), NO_SCENES))
            continue
        found = _of(results, "nvidia")
        for how in dict.fromkeys(f"{each['variant']}, {each['settings']}" for each in found) or [""]:
            chosen = _Ours([each for each in found if f"{each['variant']}, {each['settings']}" == how], ("ours",), how)
            strong.append(len(rows))
            differs = f"{how}; {_tell(chosen.results)}" if chosen.results else NO_SCENES
            rows.append((f"{method} (the paper)", *published, *(chosen.score(metric) for metric in METRICS), differs))
    header = (
        "method",
        *(f"{NAMES[metric]}, paper" for metric in METRICS),
        *(f"{NAMES[metric]}, ours" for metric in METRICS),
        "what differs",
    )
    return Table("Table 1: NVIDIA", f"Published: {known['source']}.", header, rows, tuple(strong))


def _tabulate_davis(title: str, known: dict[str, Any], results: Sequence[Result], metric: str) -> Table:
    rows, strong = [], []
    for method, figures in known["methods"].items():
        cells = [text(value, DIGITS[metric]) for value in figures[metric]]
        rows.append((f"{method}, published", *cells, text(mean_of(figures[metric]), DIGITS[metric]), ""))
        alone = _find_ours(method, results, known["scenes"])
        groups = [(MOTION_ALONE, alone, alone.differs)]
        if method == OURS:
            found = _of(results, "davis")
            for how in dict.fromkeys(f"{each['variant']}, {each['settings']}" for each in found) or [""]:
                group = _Ours([each for each in found if f"{each['variant']}, {each['settings']}" == how], ("ours",), how)
                groups.append(("ours", group, f"{how}; {_tell(group.results)}" if group.results else ""))
        for name, group, differs in groups:
            of_scenes = [group.score(metric, scene) for scene in known["scenes"]]
            if name == "ours":
                strong.append(len(rows))
            mean = NOT_MEASURED if NOT_MEASURED in of_scenes else text(mean_of(map(float, of_scenes)), DIGITS[metric])
            rows.append((f"{method}, {name}", *of_scenes, mean, differs))
    header = ("method", *known["scenes"], "mean", "what differs")
    note = f"Published: {known['source']}. A mean is of all scenes, or left out."
    return Table(title, note, header, rows, tuple(strong))


# -- ablations


def _tabulate_ablation(title: str, known: dict[str, Any], results: Sequence[Result]) -> Table:
    labels = {claim.variant.name: claim.variant.label for claim in CLAIMS} | {"full": "all of it"}
    counted = len(known["columns"]) > len(METRICS)
    found = {name: _of(results, "ablations", name) for name in known["rows"]}
    shared = _find_shared_scenes(found.values())
    rows = []
    for name, values in known["rows"].items():
        ours = _Ours([each for each in found[name] if not shared or each["scene"] in shared], (), "")
        cells = [text(value, DIGITS[metric]) for value, metric in zip(values, METRICS, strict=False)]
        cells += [ours.score(metric) for metric in METRICS]
        if counted:
            means = [mean_of(pick(each, "gaussians", key) for each in ours.results) for key in ("total", "active_mean")]
            cells += [text(value, 0) for value in values[len(METRICS) :]]
            cells += [_say(None if mean is None else mean / 1000, 0) for mean in means]
        differs = f"our preset default but for this; {_tell(ours.results)}" if ours.results else ""
        rows.append((labels[name], *cells, differs))
    header = ["", *(f"{NAMES[metric]}, {whose}" for whose in ("paper", "ours") for metric in METRICS)]
    if counted:
        header += [f"Gaussians{which}, thousand, {whose}" for whose in ("paper", "ours") for which in ("", " active")]
    note = f"Published: {known['source']}, means over scenes that it does not name. Ours: means over scenes of means over seeds"
    note += ", of the scenes that all rows have that were measured." if shared else "; no scene was measured in all rows."
    return Table(title, note, (*header, "what differs"), rows)


def _find_shared_scenes(of_rows: Iterable[Sequence[Result]]) -> set[str]:
    """Return the scenes that every row has that was measured, so that means compare; none where they share none."""
    measured = [{str(each["scene"]) for each in found} for found in of_rows if found]
    return set.intersection(*measured) if measured else set()
