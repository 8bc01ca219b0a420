"""The ablations as tables: differences from the base beside the paper's, and a verdict on every row."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from flowsplat.evaluation.scores import mean_of
from flowsplat.pictures.charts import bar_chart
from flowsplat.pictures.html import NOTHING
from flowsplat.protocols.studies.claims import CLAIMS, TITLES, Claim, Group
from flowsplat.protocols.studies.report import Section, how_measured, scene_names, write_study
from flowsplat.protocols.studies.runs import Result, by_run
from flowsplat.protocols.studies.variants import Variant
from flowsplat.protocols.studies.verdicts import EVEN, Effect, Run, Verdict, counts, effect, verdict
from flowsplat.protocols.tables import Table, scaled_mean, text

TITLE = "Ablations"
REMARKS = (
    "Every row differs from the first row of its table in what is named, with the same seeds, as many frame-steps and at most as "
    "many Gaussians. The paper's rows are run at our own settings: compared are differences, not values.",
    "A difference is not separable where its mean is below its spread, which is the standard deviation of the single differences "
    "over seeds and scenes. A larger one is confirmed where it has the sign that was claimed (by the paper, or by us: what we "
    "added is worth something), else contradicted. That something makes no difference is confirmed by a mean below "
    f"{EVEN} dB.",
)
EXPECTED = {-1: "worse", 0: "as good", 1: "better"}


def write_report(out: Path, results: Sequence[Result], failed: Mapping[str, str]) -> Path:
    """Write the tables of what is there of the ablations, and return the path of the page.

    Raises:
        InputError: the folder cannot be written.
    """
    sections = [section for group in TITLES if (section := _section(group, results)) is not None]
    verdicts = [found[1] for claim in CLAIMS if (found := judge(claim, results)) is not None]
    seeds = sorted({result["seed"] for result in results})
    steps = ", ".join(f"{count:,}" for count in sorted({result["iterations"] for result in results}))
    remarks = [*REMARKS, how_measured(results), f"Seeds {', '.join(map(str, seeds))}; {steps} frame-steps."] if results else []
    said = f"{len(verdicts)} rows: {counts(verdicts)}." if verdicts else "Nothing is measured yet."
    return write_study(out, "ablations", TITLE, said, remarks, sections, failed)


def judge(claim: Claim, results: Sequence[Result]) -> tuple[Effect, Verdict] | None:
    """What a claim's variant does to PSNR; None where it or its base is not measured."""
    found = _effect(claim, results, ("psnr",))
    return None if found is None else (found, verdict(found, claim.expected))


def _effect(claim: Claim, results: Sequence[Result], figure: tuple[str, ...]) -> Effect | None:
    return effect(by_run(results, claim.variant.name, figure), by_run(results, claim.base.name, figure))


def _section(group: Group, results: Sequence[Result]) -> Section | None:
    claims = [claim for claim in CLAIMS if claim.group == group]
    judged = [(claim, *found) for claim in claims if (found := judge(claim, results)) is not None]
    if not judged:
        return None
    base = claims[0].base
    scenes = scene_names(results)
    rows = [_base_row(base, scenes, results)]
    rows += [_row(claim, found, said, scenes, results) for claim, found, said in judged]
    header = (
        "", *scenes.values(), "mean PSNR", "spread", "movers", "SSIM", "the paper", "claimed", "verdict", "seconds",
        "CPU seconds", "Gaussians, thousand",
    )  # fmt: skip
    remarks = [f"{claim.variant.label}: {claim.remark}." for claim, *_ in judged if claim.remark]
    settings = [f"{claim.variant.label}: {claim.variant.settings}." for claim, *_ in judged if claim.variant.settings]
    note = (
        "First row: values (PSNR in dB); the others: differences from it. Movers: PSNR inside the masks. Seconds: of training, by "
        "the clock and of all cores. " + " ".join([*remarks, *(["Settings:", *settings] if settings else [])])
    )
    has_paper = any(claim.paper is not None for claim, *_ in judged)
    chart = bar_chart(
        {claim.variant.label: (found.mean, claim.paper)[: 1 + has_paper] for claim, found, _ in judged},
        ("ours, with the spread", "the paper")[: 1 + has_paper],
        title=f"{TITLES[group]}: difference in PSNR",
        x_label="difference in PSNR, dB",
        spreads={claim.variant.label: found.spread for claim, found, _ in judged if found.spread is not None},
    )
    return Section(group, Table(TITLES[group], note, header, rows, (0,)), chart)


def _base_row(base: Variant, scenes: Mapping[str, str], results: Sequence[Result]) -> tuple[str, ...]:
    psnr, movers, ssim = (by_run(results, base.name, (figure,)) for figure in ("psnr", "moving", "ssim"))
    of_scene = [mean_of(_of_scene(psnr, scene)) for scene in scenes]
    means = (mean_of(mean_of(_of_scene(values, scene)) for scene in scenes) for values in (psnr, movers, ssim))
    mean, mean_movers, mean_ssim = means
    return (
        base.label, *(text(value, 2) for value in of_scene), text(mean, 2), NOTHING, text(mean_movers, 2), text(mean_ssim, 3),
        NOTHING, NOTHING, NOTHING, *_cost(base, results),
    )  # fmt: skip


def _of_scene(values: Mapping[Run, float], scene: str) -> Iterator[float]:
    return (value for run, value in values.items() if run[0] == scene)


def _row(
    claim: Claim, found: Effect, said: Verdict, scenes: Mapping[str, str], results: Sequence[Result]
) -> tuple[str, ...]:
    movers, ssim = _effect(claim, results, ("moving",)), _effect(claim, results, ("ssim",))
    return (
        claim.variant.label, *(text(found.of_scene(scene), 2, sign=True) for scene in scenes),
        text(found.mean, 2, sign=True), text(found.spread, 2), text(movers.mean if movers else None, 2, sign=True),
        text(ssim.mean if ssim else None, 3, sign=True), text(claim.paper, 2, sign=True), EXPECTED[claim.expected], said,
        *_cost(claim.variant, results),
    )  # fmt: skip


def _cost(variant: Variant, results: Sequence[Result]) -> tuple[str, ...]:
    seconds = [mean_of(by_run(results, variant.name, ("seconds", key)).values()) for key in ("train", "train_cpu")]
    gaussians = by_run(results, variant.name, ("gaussians", "total")).values()
    return *(text(value, 0) for value in seconds), text(scaled_mean(gaussians, 1e-3), 0)
