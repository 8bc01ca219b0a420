"""The table of the priors benchmark as Markdown, and with images as a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from flowsplat.common.files import write_text
from flowsplat.common.spread import spread
from flowsplat.evaluation.placement import true_scale
from flowsplat.images.colors import depth_range, depth_to_color, flow_scale, flow_to_color, tint
from flowsplat.images.html import table
from flowsplat.images.sheets import side_by_side, stack
from flowsplat.scenes import Flow, Layers, Scene
from flowsplat.scenes.layers import read_image, write_image
from flowsplat_benchmarks.priors.measure import read_true_flow, true_mask
from flowsplat_benchmarks.priors.rows import DEFINITIONS, HEADER, Row, table_rows
from flowsplat_benchmarks.priors.scenes import BenchmarkScene
from flowsplat_benchmarks.reports import failures, scene_section, write_benchmark_page
from flowsplat_benchmarks.tables import Result, describe_version, format_table, plain

TITLE = "Priors, measured"
PAGE, TABLE = "priors.html", "priors.md"
STRIP = "strip.png"
STRIP_FRAMES = 3
"""Frames that are shown of a scene. Chosen by eye."""
STRIP_HEIGHT = 180
"""Pixels of a row of the strip. Chosen by eye."""
MAX_STRIP_WIDTH = 2000
"""Pixels of a strip in the page, at most. Chosen by eye."""


def write_report(out: Path, results: Sequence[Result], failed: Mapping[str, str]) -> Path:
    """Write ``priors.md`` and ``priors.html`` and return the path of the page.

    Args:
        results: the JSON of every scene; the image of each lies in the folder of its name.
        failed: scenes that could not be measured, and why.

    Raises:
        InputError: the folder cannot be written.
    """
    rows = list(table_rows(results))
    remarks = [*DEFINITIONS, *([describe_version(results)] if results else []), *failures(failed, "measured")]
    write_text(out / TABLE, _markdown(rows, remarks, results))
    marks = {"met": "✓ met", "not met": "✗ not met"}
    cells = [tuple(marks.get(cell, plain(cell)) for cell in row.cells) for row in rows]
    write_benchmark_page(
        out / PAGE,
        "priors.html.jinja",
        title=TITLE,
        verdict=verdict(rows),
        table=table(HEADER, cells, [k for k, row in enumerate(rows) if row.met is False]),
        remarks=remarks,
        scenes=[_scene(out, result) for result in results],
    )
    return out / PAGE


def verdict(rows: Sequence[Row]) -> str:
    """Return how many targets are met, in a sentence."""
    judged = [row.met for row in rows if row.met is not None]
    return f"{sum(judged)} of {len(judged)} targets met."


def _markdown(rows: Sequence[Row], remarks: Sequence[str], results: Sequence[Result]) -> str:
    lines = [f"# {TITLE}", "", verdict(rows), "", *format_table(HEADER, [row.cells for row in rows])]
    lines += ["", *(f"- {line}" for line in remarks), "", *(f"- {_facts(result)}" for result in results)]
    return "\n".join(lines) + "\n"


def _facts(result: Result) -> str:
    width, height = result["size"]
    version = result.get("flowsplat", "of unknown version")
    facts = f"{result['scene']}: {result['frames']} frames of {width}x{height}, flowsplat {version}"
    seconds = ", ".join(f"{name} {value:.0f} s" for name, value in result.get("seconds", {}).items())
    return f"{facts}; {seconds or 'prepared in several goes, so without times'}"


def _scene(out: Path, result: Result) -> dict[str, Any]:
    name, path = str(result["scene"]), out / str(result["scene"]) / STRIP
    images = [(read_image(path), f"{name}: frames, ours and the truth")] if path.exists() else []
    return scene_section(out, name, _facts(result), f"{name}/{PAGE}", images, MAX_STRIP_WIDTH)


# -- images


def write_strip(folder: Path, benchmark: BenchmarkScene, scene: Scene) -> None:
    """Draw a few frames with what was found and what is true, under each other, into ``strip.png``."""
    following = list(pairwise(scene.train_frames))
    pairs = [following[k] for k in spread(len(following), STRIP_FRAMES)]
    truth = scene.truth
    ours = [scene.flow(*pair) for pair in pairs]
    true = [_true_flow(benchmark, scene, truth, pair) for pair in pairs]
    scale = flow_scale([flow.flow for flow in true if flow is not None] or [flow.flow for flow in ours])
    if truth is not None:
        near, far = depth_range([truth.depth(i).depth for i, _ in pairs])
    elif scene.prior("depth") is not None:
        near, far = depth_range([scene.depth(i).depth for i, _ in pairs])
    rows = []
    for (i, _), found, exact in zip(pairs, ours, true, strict=True):
        panels = {f"frame {i}": scene.frame(i), "flow": flow_to_color(_find_known(found), scale)}
        if exact is not None:
            panels["true flow"] = flow_to_color(_find_known(exact), scale)
        if scene.prior("masks") is not None:
            panels["mask"] = tint(scene.frame(i), scene.mask(i) > 0)
            exact_mask = truth.mask(i) if truth is not None else true_mask(benchmark, scene, i)
            panels["true mask"] = tint(scene.frame(i), exact_mask > 0)
        if scene.prior("depth") is not None:
            depth = scene.depth(i).depth
            panels["depth"] = depth_to_color(true_scale(scene) * depth, near, far)
            if truth is not None:
                panels["true depth"] = depth_to_color(truth.depth(i).depth, near, far)
        rows.append(side_by_side(list(panels.values()), list(panels), STRIP_HEIGHT))
    write_image(folder / STRIP, stack(rows))


def _true_flow(benchmark: BenchmarkScene, scene: Scene, truth: Layers | None, pair: tuple[int, int]) -> Flow | None:
    if benchmark.kind == "pair":
        return read_true_flow(benchmark, scene)
    return truth.flow(*pair) if truth is not None and pair in truth.flow_pairs else None


def _find_known(flow: Flow) -> np.ndarray:
    return np.where(flow.trusted[..., None], flow.flow, np.nan)
