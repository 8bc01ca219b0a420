"""The models as tables: differences from the series with a verdict on each, and everything that was measured, clip by clip."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from flowsplat.evaluation.scores import mean_of
from flowsplat.images.charts import bar_chart
from flowsplat.images.html import NOTHING
from flowsplat_benchmarks.ablations.page import how_measured, scene_names, write_ablation_report
from flowsplat_benchmarks.ablations.training_runs import by_run
from flowsplat_benchmarks.ablations.verdicts import EVEN_DECIBELS, Effect, Verdict, counts, effect, verdict
from flowsplat_benchmarks.models.lineup import BASE, LINEUP, Entrant
from flowsplat_benchmarks.models.times import END, GAP_LENGTHS
from flowsplat_benchmarks.tables import Chart, Column, Result, Table, text

TITLE = "Motion models"
REMARKS = (
    "All models have the same first Gaussians, priors, losses, frame-steps, seeds and density control, and at most as many "
    "Gaussians: only the motion differs. Where a paper has another start or other losses, only its motion is measured.",
    "Held-out times lie in gaps of 1, 3 and 5 frames and at the end of the clip; priors, start and training see nothing of them, "
    "but cameras are estimated of all frames. In brackets: inside the masks of what moves.",
    "Differences are from the series. The spread is their standard deviation over seeds and scenes. A mean and a spread below "
    f"{EVEN_DECIBELS} dB are no difference. Else a mean up to its spread is not separable; a larger one confirms that the other "
    "model is worse, or contradicts it. One run has no spread.",
)
DEVICES = {"cpu": "the CPU", "cuda": "a CUDA card"}
EXPECTED = -1
"""The sign of the difference that is claimed of every other model."""
COLUMNS = (
    Column("times", ("times", "psnr")), Column("inside", ("times", "moving", "psnr")), Column("SSIM", ("times", "ssim"), 3),
    *(Column(f"gap of {length}", ("gaps", str(length), "psnr")) for length in GAP_LENGTHS),
    *(Column(f"gap of {length}, inside", ("gaps", str(length), "moving", "psnr")) for length in GAP_LENGTHS),
    Column("end", ("gaps", END, "psnr")), Column("end, inside", ("gaps", END, "moving", "psnr")),
    Column("from aside", ("views", "psnr")), Column("from aside, inside", ("views", "moving", "psnr")),
    Column("training frames", ("training_psnr",)), Column("flow error, px", ("flow", "mean"), 3),
    Column("inside, px", ("flow", "moving", "mean"), 3), Column("tracks, %", ("tracks", "moving", "median"), 2),
    Column("Gaussians, thousand", ("gaussians", "total"), 1, 1e-3), Column("numbers, million", ("parameters", "all"), 2, 1e-6),
    Column("of them shared, thousand", ("parameters", "shared"), 1, 1e-3), Column("MB", ("parameters", "bytes"), 1, 1e-6),
    Column("page, MB", ("page_bytes",), 2, 1e-6), Column("seconds of training", ("seconds", "train"), 0),
    Column("of all cores", ("seconds", "train_cpu"), 0), Column("ms an image", ("image_seconds",), 1, 1e3),
)  # fmt: skip
"""What the tables by clip have, of what was measured there."""
CRITERIA = (
    (COLUMNS[0], 1), (COLUMNS[1], 1), *((Column(f"gap of {length}", ("gaps", str(length), "psnr")), 1) for length in GAP_LENGTHS),
    (Column("end", ("gaps", END, "psnr")), 1), (Column("from aside", ("views", "psnr")), 1),
    (Column("flow inside, px", ("flow", "moving", "mean"), 3), -1), (Column("tracks, %", ("tracks", "moving", "median")), -1),
)  # fmt: skip
"""By what the best model of a clip is chosen, and whether more (1) or less of it is better."""


def write_report(out: Path, results: Sequence[Result], failed: Mapping[str, str], others: int = 0) -> Path:
    """Write the tables of some results, and return the path of the page.

    Args:
        results: with the same settings and as many steps.
        failed: runs that could not be made, and why.
        others: how many results in ``out`` are none of these.

    Raises:
        InputError: the folder cannot be written.
    """
    scenes = scene_names(results)
    tables, verdicts = [], []
    measured = [entrant for entrant in LINEUP if any(result["variant"] == entrant.variant.name for result in results)]
    if measured:
        judged = [(entrant, found) for entrant in measured if entrant is not BASE and (found := _effect(entrant, results, "psnr"))]
        verdicts = [verdict(found, EXPECTED) for _, found in judged]
        tables = [
            _compare(measured, judged, scenes, results),
            _choose_best(measured, scenes, results),
            *(_list_clip(measured, scene, scenes[scene], results) for scene in scenes),
        ]
    seeds = ", ".join(map(str, sorted({result["seed"] for result in results})))
    steps = ", ".join(f"{count:,}" for count in sorted({result["iterations"] for result in results}))
    devices = Counter(result["device"] for result in results)
    trained = ", ".join(f"{count} on {DEVICES[device]}" for device, count in sorted(devices.items()))
    remarks = [*REMARKS, how_measured(results), f"Seeds {seeds}; {steps} frame-steps. Runs: {trained}."] if results else []
    said = f"{len(verdicts)} models beside the series: {counts(verdicts)}." if verdicts else "Nothing is compared yet."
    return write_ablation_report(out, "models", TITLE, said, remarks, tables, failed, others)


def name_best(found: Mapping[str, float], sign: int, digits: int) -> str:
    """Return the best of some models, by their figures, and how far from the series it is; the series where none is clearly better.

    Args:
        found: a figure by the name of its model.
        sign: whether more (1) or less (-1) of it is better.
        digits: of the difference.
    """
    best = max(found, key=lambda each: sign * found[each], default="")
    base = found.get(BASE.variant.name)
    if base is not None and sign > 0 and found[best] - base < EVEN_DECIBELS:
        best = BASE.variant.name
    gain = "" if base is None or best == BASE.variant.name else f" ({text(found[best] - base, digits, True)})"
    return f"{best}{gain}" if best else NOTHING


def _choose_best(measured: Sequence[Entrant], scenes: Mapping[str, str], results: Sequence[Result]) -> Table:
    """Return which model is the best of each clip by each of ``CRITERIA``."""
    rows = []
    for scene, name in scenes.items():
        cells = []
        for column, sign in CRITERIA:
            found: dict[str, float] = {}
            for entrant in measured:
                runs = by_run(results, entrant.variant.name, column.path)
                value = mean_of(runs[run] for run in runs if run[0] == scene)
                if value is not None:
                    found[entrant.variant.name] = value
            cells.append(name_best(found, sign, column.digits))
        rows.append((name, *cells))
    is_one = len({result["seed"] for result in results}) < 2
    note = (
        f"{'Of one seed' if is_one else 'By means over seeds'}; in brackets the difference from the series, which stands where no "
        f"other is {EVEN_DECIBELS:g} dB better. "
        + (
            "By how much another seed would change it was not measured."
            if is_one
            else "Whether a difference is more than the spread, the table of held-out times tells."
        )
    )
    return Table("Which is best where", note, ("", *(column.header for column, _ in CRITERIA)), rows)


def _effect(entrant: Entrant, results: Sequence[Result], *figure: str) -> Effect | None:
    """Return what a model does to a figure of the held-out times."""
    path = ("times", *figure)
    return effect(by_run(results, entrant.variant.name, path), by_run(results, BASE.variant.name, path))


def _compare(
    measured: Sequence[Entrant], judged: Sequence[tuple[Entrant, Effect]], scenes: Mapping[str, str], results: Sequence[Result]
) -> Table:
    header = ("", *scenes.values(), "mean", "spread", "SSIM", "verdict", "times as long")
    rows = [_describe_base(scenes, results), *(_describe(entrant, found, scenes, results) for entrant, found in judged)]
    note = (
        "First row: values (PSNR of held-out times in dB); the others: differences from it. Times as long: training, by the clock."
    )
    limits = " ".join(f"{entrant.variant.name}: {entrant.limits}." for entrant in measured if entrant.limits)
    if limits:
        note += f" What they cannot do here, or do otherwise than their papers: {limits}"
    chart = bar_chart(
        {entrant.variant.label: (found.mean,) for entrant, found in judged},
        ("difference, with the spread",), title=f"{TITLE}: difference in PSNR of held-out times", x_label="difference in PSNR, dB",
        spreads={entrant.variant.label: found.spread for entrant, found in judged if found.spread is not None},
    )  # fmt: skip
    return Table("Held-out times", note, header, rows, (0,), (Chart("models.svg", chart),) if judged else ())


def _describe_base(scenes: Mapping[str, str], results: Sequence[Result]) -> tuple[str, ...]:
    psnr, inside, ssim = (by_run(results, BASE.variant.name, path) for path in (
        ("times", "psnr"), ("times", "moving", "psnr"), ("times", "ssim")))  # fmt: skip
    by_scene = [[mean_of(found[run] for run in found if run[0] == scene) for found in (psnr, inside)] for scene in scenes]
    whole, moving = ([value[k] for value in by_scene] for k in (0, 1))
    values = [_both(*pair) for pair in zip(whole, moving, strict=True)]
    cells = (*values, _both(mean_of(whole), mean_of(moving)), NOTHING, text(mean_of(ssim.values()), 3))
    return (BASE.variant.label, *cells, NOTHING, text(1.0, 2))


def _describe(entrant: Entrant, found: Effect, scenes: Mapping[str, str], results: Sequence[Result]) -> tuple[str, ...]:
    inside, ssim = _effect(entrant, results, "moving", "psnr"), _effect(entrant, results, "ssim")
    cells = [_both(found.of_scene(scene), inside.of_scene(scene) if inside else None, sign=True) for scene in scenes]
    said: Verdict = verdict(found, EXPECTED)
    said_inside = None if inside is None else verdict(inside, EXPECTED)
    return (
        entrant.variant.label, *cells, _both(found.mean, inside.mean if inside else None, sign=True),
        _both(found.spread, inside.spread if inside else None), text(ssim.mean if ssim else None, 3, sign=True),
        said if said_inside in (None, said) else f"{said} ({said_inside})", text(_time_factor(entrant, results), 2),
    )  # fmt: skip


def _time_factor(entrant: Entrant, results: Sequence[Result]) -> float | None:
    """Return how many times as long as the series a model trains, on average over the runs that both have on the same device."""
    factors = []
    for device in sorted({result["device"] for result in results}):
        there = [result for result in results if result["device"] == device]
        own, base = (by_run(there, name, ("seconds", "train")) for name in (entrant.variant.name, BASE.variant.name))
        factors += [own[run] / base[run] for run in own if base.get(run)]
    return mean_of(factors)


def _both(value: float | None, inside: float | None, sign: bool = False) -> str:
    shown = text(value, 2, sign)
    return shown if inside is None else f"{shown} ({text(inside, 2, sign)})"


def _list_clip(measured: Sequence[Entrant], scene: str, name: str, results: Sequence[Result]) -> Table:
    found = [result for result in results if result["scene"] == scene]
    columns = [column for column in COLUMNS if column.is_in(found)]
    rows = []
    for entrant in measured:
        if own := [result for result in found if result["variant"] == entrant.variant.name]:
            rows.append((entrant.variant.label, *(column.cell(*own) for column in columns)))
    note = "PSNR in dB where nothing else is said; means over seeds. Tracks: median error of moving points over their depth."
    return Table(name, note, ("", *(column.header for column in columns)), rows)
