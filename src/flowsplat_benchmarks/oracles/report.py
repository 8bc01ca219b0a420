"""The tables of the oracles as Markdown and as a page: what every prior costs, and how wrong the depth of objects is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from flowsplat.images.html import NOTHING
from flowsplat.scenes.layers import read_image
from flowsplat_benchmarks.oracles.classes import CLASSES, gains, legend, psnr_by_class
from flowsplat_benchmarks.oracles.scenes import CHAINS, ORACLES
from flowsplat_benchmarks.reports import Report, failures, runs_measured, scene_section
from flowsplat_benchmarks.tables import Column, Result, Table, describe_version, label, plain, text

BACKGROUND = "background"
OWN_BACKGROUND = ("own", "outline")
"""Oracles with our own depth of what rests: with our masks, and with true ones."""
SHEET = "evaluation/classes.png"
"""In a run: held-out views with their errors and classes of pixels."""
TITLE = "One prior after the other replaced by the truth"
MEANINGS = {
    "own": "own priors as they are",
    "constant": "*constant*: each object's depth times one number, so that its median over the clip is right",
    "depth_trajectory": "*depth trajectory*: flat billboards at the right depth in every frame",
    "shape_offset": "*shape offset*: true depth inside our masks",
    "outline": "*outline*: true masks, too",
    "background": "*background*: its true depth, too",
    "flow": "*flow*: true flow, too",
    "cameras": "*cameras*: all true",
    "ids": "*ids*: every pixel of our masks has the number of its true object",
    "shadow": "*shadow*: what rests is in no mask, too",
    "parts": "*parts*: objects that were found in a frame are whole there, too",
    "masks": "*masks*: all true, what was not found, too; the depth is our own",
}
GAINS = ("What every prior costs", "What every fault of the masks costs")
"""Titles of the tables of ``CHAINS``."""
ERRORS = (
    Column("constant", ("constant",), 3, sign=True),
    Column("depth_trajectory", ("depth_trajectory",), 3),
    Column("shape_offset", ("shape_offset",), 3),
)
"""Of the depth of an object (``objects.object_depth_errors``)."""
REMARKS = (
    "Each row holds what is true in those above it in its table. True depth is brought to the scale of the estimated cameras by "
    "one factor for the clip, from the camera paths.",
    "What the pipeline makes from a replaced prior is made anew: static depth and tracks from the true masks, tracks from true "
    "static depth and true flow.",
)


def write_report(out: Path, results: Sequence[Result], failed: Mapping[str, str], others: int = 0) -> Path:
    """Write ``OUT/oracles.md`` and ``.html`` and return the path of the page.

    Args:
        results: the JSON of runs (``benchmark.measure_oracle``) with the same settings.
        failed: runs that could not be made, and why.
        others: how many results in ``out`` have other settings.

    Raises:
        InputError: the folder cannot be written.
    """
    remarks = list(REMARKS)
    if results:
        views = ", ".join(f"{name} {count}" for name, count in sorted({r["scene"]: r["views"] for r in results}.items()))
        remarks.append(f"Trained with {results[0]['settings']}. Images by held-out cameras: {views}. {describe_version(results)}")
    if others:
        remarks.append(f"Results in this folder that have other settings, and are left out here: {others}.")
    remarks += failures(failed)
    chains = [_gains(results, title, chain) for title, chain in zip(GAINS, CHAINS, strict=True) if _has_any(results, chain)]
    found = [*chains, *(each for each in (_views(results), _static_depth(results), _objects(results)) if each.rows)]
    scenes = [_scene(out, result) for result in sorted(results, key=_place)]
    return Report("oracles", TITLE, runs_measured(results, failed), remarks, found, scenes).write(out)


def _place(result: Result) -> tuple[str, int]:
    return result["scene"], list(ORACLES).index(result["oracle"])


def _scene(out: Path, result: Result) -> dict[str, Any]:
    scene, sheet = plain(label(result)), out / result["run"] / SHEET
    shown = [(read_image(sheet), f"{scene}: held-out views"), (legend(), f"{scene}: classes")] if sheet.exists() else []
    facts = f"{result['settings']}; {result['gaussians']:,} Gaussians"
    return scene_section(out, f"{scene}: {result['oracle']}", facts, f"{result['run']}/report.html", shown)


def _has_any(results: Sequence[Result], chain: Sequence[str]) -> bool:
    """Return whether there is more of a chain than own priors, which all chains begin with; the first one needs no more."""
    return any(result["oracle"] in (chain if chain == CHAINS[0] else chain[1:]) for result in results)


def _gains(results: Sequence[Result], title: str, chain: Sequence[str]) -> Table:
    """PSNR of all of the image and inside objects by oracle of a chain and scene, and the differences from the oracle before."""
    scenes = {result["scene"]: label(result) for result in sorted(results, key=_place)}
    by_name = {(result["scene"], result["oracle"]): result for result in results}
    rows = []
    for place, oracle in enumerate(chain):
        if not any((scene, oracle) in by_name for scene in scenes):
            continue
        cells = [MEANINGS[oracle]]
        for scene in scenes:
            before = [by_name[scene, name] for name in chain[:place] if (scene, name) in by_name]
            cells += _cells(by_name.get((scene, oracle)), before[-1] if before else None)
        rows.append(tuple(cells))
    header = ["true", *(cell for name in scenes.values() for cell in (name, "gain"))]
    note = "PSNR of images by held-out cameras, dB: all of the image / inside objects. Gain: over the row above that is there."
    own = [k for k, row in enumerate(rows) if row[0] == MEANINGS["own"]]
    return Table(title, note, tuple(header), rows, tuple(own))


def _cells(result: Result | None, before: Result | None) -> list[str]:
    if result is None:
        return [NOTHING, NOTHING]
    figures = " / ".join(text(result[name], 2) for name in ("psnr", "moving"))
    if before is None:
        return [figures, NOTHING]
    return [figures, " / ".join(text(_difference(result[name], before[name]), 2, sign=True) for name in ("psnr", "moving"))]


def _difference(value: float | None, before: float | None) -> float | None:
    return None if value is None or before is None else value - before


def _objects(results: Sequence[Result]) -> Table:
    """Return how wrong the depth of objects is in the priors as they are."""
    rows: list[tuple[str, ...]] = []
    for result in sorted((result for result in results if result["oracle"] == "own"), key=_place):
        for error in result["objects"]:
            obj = error["matched"]
            rows.append(
                (
                    label(result), str(obj["true"] or NOTHING), ", ".join(map(str, obj["ids"])), f"{error['frames']}",
                    f"{error['pixels']:,}", *(column.cell(error) for column in ERRORS),
                )
            )  # fmt: skip
    header = ("scene", "true object", "our objects", "frames", "pixels", *(column.header for column in ERRORS))
    note = (
        "e = ln(estimated / true) depth of own priors, over the pixels that our masks and the true ones share. Constant: median "
        "over pixels and frames (+.01: one percent too far). Depth trajectory: standard deviation over time of the median of a "
        "frame. "
        f"Shape offset: median of |e - median of the frame|. Trusted static depth has a median e of {_static(results)}."
    )
    return Table("Depth of objects, own priors", note, header, rows)


def _views(results: Sequence[Result]) -> Table:
    """Return what each class of pixel of the held-out views holds of the error, and what true static depth would bring there."""
    rows: list[tuple[str, ...]] = []
    measured = sorted((result for result in results if result.get("classes")), key=_place)
    for scene in dict.fromkeys(result["scene"] for result in measured):
        of_scene = {result["oracle"]: result for result in measured if result["scene"] == scene}
        first = next(iter(of_scene.values()))
        rows.append((label(first), "", "share of the pixels, %", *_percent(_shares(first["classes"]["pixels"]))))
        true = of_scene.get(BACKGROUND)
        for oracle, result in of_scene.items():
            name, errors = (label(result), oracle), result["classes"]
            rows.append((*name, "PSNR, dB", *(text(x, 2) for x in psnr_by_class(errors))))
            rows.append((*name, "share of the error, %", *_percent(_shares(errors["squared"]))))
            if true is not None and _place(result) < _place(true):
                gained = (text(x, 2, sign=True) for x in gains(errors, true["classes"]))
                rows.append((*name, f"gain with the error of {BACKGROUND}, dB", *gained))
    note = (
        "A pixel is of the first class that it is, by the truth. Gain: of the whole image, mean of the views, were the error of "
        "this class alone that of the run with true depth of what rests."
    )
    return Table("Held-out views by class of pixel", note, ("scene", "true", "figure", *CLASSES), rows)


def _percent(shares: Sequence[float]) -> list[str]:
    return [text(100 * share, 1) for share in shares]


def _shares(values: Sequence[Sequence[float]]) -> list[float]:
    sums = [sum(column) for column in zip(*values, strict=True)]
    return [x / max(sum(sums), 1e-12) for x in sums]


def _static_depth(results: Sequence[Result]) -> Table:
    """Return how wrong static depth is in the training frames, for those oracles that use our own."""
    rows = []
    for result in sorted((r for r in results if r["oracle"] in OWN_BACKGROUND and r.get("static_classes")), key=_place):
        *classes, all_of_them = result["static_classes"][CLASSES.index("moves") + 1 :]
        for figure in ("median", "p90"):
            shown = {"median": "median, %", "p90": "90th percentile, %"}[figure]
            values = (None if each[figure] is None else 100 * each[figure] for each in (all_of_them, *classes))
            rows.append((label(result), result["oracle"], shown, *(text(x, 2) for x in values)))
    header = ("scene", "true", "figure", "all", *(name for name in CLASSES if name != "moves"))
    note = "Of |estimated / true - 1| over all static pixels of the training frames outside the masks, filled ones included."
    return Table("Depth of what rests by class of pixel", note, header, rows)


def _static(results: Sequence[Result]) -> str:
    own = sorted((result for result in results if result["oracle"] == "own"), key=_place)
    return ", ".join(f"{text(result['static'], 3, sign=True)} ({result['scene']})" for result in own)
