"""The first results page: on one screen how good, how fast, how much memory, and where the limits are, beside published figures."""

from __future__ import annotations

from flowsplat_benchmarks.datasets.tables import read_published
from flowsplat_benchmarks.results.cells import RENDERED
from flowsplat_benchmarks.results.rows import NOT_MEASURED, Records, Row, Shown, tell_whole_run
from flowsplat_benchmarks.tables import format_table, text

CLIPS = ("bear", "camel", "train", "lucia", "dance-twirl")
PAPER = "Flow Splatting"


def format_overview(records: Records) -> str:
    """Return the page.

    Raises:
        InputError: a record is damaged.
    """
    records.used.clear()
    quality, aside, costs = _beside_others(records), _from_aside(records), _costs(records)
    machines: dict[str, list[str]] = {}
    for commit, machine in records.machines():
        machines.setdefault(machine, []).append(commit)
    measured = "; ".join(f"{', '.join(commits)} on {machine}" for machine, commits in machines.items()) or NOT_MEASURED
    lines = [
        "---", "hide: [toc]", "---", "", "# Results at a glance", "",
        "**Along the clip's own path**: PSNR in dB of held-out frames of DAVIS at 854x480, in brackets of the pixels that move "
        "alone (inside the given masks). Published figures are those of the Flow Splatting paper, with learned priors and on "
        "held-out frames that it does not name; ours have own priors and given masks. Settings were chosen on all clips and "
        "scenes of this page but lucia and dance-twirl. [More](real_clips.md), [the paper's tables](paper.md).", "",
        *quality, "",
        "**From aside**: the same of cameras beside the path of rendered scenes. True priors tell what is left when cameras, "
        "depth, masks and flow are right. [More](rendered_scenes.md), [priors](priors.md), [distances of objects](objects.md).", "",
        *aside, "",
        "**Time and memory**, on two cores without a GPU where nothing else is said; *(stages)* are seconds of one core, without "
        "reading and videos. [More](speed.md).", "",
        *costs, "",
        "**Limits.** From aside own priors are behind true ones. What touches nothing stands at a guessed distance, and what no "
        "frame saw is a guess. The NVIDIA scenes, DyCheck and LPIPS are not measured, as data and weights were not at hand. "
        "More: [what each part is worth](ablations.md), [motion models](models.md), [what was tried and did not "
        "help](../notebook/2026-11.md).", "",
        f"Measured at {measured}.",
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


def _beside_others(records: Records) -> list[str]:
    known = read_published()["davis"]
    rows = []
    for method, figures in known["methods"].items():
        values = dict(zip(known["scenes"], figures["psnr"], strict=True))
        name = f"{method} (the paper)" if method == PAPER else method
        rows.append((name, *(text(values.get(clip), 2) for clip in CLIPS)))
    shown = Shown("", (("ours", "psnr"), ("ours", "moving", "psnr")))
    flow = Shown("", (("baselines", "flow_interpolation", "psnr"), ("baselines", "flow_interpolation", "moving", "psnr")))
    rows.append(("interpolated by optical flow", *(_cell(flow, records.row("davis", clip, "given")) for clip in CLIPS)))
    found = {clip: records.row("davis", clip, "given") for clip in CLIPS}
    rows.append(("flowsplat", *(_cell(shown, found[clip]) for clip in CLIPS)))
    rows.append(("measured at", *(found[clip].status() or "–" for clip in CLIPS)))
    return format_table(("", *CLIPS), rows, (len(rows) - 2,))


def _cell(shown: Shown, row: Row) -> str:
    return shown.cell(row) or ("failed" if row.failures() else NOT_MEASURED)


def _from_aside(records: Records) -> list[str]:
    shown = Shown("", (("ours", "psnr"), ("ours", "moving", "psnr")))
    warped = Shown("", (("baselines", "warp_by_depth", "psnr"), ("baselines", "warp_by_depth", "moving", "psnr")))
    found = {(name, priors): records.row("rig", name, priors) for name in RENDERED for priors in ("own", "true")}
    rows = [
        ("the clip's frame, warped by true depth", *(_cell(warped, records.row("rig", name, "true")) for name in RENDERED)),
        ("flowsplat, true priors", *(_cell(shown, found[name, "true"]) for name in RENDERED)),
        ("flowsplat, own priors", *(_cell(shown, found[name, "own"]) for name in RENDERED)),
        ("measured at", *(" / ".join(dict.fromkeys(found[name, p].status() or "–" for p in ("true", "own"))) for name in RENDERED)),
    ]
    return format_table(("", *RENDERED), rows, (2,))


def _costs(records: Records) -> list[str]:
    run = records.row("davis", "bear", "given")
    demo, first = records.row("demo", "street"), records.row("demo", "first")
    whole, memory = tell_whole_run(run), run.value("peak_memory_gib")
    time = "" if whole is None else f"{whole} s".replace(" (stages) s", " s (stages)")
    rows = [("bear, 82 frames of 854x480", time, "–" if memory is None else f"{text(memory, 1)} GiB", run)]
    for name, row, key in (
        ("of which training", records.row("davis", "bear", "given"), "train"),
        ("`flowsplat demo` (two runs on 40 frames of 320x180)", demo, "whole"),
        ("the same the first time, kernels compiled on the way", first, "whole"),
    ):
        value = row.value("seconds", key)
        rows.append((name, "" if value is None else f"{text(value, 0)} s", "–", row))
    told = []
    for name, seconds, gib, row in rows:
        told.append((name, seconds or ("failed" if row.failures() else NOT_MEASURED), gib, row.status() or "–"))
    return format_table(("", "time", "memory", "measured at"), told)
