"""The first results page: on one screen how good, how fast, how much memory, and where the limits are, beside published figures."""

from __future__ import annotations

from flowsplat_benchmarks.datasets.tables import read_published
from flowsplat_benchmarks.results.cells import RENDERED
from flowsplat_benchmarks.results.rows import NOT_MEASURED, Records, Row, Shown, name_of
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
        "# Results at a glance", "",
        "**Along the clip's own path**: PSNR in dB of held-out frames of DAVIS, 854x480. Published figures are those that the "
        "Flow Splatting paper prints, with learned priors, which does not say which frames it holds out; ours estimate "
        "everything themselves but for given masks. In brackets inside the masks. [More](real_clips.md), [the paper's "
        "tables](paper.md).", "",
        *quality, "",
        "**From aside**: PSNR of cameras beside the path of rendered scenes (inside what moves). True priors tell what is left "
        "when cameras, depth, masks and flow are right. [More](rendered_scenes.md), [priors](priors.md), "
        "[distances](objects.md).", "",
        *aside, "",
        "**Time and memory**, on two cores without a GPU where nothing else is said. [More](speed.md).", "",
        *costs, "",
        "**Limits.** From aside, own priors are behind true ones, as the second table says. What touches nothing stands at a "
        "guessed distance. What no frame saw is a guess. The NVIDIA scenes, DyCheck and LPIPS are not measured here, as neither "
        "the data nor the weights were at hand.", "",
        "[What each part is worth](ablations.md) · [motion models of others in our trainer](models.md) · [what was tried before, "
        "and did not help](../notebook/2026-11.md)", "",
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
    rows.append(("interpolation by optical flow, no model", *(_cell(flow, records.row("davis", clip, "given")) for clip in CLIPS)))
    found = {clip: records.row("davis", clip, "given") for clip in CLIPS}
    rows.append(("flowsplat", *(_cell(shown, found[clip]) for clip in CLIPS)))
    rows.append(("measured at", *(found[clip].status() or "–" for clip in CLIPS)))
    return format_table(("", *map(name_of, CLIPS)), rows, (len(rows) - 2,))


def _cell(shown: Shown, row: Row) -> str:
    return shown.cell(row) or ("failed" if row.failures() else NOT_MEASURED)


def _from_aside(records: Records) -> list[str]:
    shown = Shown("", (("ours", "psnr"), ("ours", "moving", "psnr")))
    warped = Shown("", (("baselines", "warp_by_depth", "psnr"), ("baselines", "warp_by_depth", "moving", "psnr")))
    found = {(name, priors): records.row("rig", name, priors) for name in RENDERED for priors in ("own", "true")}
    rows = [
        ("the same time's frame, warped by true depth", *(_cell(warped, records.row("rig", name, "true")) for name in RENDERED)),
        ("flowsplat, true priors", *(_cell(shown, found[name, "true"]) for name in RENDERED)),
        ("flowsplat, own priors", *(_cell(shown, found[name, "own"]) for name in RENDERED)),
        ("measured at", *(" / ".join(dict.fromkeys(found[name, p].status() or "–" for p in ("true", "own"))) for name in RENDERED)),
    ]
    return format_table(("", *map(name_of, RENDERED)), rows, (2,))


def _costs(records: Records) -> list[str]:
    run, small = records.row("davis", "bear", "given"), records.row("davis", "bear", "given-427")
    demo, first = records.row("demo", "street"), records.row("demo", "first")
    rows = []
    for name, row, path in (
        ("bear, 82 frames of 854x480, video to page and videos", run, ("whole_seconds",)),
        ("of which training", run, ("seconds", "train")),
        ("bear at half size, training", small, ("seconds", "train")),
        ("`flowsplat demo` (two runs on 40 frames of 320x180)", demo, ("seconds", "whole")),
        ("the same the first time, kernels compiled on the way", first, ("seconds", "whole")),
    ):
        seconds, memory = row.value(*path), row.value("peak_memory_gib")
        cell = ("failed" if row.failures() else NOT_MEASURED) if seconds is None else f"{text(seconds, 0)} s"
        told = "–" if memory is None or seconds is None or "seconds" in path else f"{text(memory, 1)} GiB"
        rows.append((name, cell, told, row.status() or "–"))
    return format_table(("", "time", "memory", "measured at"), rows)
