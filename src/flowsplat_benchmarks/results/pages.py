"""Write the results pages, each from records alone: figures, commits and machines, and what is not measured or failed."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from flowsplat.common.files import make_folder, write_text
from flowsplat_benchmarks.ablations.claims import CLAIMS, FULL, PAPER_ORDERS, TITLES, Claim
from flowsplat_benchmarks.ablations.verdicts import EVEN_DECIBELS, Effect, verdict
from flowsplat_benchmarks.results.cells import (
    ABLATION_SCENES,
    CAPS,
    CLIP_SIDE,
    CLIPS,
    GROWTH,
    MASKED_CLIPS,
    ORACLES,
    OWN_ROWS,
    PAIR,
    RENDERED,
    STEP_COUNTS,
    list_cells,
)
from flowsplat_benchmarks.results.models_page import list_model_tables
from flowsplat_benchmarks.results.overview import format_overview
from flowsplat_benchmarks.results.paper_page import list_paper_tables
from flowsplat_benchmarks.results.records import Record
from flowsplat_benchmarks.results.rows import (
    MEASURED_AT,
    NOT_MEASURED,
    STAGES,
    Records,
    Row,
    Shown,
    add_missing,
    compare,
    make_table,
    name_of,
    tell_whole_run,
)
from flowsplat_benchmarks.results.worlds_table import tabulate_worlds
from flowsplat_benchmarks.tables import Table, format_table, text

OVERVIEW = "index"
"""Name of the first page."""
COMMAND = "flowsplat benchmark all DATA -o OUT --docs docs/results"
NOTEBOOK = "../notebook/2026-11.md"


@dataclass(frozen=True)
class Page:
    """A page: its heading, what it says first, and what makes its tables of the records."""

    title: str
    intro: str
    tables: Callable[[Records], Sequence[Table]]


def write_pages(found: Sequence[Record], folder: Path, with_links: bool = True) -> None:
    """Write ``index.md`` and the pages behind it.

    Args:
        found: the newest last.
        with_links: to other pages of the documentation, which lie beside ``folder``.

    Raises:
        InputError: a record is damaged, or the folder cannot be written.
    """
    pages = format_pages(Records(found))
    make_folder(folder)
    for name, page in pages.items():
        write_text(folder / f"{name}.md", page if with_links else re.sub(r"\[([^\]]+)\]\(\.\./[^)]*\)", r"\1", page))


def format_pages(records: Records) -> dict[str, str]:
    """Return all pages by name.

    Raises:
        InputError: a record is damaged.
    """
    return {OVERVIEW: format_overview(records), **{name: _format(page, records) for name, page in PAGES.items()}}


def _format(page: Page, records: Records) -> str:
    records.used.clear()
    lines = [f"# {page.title}", "", page.intro]
    for each in page.tables(records):
        lines += ["", f"## {each.title}"]
        lines += ["", each.note] if each.note else []
        lines += ["", *format_table(each.header, each.rows, each.strong)] if each.rows else []
    lines += ["", f"Written by `{COMMAND}`. Commits, and the machines on which they were measured:", ""]
    lines += [f"- {commit}: {machine}" for commit, machine in records.machines()] or [f"- {NOT_MEASURED}"]
    return "\n".join(lines) + "\n"


# -- real clips

PSNR = Shown("PSNR (inside)", (("ours", "psnr"), ("ours", "moving", "psnr")))
SSIM = Shown("SSIM", (("ours", "ssim"),), 3)
MASKS = {"given": "given masks", "own": "own masks"}


def _tabulate_clips(title: str, note: str, variants: Sequence[str], records: Records) -> Table:
    planned = {(cell.scene, cell.variant) for cell in list_cells() if cell.benchmark == "davis"}
    rows = []
    for name in CLIPS:
        for variant in variants:
            row = records.row("davis", name, variant)
            if row.records or (name, variant) in planned:
                masks = variant.partition("-")[0] if name in MASKED_CLIPS else "own"
                rows.append((f"{name_of(name)}, {MASKS[masks]}", row))
    columns = (
        PSNR, SSIM, Shown("poses refined (inside)", (("refined", "psnr"), ("refined", "moving", "psnr"))),
        *(
            Shown(f"{label} (inside)", (("baselines", key, "psnr"), ("baselines", key, "moving", "psnr")))
            for key, label in (("flow_interpolation", "flow interpolation"), ("static", "static scene"))
        ),
    )  # fmt: skip
    return make_table(title, note, rows, columns, "clip")


def _tabulate_real_clips(records: Records) -> list[Table]:
    return [
        _tabulate_clips("At 854x480", "Preset `default`, every tenth frame held out.", ("given", "own"), records),
        _tabulate_clips(
            f"At {CLIP_SIDE} pixels of width", "The same at half the size: the second seed tells by how much figures differ by "
            "chance.",
            (f"given-{CLIP_SIDE}", f"own-{CLIP_SIDE}"), records,
        ),
        make_table(
            "How many Gaussians and steps it takes",
            f"Clips at {CLIP_SIDE} pixels, workshop from aside with true priors; *free* is what `default` takes. With fewer "
            "steps there are 200,000 Gaussians at most.",
            [
                (f"{name_of(name)}, {label}", records.row("caps", name, variant))
                for name in ABLATION_SCENES
                for variant, label in (
                    *((f"{cap or 'free'}", f"{cap:,} Gaussians" if cap else "free") for cap in CAPS),
                    *((f"{count}-steps", f"{count:,} steps") for count in STEP_COUNTS),
                )
            ],
            (
                Shown("PSNR (inside)", (("psnr",), ("moving",))), Shown("Gaussians (active), thousand", (
                    ("gaussians", "total"), ("gaussians", "active_mean")), 0, 1e-3),
                Shown("page, MB", (("page_bytes",),), 1, 1e-6), Shown("training, s", (("seconds", "train"),), 0),
            ), "clip",
        ),
    ]  # fmt: skip


# -- rendered scenes


def _list_rendered_rows(records: Records, order: Sequence[str] = ("own", "true")) -> list[tuple[str, Row]]:
    return [(f"{name_of(name)}, {priors} priors", records.row("rig", name, priors)) for name in RENDERED for priors in order]


def _tabulate_rendered(records: Records) -> list[Table]:
    rows = _list_rendered_rows(records)
    views = make_table(
        "Held-out cameras", "480x270, 36 images by cameras beside the clip's path.", rows,
        (
            PSNR, Shown("where the clip saw it", (("ours", "covisible", "psnr"),)), SSIM,
            Shown("training frames (inside)", (("training_frames", "psnr"), ("training_frames", "moving", "psnr"))),
            Shown("warped by true depth (inside)", (
                ("baselines", "warp_by_depth", "psnr"), ("baselines", "warp_by_depth", "moving", "psnr"))),
            Shown("static scene (inside)", (("baselines", "static", "psnr"), ("baselines", "static", "moving", "psnr"))),
        ), "scene",
    )  # fmt: skip
    errors = make_table(
        "Rendered flow, depth and tracks",
        "Against the truth, on training frames. Flow: end-point error, mean over all pixels (over those of objects). Tracks: "
        "median error of moving points over 12 frames, in percent of their depth (after 12 frames).",
        _list_rendered_rows(records),
        (
            Shown("flow, px", (("flow_epe", "mean"), ("flow_epe", "moving", "mean"))),
            Shown("flow that taught it, px", (("prior_flow_epe", "mean"), ("prior_flow_epe", "moving", "mean"))),
            Shown("depth of what rests, median %", (("depth_abs_rel", "static", "median"),), 1, 100),
            Shown("depth of objects, median %", (("depth_abs_rel", "moving", "median"),), 1, 100),
            Shown("tracks, %", (("tracks", "moving", "median"), ("tracks", "moving", "last")), 1),
            Shown("Gaussians (active), thousand", (("gaussians", "total"), ("gaussians", "active_mean")), 0, 1e-3),
        ), "scene",
    )  # fmt: skip
    return [views, errors]


# -- priors


def _priors(records: Records) -> list[Table]:
    clips = [name for name in CLIPS if name != "lady-running"]
    of = {name: records.row("priors", name) for name in (*RENDERED, *clips, PAIR)}
    shown = partial(_prior, 2)
    flow = make_table(
        "Flow, cameras and depth", "Medians and means as the header says; on objects in brackets.",
        [(name_of(name), of[name]) for name in (*RENDERED, PAIR)],
        (
            shown("flow, mean px", "flow.epe", "flow.epe_objects"), _prior(1, "matches kept, %", "flow.kept"),
            _prior(1, "of these right to 1 px, %", "flow.right"), _prior(3, "cameras: path, %", "cameras.path"),
            _prior(3, "rotation, degrees", "cameras.rotation"), shown("focal length, %", "cameras.focal"),
            shown("depth, median %", "depth.static", "depth.objects"),
        ), "scene",
    )  # fmt: skip
    anew = {name: records.row("priors", name) for name in of}
    masks = make_table(
        "Masks and tracks, and what they take", "DAVIS at 854x480, rendered scenes at 480x270.",
        [(name_of(name), anew[name]) for name in (*RENDERED, *clips)],
        (
            _prior(3, "masks, IoU", "masks.iou"), _prior(1, "tracks: life, %", "tracks.life"),
            _prior(1, "within 2 px, %", "tracks.within"), _prior(0, "seconds", "time.total"),
            shown("peak memory, GiB", "time.memory"),
        ), "scene",
    )  # fmt: skip
    labels = {"own": "own priors", "outline": "true masks and depth of objects", "background": "true depth of what rests, too"}
    costs = make_table(
        "What each costs from aside", "Held-out cameras after 1,000 steps, with more and more of the priors replaced by the truth.",
        [
            (f"{name_of(name)}, {labels[oracle]}", records.row("oracles", name, oracle))
            for name in RENDERED[:2]
            for oracle in ORACLES
        ],
        (Shown("PSNR (inside)", (("psnr",), ("moving",))), Shown("where the clip saw it", (("covisible",),))), "scene",
    )  # fmt: skip
    return [flow, masks, costs]


def _prior(digits: int, header: str, *keys: str) -> Shown:
    return Shown(header, tuple(("figures", key) for key in keys), digits)


# -- ablations

ABLATED = ("bear", "train", "workshop")
"""What the ablations are shown of; of train there are records of an earlier plan."""
ORDERS_NOTE = (
    f"Differences from the paper's orders, {PAPER_ORDERS.label.partition(' (')[0]} (first those of the position, polynomial and "
    "Fourier; then those of the rotation), not from all of it. For 3, 3; 3, 3 the paper has no difference: any other contradicts "
    "that."
)


def _ablations(records: Records) -> list[Table]:
    base = make_table(
        "All of it", "What the differences below are from: the preset `default`, and for the orders of the series the paper's.",
        [
            (f"{name_of(name)}{label}", records.row("ablations", name, variant))
            for variant, label in ((FULL.name, ""), (PAPER_ORDERS.name, f", {PAPER_ORDERS.label}"))
            for name in ABLATED
        ],
        (Shown("PSNR (inside)", (("psnr",), ("moving",))), Shown("SSIM", (("ssim",),), 3)), "clip",
    )  # fmt: skip
    groups = [(group, [claim for claim in CLAIMS if claim.group == group]) for group in ("representation", "training", "orders")]
    own = [claim for claim in CLAIMS if claim.variant.name in OWN_ROWS]
    notes = {"representation": "", "training": _tell_velocity_losses(records), "orders": ORDERS_NOTE}
    tables = [_tabulate_claims(TITLES[group], notes[group], claims, records) for group, claims in groups]  # type: ignore[index]
    return [base, *tables, _tabulate_claims("What we added or chose, and a scene that stands still", "", own, records)]


def _tell_velocity_losses(records: Records) -> str:
    """Return what the flow and the rigid loss bring here and in the paper, in a sentence; nothing where it is not measured."""
    claim = next(claim for claim in CLAIMS if claim.variant.name == "no-velocity")
    pair = claim.variant.name, claim.base.name
    whole, inside = (compare(records, "ablations", ABLATED, pair, (key,))[0] for key in ("psnr", "moving"))
    if whole is None or claim.paper is None:
        return ""
    told = "" if inside is None else f" ({text(-inside.mean, 2)} dB inside what moves)"
    return (
        f"The flow and the rigid loss together bring {text(-whole.mean, 2)} dB here{told}, and {text(-claim.paper, 2)} dB in the "
        "paper."
    )


def _tabulate_claims(title: str, note: str, claims: Sequence[Claim], records: Records) -> Table:
    scenes = ABLATED
    missing = []
    has_paper = any(claim.paper is not None for claim in claims)
    rows: list[tuple[str, ...]] = []
    for claim in claims:
        pair = claim.variant.name, claim.base.name
        whole, row = compare(records, "ablations", scenes, pair, ("psnr",))
        if whole is None and claim.paper is None and not row.status():
            missing.append(claim.variant.label)
            continue
        inside, _ = compare(records, "ablations", scenes, pair, ("moving",))
        cells = [_difference(whole, inside, name) for name in scenes]
        mean = f"{text(whole.mean, 2, True)}{_bracket(inside.mean if inside else None)}" if whole else NOT_MEASURED
        said = verdict(whole, claim.expected) if whole else "–"
        paper = (text(claim.paper, 2, True),) if has_paper else ()
        rows.append((claim.variant.label, *cells, mean, *paper, said, row.status() or "–"))
    header = ("without, or with instead", *scenes, "mean", *(("the paper",) if has_paper else ()), "verdict", MEASURED_AT)
    return Table(title, add_missing(note, missing, not rows), header, rows)


def _difference(whole: Effect | None, inside: Effect | None, scene: str) -> str:
    value = whole.of_scene(scene) if whole else None
    return "–" if value is None else text(value, 2, True) + _bracket(inside.of_scene(scene) if inside else None)


def _bracket(value: float | None) -> str:
    return "" if value is None else f" ({text(value, 2, True)})"


# -- time and memory


def _tabulate_costs(records: Records) -> list[Table]:
    seconds = [Shown(stage, (("seconds", stage),), 0) for stage in STAGES]
    runs = make_table(
        "A run on a clip, in seconds",
        "Preset `default`. Whole runs include reading and all videos; *(stages)* is the sum of the stages that the benchmark of "
        "clips needs, without videos. Where the machine at the end is said to be so, seconds are those of one thread's "
        "processor.",
        [
            (f"{name_of(name)}, {size}", records.row("davis", name, variant))
            for variant, size in (("given", "854x480"), (f"given-{CLIP_SIDE}", f"{CLIP_SIDE} pixels"))
            for name in CLIPS
        ],
        (("whole", tell_whole_run), *seconds, Shown("peak memory, GiB", (("peak_memory_gib",),), 1)), "clip",
    )  # fmt: skip
    growth = make_table(
        "How time grows",
        "The built-in clip, own priors, 60 steps of training of 100 frames; seconds of the processor, one thread.",
        [
            (
                f"{count} frames of 320x180" if kind == "frames" else f"16 frames, {count} pixels wide",
                records.row("growth", f"{kind}-{count}"),
            )
            for kind, counts in GROWTH.items() for count in counts
        ],
        (*(Shown(stage, (("seconds", stage),), 0) for stage in STAGES), Shown("peak memory, GiB", (("peak",),), 1)), "clip",
    )  # fmt: skip
    short = make_table(
        "The demo", "`flowsplat demo`: 40 frames of 320x180, trained with own priors and with true ones.",
        [
            (label, records.row("demo", scene))
            for scene, label in (("street", "kernels compiled before"), ("first", "the first time, with compiling"))
        ],
        (Shown("seconds", (("seconds", "whole"),), 0), Shown("peak memory, GiB", (("peak_memory_gib",),), 1)), "",
    )  # fmt: skip
    return [runs, short, growth]


PAGES = {
    "real_clips": Page(
        "Real clips",
        "Held-out frames of clips of DAVIS 2016 and 2017: PSNR in dB, in brackets inside the masks of what moves. Everything is "
        "estimated by flowsplat but for masks where they are called given. *tuned*: settings were chosen on this clip. "
        "*Flow interpolation* warps both neighbors half-way; *static scene* is ours without motion. What others reach on these "
        "clips: [at a glance](index.md) and [the paper's tables](paper.md).",
        _tabulate_real_clips,
    ),
    "rendered_scenes": Page(
        "Rendered scenes, seen from aside",
        "Four scenes that we rendered with exact truth. All frames train, and the test is cameras beside the clip's path that "
        "training never saw: PSNR in dB, in brackets inside what moves. *True priors*: cameras, depth, masks and flow are the "
        "truth, so that the rest is what training and the representation lose.",
        _tabulate_rendered,
    ),
    "priors": Page(
        "Cameras, flow, masks, depth and tracks",
        "How far what `flowsplat prepare` estimates from the images alone is from the truth (`flowsplat benchmark priors`), and "
        "what each error costs in the end (`flowsplat benchmark oracles`). What an error of each kind is: "
        f"[the notebook]({NOTEBOOK}#priors-before-and-after).",
        _priors,
    ),
    "objects": Page(
        "How far away objects are",
        "One camera does not tell how far away something is that moves by itself. So this is measured on random worlds with exact "
        "truth (`flowsplat benchmark objects`), of seeds on which nothing was tuned. *Distance* is |ln(estimated / true)|, so "
        "0.05 is 5 %; an object that was never found counts as infinitely wrong. *Within 1, 2 sigma*: how often the truth lies "
        "within what flowsplat believes of its own error.",
        lambda records: [tabulate_worlds(records)],
    ),
    "ablations": Page(
        "What each part is worth",
        "Trainings of 1,500 steps without one part: differences in PSNR from all of it, in dB, in brackets inside what moves. "
        f"Clips at {CLIP_SIDE} pixels with given masks, workshop from aside with true priors; all are *tuned*. Both trainings of "
        f"a difference are of one commit and seed. Verdicts: a mean and spread below {EVEN_DECIBELS} dB is *no difference*, a "
        "mean below its spread *not separable*; else *confirmed* if leaving the part out makes it worse, *contradicted* if better.",
        _ablations,
    ),
    "models": Page(
        "Motion models",
        "Motions of several papers in our trainer: the same start, priors, losses, 1,500 steps and at most 100,000 Gaussians. "
        "They are no reproductions of those systems. Held out are times in gaps of 1, 3 and 5 frames and at the end of the clip: "
        "PSNR in dB. [Which to choose](../models.md).",
        list_model_tables,
    ),
    "speed": Page(
        "Time and memory",
        "What a run takes. Single kernels and steps: [Speed on a CPU](../benchmarks_cpu.md), [On a GPU](../gpu.md).",
        _tabulate_costs,
    ),
    "paper": Page(
        "The paper's tables beside ours",
        "*Learning Efficient 4D Gaussian Representations from Monocular Videos with Flow Splatting*. Published figures are of "
        "its own scenes, priors and hardware. *Ours* on DAVIS is preset `default` at 854x480 with given masks, one frame in ten "
        "held out. *Motion alone* is another test: motions of several methods, also ours, in our trainer, at 427x240 on held-out "
        "times in gaps. These rows compare with each other and with no other row; they are no reproduction of those systems. "
        "Ablations are `default` but for that part, clips at 427x240 and workshop at 480x270. Their means are over the clips that "
        "are named, the same in all rows of a table; [by clip](ablations.md). All columns: `flowsplat benchmark paper`.",
        list_paper_tables,
    ),
}
"""The pages behind the first, by the names of their files."""
