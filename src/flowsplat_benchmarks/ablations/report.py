"""The ablations as tables: differences from the base beside the paper's, and a verdict on every row."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from flowsplat.evaluation.scores import mean_of
from flowsplat.images.charts import bar_chart
from flowsplat.images.html import NOTHING
from flowsplat_benchmarks.ablations.claims import CLAIMS, TITLES, Claim, Group
from flowsplat_benchmarks.ablations.flow_maps import list_flow_maps
from flowsplat_benchmarks.ablations.page import how_measured, scene_names, write_ablation_report
from flowsplat_benchmarks.ablations.training_runs import by_run
from flowsplat_benchmarks.ablations.variants import Variant
from flowsplat_benchmarks.ablations.verdicts import EVEN_DECIBELS, Effect, Verdict, counts, effect, verdict
from flowsplat_benchmarks.tables import Chart, Result, Table, compute_scaled_mean, text

TITLE = "Ablations"
REMARKS = (
    "Every row differs from the first row of its table in what is named, with the same seeds, as many frame-steps and at most as "
    "many Gaussians. The paper's rows are run at our own settings: compared are differences, not values. In brackets: inside the "
    "masks of what moves.",
    "The spread is the standard deviation of the single differences over seeds and scenes. A mean and a spread below "
    f"{EVEN_DECIBELS} dB are no difference. Else a mean up to its spread is not separable; a larger one is confirmed where it has "
    "the sign that was claimed (by the paper, or by us: what we added is worth something), and otherwise contradicted. One run has "
    "no spread.",
)
EXPECTED = {-1: "worse", 0: "as good", 1: "better"}


def write_report(out: Path, results: Sequence[Result], failed: Mapping[str, str], others: int = 0) -> Path:
    """Write the tables of some results of the ablations, and return the path of the page.

    Args:
        results: with the same settings and as many steps.
        failed: runs that could not be made, and why.
        others: how many results in ``out`` are none of these.

    Raises:
        InputError: the folder cannot be written.
    """
    tables = [table for group in TITLES if (table := _table(group, results)) is not None]
    verdicts = [judged.verdict for claim in CLAIMS if (judged := judge(claim, results)) is not None]
    seeds = sorted({result["seed"] for result in results})
    steps = ", ".join(f"{count:,}" for count in sorted({result["iterations"] for result in results}))
    remarks = [*REMARKS, how_measured(results), f"Seeds {', '.join(map(str, seeds))}; {steps} frame-steps."] if results else []
    said = f"{len(verdicts)} rows: {counts(verdicts)}." if verdicts else "Nothing is measured yet."
    return write_ablation_report(out, "ablations", TITLE, said, remarks, tables, failed, others, list(list_flow_maps(out, results)))


@dataclass(frozen=True)
class Judged:
    """What the variant of a claim does.

    Attributes:
        claim: of which this is found.
        psnr: its effect on all of the image.
        objects: that inside the masks of what moves; None where they are not measured.
    """

    claim: Claim
    psnr: Effect
    objects: Effect | None

    @property
    def verdict(self) -> Verdict:
        """On all of the image."""
        return verdict(self.psnr, self.claim.expected)

    @property
    def said(self) -> str:
        """The verdict and, in brackets where it is another, that inside the masks."""
        inside = None if self.objects is None else verdict(self.objects, self.claim.expected)
        return self.verdict if inside in (None, self.verdict) else f"{self.verdict} ({inside})"


def judge(claim: Claim, results: Sequence[Result]) -> Judged | None:
    """Return what a claim's variant does to PSNR; None where it or its base is not measured."""
    found = _effect(claim, results, "psnr")
    return None if found is None else Judged(claim, found, _effect(claim, results, "moving"))


def _effect(claim: Claim, results: Sequence[Result], figure: str) -> Effect | None:
    return effect(by_run(results, claim.variant.name, (figure,)), by_run(results, claim.base.name, (figure,)))


def _table(group: Group, results: Sequence[Result]) -> Table | None:
    judged = [found for claim in CLAIMS if claim.group == group and (found := judge(claim, results)) is not None]
    if not judged:
        return None
    base = next(claim.base for claim in CLAIMS if claim.group == group)
    scenes = scene_names(results)
    rows = [_base_row(base, scenes, results), *(_row(found, scenes, results) for found in judged)]
    header = (
        "", *scenes.values(), "mean", "spread", "SSIM", "the paper", "claimed", "verdict", "seconds", "CPU seconds",
        "Gaussians, thousand",
    )  # fmt: skip
    variants = [found.claim.variant for found in judged]
    remarks = [f"{found.claim.variant.label}: {found.claim.remark}." for found in judged if found.claim.remark]
    settings = [f"{variant.label}: {variant.settings}." for variant in variants if variant.settings]
    note = (
        "First row: values (PSNR in dB); the others: differences from it. Seconds: of training, by the clock and of all cores. "
        + " ".join([*remarks, *(["Settings:", *settings] if settings else [])])
    )
    has_paper = any(found.claim.paper is not None for found in judged)
    chart = bar_chart(
        {found.claim.variant.label: (found.psnr.mean, found.claim.paper)[: 1 + has_paper] for found in judged},
        ("ours, with the spread", "the paper")[: 1 + has_paper],
        title=f"{TITLES[group]}: difference in PSNR",
        x_label="difference in PSNR, dB",
        spreads={found.claim.variant.label: found.psnr.spread for found in judged if found.psnr.spread is not None},
    )
    return Table(TITLES[group], note, header, rows, (0,), (Chart(f"ablations_{group}.svg", chart),))


def _base_row(base: Variant, scenes: Mapping[str, str], results: Sequence[Result]) -> tuple[str, ...]:
    psnr, objects, ssim = (
        {scene: mean_of(value for run, value in values.items() if run[0] == scene) for scene in scenes}
        for values in (by_run(results, base.name, (figure,)) for figure in ("psnr", "moving", "ssim"))
    )
    return (
        base.label, *(_with_objects(psnr[scene], objects[scene]) for scene in scenes),
        _with_objects(mean_of(psnr.values()), mean_of(objects.values())), NOTHING, text(mean_of(ssim.values()), 3), NOTHING,
        NOTHING,
        NOTHING, *_cost(base, results),
    )  # fmt: skip


def _row(found: Judged, scenes: Mapping[str, str], results: Sequence[Result]) -> tuple[str, ...]:
    claim, psnr, objects, ssim = found.claim, found.psnr, found.objects, _effect(found.claim, results, "ssim")
    of_scene = ((psnr.of_scene(scene), objects.of_scene(scene) if objects else None) for scene in scenes)
    return (
        claim.variant.label, *(_with_objects(*pair, sign=True) for pair in of_scene),
        _with_objects(psnr.mean, objects.mean if objects else None, sign=True),
        _with_objects(psnr.spread, objects.spread if objects else None), text(ssim.mean if ssim else None, 3, sign=True),
        text(claim.paper, 2, sign=True), EXPECTED[claim.expected], found.said, *_cost(claim.variant, results),
    )  # fmt: skip


def _with_objects(value: float | None, inside: float | None, sign: bool = False) -> str:
    shown = text(value, 2, sign)
    return shown if inside is None else f"{shown} ({text(inside, 2, sign)})"


def _cost(variant: Variant, results: Sequence[Result]) -> tuple[str, ...]:
    seconds = [mean_of(by_run(results, variant.name, ("seconds", key)).values()) for key in ("train", "train_cpu")]
    gaussians = by_run(results, variant.name, ("gaussians", "total")).values()
    return *(text(value, 0) for value in seconds), text(compute_scaled_mean(gaussians, 1e-3), 0)
