"""The tables of a protocol as Markdown, and with images as a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from flowsplat.scenes.layers import read_image
from flowsplat_benchmarks.datasets.cases import ProtocolName
from flowsplat_benchmarks.datasets.tables import tables
from flowsplat_benchmarks.reports import Report, failures, runs_measured, scene_section
from flowsplat_benchmarks.tables import Result, describe_version, label, plain

TITLES = {"davis": "DAVIS", "rig": "Rendered scenes with truth", "nvidia": "NVIDIA Dynamic Scenes", "dycheck": "DyCheck"}
RULES = {
    "davis": (
        "Every tenth frame is held out (9, 19, ..., never the last). Of these frames only the camera is known: cameras are "
        "estimated from the whole clip, as in the paper, and the masks of held-out frames are seen by the evaluation alone."
    ),
    "rig": (
        "All frames train; the test is held-out cameras. With own priors a held-out camera stands to the estimated camera of its "
        "time as the true one does, with one scale a clip."
    ),
    "nvidia": (
        "Cameras are calibrated and given; the other cameras of the rig are the test. Masks, flow, depth and tracks are our own. "
        "Where the clip's camera stands still, nothing tells the scale of its depth."
    ),
    "dycheck": (
        "Cameras are given; the other cameras are the test, where the clip saw what they show. PCK is the share of marked points "
        "that are carried from one frame to another and come within 5 % of the longer side of where they were marked there, over "
        "all pairs of frames with marks. Masks, flow, depth and tracks are our own: depth of a sensor is not read."
    ),
}
MARKS = "Scenes on which settings were chosen are marked tuned. Predictions without a model stand beside ours, from the same runs."
STRIP = ".png"


def write_report(protocol: ProtocolName, out: Path, results: Sequence[Result], failed: Mapping[str, str]) -> Path:
    """Write ``OUT/<protocol>.md`` and ``.html`` and return the path of the page.

    Args:
        results: the JSON of every case.
        failed: cases that could not be run, and why.

    Raises:
        InputError: the folder cannot be written.
    """
    remarks = [RULES[protocol], MARKS]
    remarks += [describe_version(results)] if results else []
    remarks += sorted({str(result["lpips_reason"]) for result in results if result["lpips_reason"]})
    remarks += failures(failed)
    scenes = [_scene(out, result) for result in results]
    verdict = runs_measured(results, failed)
    return Report(protocol, TITLES[protocol], verdict, remarks, tables(protocol, results), scenes).write(out)


def _scene(out: Path, result: Result) -> dict[str, Any]:
    name = str(result["name"])
    path = out / f"{name}{STRIP}"
    images = [(read_image(path), f"{name}: test images")] if path.exists() else []
    verdicts = [f"{prior}: {verdict}" for prior, verdict in result["verdicts"].items() if verdict]
    facts = "; ".join([result["variant"], result["settings"], *verdicts])
    return scene_section(out, plain(label(result)), facts, f"{name}/report.html", images)
