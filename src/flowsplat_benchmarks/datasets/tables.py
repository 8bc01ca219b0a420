"""The tables of a protocol: our figures and those of simple baselines beside the published ones."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from importlib.resources import files
from typing import Any

from flowsplat.evaluation.baselines import BASELINES, list_baselines, title_of
from flowsplat.evaluation.scores import mean_of, pick
from flowsplat.images.html import NOTHING
from flowsplat_benchmarks.datasets.cases import FORMS
from flowsplat_benchmarks.tables import Column, Result, Table, compute_scaled_mean, label, text

DIGITS = {"psnr": 2, "ssim": 3, "lpips": 3}
NAMES = {"psnr": "PSNR", "ssim": "SSIM", "lpips": "LPIPS (AlexNet)"}


def read_published() -> dict[str, Any]:
    """Figures of other methods, each part with its ``source``."""
    return json.loads(files(__package__).joinpath("published.json").read_text(encoding="utf-8"))


def tables(protocol: str, results: Sequence[Result]) -> list[Table]:
    """Return all tables of a protocol, from the JSON of its cases (``measure.measure_case``)."""
    found = list(_beside_published(protocol, results))
    return [*found, _images(results), *_truth(results), _cost(results)] if results else []


def _beside_published(protocol: str, results: Sequence[Result]) -> Iterator[Table]:
    known = read_published()
    if protocol == "davis":
        for metric in ("psnr", "ssim", "lpips"):
            yield _matrix(f"{NAMES[metric]}, held-out frames", known["davis"], results, metric)
    if protocol == "dycheck" and results:
        yield _tabulate_dycheck(results)
    if protocol == "nvidia":
        marbles = [result for result in results if result["form"] == "nerfies"]
        if marbles:
            yield _nvidia(known["nvidia"], marbles)
        twelve = [result for result in results if result["form"] == "twelve"]
        for metric in ("psnr", "lpips") if twelve else ():
            yield _matrix(f"{NAMES[metric]}, {FORMS['twelve']}", known["nvidia_twelve"], twelve, metric)


_DYCHECK = (
    Column("mPSNR", ("dycheck", "mpsnr"), 2), Column("mSSIM", ("dycheck", "mssim"), 3), Column("PCK, %", ("dycheck", "pck"), 1),
    Column("images", ("dycheck", "views"), 0), Column("points carried", ("dycheck", "transfers"), 0),
)  # fmt: skip


def _tabulate_dycheck(results: Sequence[Result]) -> Table:
    rows = [(label(result), _how(result), *(column.cell(result) for column in _DYCHECK)) for result in results]
    if len(results) > 1:
        rows.append(("mean", "", *(column.cell(*results) for column in _DYCHECK)))
    note = "Inside the masks of what the clip saw; a dash where the scene has no such masks, or no marked points."
    return Table("DyCheck's measures", note, ("scene", "run", *(column.header for column in _DYCHECK)), rows)


def _method(name: str) -> str:
    return f"{name} (the paper)" if name == "Flow Splatting" else name


def _how(result: Result) -> str:
    """Return what tells one run of a scene from another."""
    return f"{result['variant']}, {result['settings']}"


# -- one metric: methods down, scenes across


def _matrix(title: str, known: Mapping[str, Any], results: Sequence[Result], metric: str) -> Table:
    own = {result["scene"].casefold(): label(result) for result in results}
    names = {scene.casefold(): own.get(scene.casefold(), scene) for scene in known["scenes"]}
    columns = names | {key: name for key, name in own.items() if key not in names}
    lines: list[tuple[str, dict[str, float | None], bool]] = [
        (_method(method), dict(zip(names, figures[metric], strict=True)), False)
        for method, figures in known["methods"].items()
        if metric in figures
    ]
    for how in dict.fromkeys(_how(result) for result in results):
        group = [result for result in results if _how(result) == how]
        lines.append((f"flowsplat, {how}", _by_scene(group, ("ours", metric)), True))
        lines.append((f"{title_of('static')}, {how}", _by_scene(group, ("baselines", "static", metric)), False))
    for baseline in (name for name in list_baselines(of_views=False) if name != "static"):
        lines.append((title_of(baseline), _by_scene(results, ("baselines", baseline, metric)), False))
    lines = [line for line in lines if any(value is not None for value in line[1].values()) or line[2]]
    rows: list[tuple[str, ...]] = []
    for name, values, _ in lines:
        cells = [values.get(key) for key in columns]
        for scenes in (tuple(names), tuple(own)):
            scores = [values.get(key) for key in scenes]
            cells.append(None if None in scores else mean_of(scores))
        rows.append((name, *(text(cell, DIGITS[metric]) for cell in cells)))
    header = ("method", *columns.values(), f"mean of the {len(names)} published", "mean of those run here")
    note = f"Published: {known['source']}. A mean is left out where a scene is missing."
    return Table(title, note, header, rows, tuple(k for k, line in enumerate(lines) if line[2]))


def _by_scene(results: Sequence[Result], path: tuple[str, ...]) -> dict[str, float | None]:
    """Return the figure of every scene, from the first run that has it."""
    found: dict[str, float | None] = {}
    for result in results:
        key, value = result["scene"].casefold(), pick(result, *path)
        found[key] = found[key] if found.get(key) is not None else value
    return found


# -- NVIDIA as the paper has it: methods down, columns of all kinds


def _nvidia(known: Mapping[str, Any], results: Sequence[Result]) -> Table:
    digits = (2, 2, 2, 2, 1, 0, 0)
    rows = [
        (_method(method), *(value if isinstance(value, str) else text(value, d) for value, d in zip(values, digits, strict=True)))
        for method, values in known["methods"].items()
    ]
    ours = []
    for how in dict.fromkeys(_how(result) for result in results):
        group = [result for result in results if _how(result) == how]
        means = [mean_of(pick(result, "ours", metric) for result in group) for metric in DIGITS]
        means.append(compute_scaled_mean([pick(result, "seconds", "train") for result in group], 1 / 3600))
        means.append(compute_scaled_mean([pick(result, "images_a_second") for result in group]))
        means += [
            compute_scaled_mean([pick(result, "gaussians", key) for result in group], 1e-3) for key in ("active_mean", "total")
        ]
        ours.append(len(rows))
        rows.append((f"flowsplat, {how}", *(text(mean, d) for mean, d in zip(means, digits, strict=True))))
        for name in BASELINES.names():
            scores = [mean_of(pick(result, "baselines", name, metric) for result in group) for metric in DIGITS]
            if any(score is not None for score in scores):
                rows.append((title_of(name), *(text(s, d) for s, d in zip(scores, digits, strict=False)), *[NOTHING] * 4))
    scenes = ", ".join(dict.fromkeys(label(result) for result in results))
    note = f"Published: {known['source']}. Ours: means over {scenes}, on this machine."
    header = (
        "method", "PSNR", "SSIM", "LPIPS", "training, hours", "images a second", "Gaussians active, thousand",
        "Gaussians, thousand",
    )  # fmt: skip
    return Table(f"NVIDIA, {FORMS['nerfies']}", note, header, rows, tuple(ours))


# -- every case on its own


def _images(results: Sequence[Result]) -> Table:
    rows: list[tuple[str, ...]] = []
    ours: list[int] = []
    has_refined = any(result.get("refined") for result in results)
    for result in results:
        for name, figures in {"": result["ours"], **result["baselines"]}.items():
            if figures is None:
                continue
            values = [text(pick(figures, metric), digits) for metric, digits in DIGITS.items()]
            regions = [pick(figures, *path) for path in (("moving", "psnr"), ("moving", "ssim"), ("covisible", "psnr"))]
            if not name:
                ours.append(len(rows))
            method = title_of(name) if name else f"flowsplat, {_how(result)}"
            extra = [text(value, digits) for value, digits in zip(regions, (2, 3, 2), strict=True)]
            if has_refined:
                refined = None if name else result.get("refined")
                extra += [text(pick(refined or {}, *path), 2) for path in (("psnr",), ("moving", "psnr"))]
            rows.append((label(result), _form_of(result), method, *values, *extra))
    header: tuple[str, ...] = (
        "scene", "form", "method", "PSNR", "SSIM", "LPIPS", "PSNR of objects", "SSIM of objects", "PSNR where the clip saw it",
    )  # fmt: skip
    note = (
        "Full image, and inside the masks of what moves (given or true ones; a dash where there are none). LPIPS looks at "
        "patches and has no value inside a mask. Copied is the frame before a held-out one, or that of a held-out camera's time."
    )
    if has_refined:
        header += ("PSNR, poses refined", "PSNR of objects, poses refined")
        note += (
            " All figures use the poses of held-out frames as they were estimated, but for those in the columns called refined: "
            "there the pose of every held-out frame alone was fitted to its own image."
        )
    return Table("All test images", note, header, rows, tuple(ours))


def _form_of(result: Result) -> str:
    return FORMS.get(result["form"], "held-out frames" if result["test"]["kind"] == "frames" else "held-out cameras")


_ERRORS = (
    Column("flow, mean px", ("flow_epe", "mean"), 3),
    Column("flow, median px", ("flow_epe", "median"), 3),
    Column("flow of objects, mean px", ("flow_epe", "moving", "mean"), 3),
    Column("flow of the prior, mean px", ("prior_flow_epe", "mean"), 3),
    Column("flow of the prior on objects, mean px", ("prior_flow_epe", "moving", "mean"), 3),
    Column("flow against its prior, median px", ("flow_prior_epe", "median"), 3),
    Column("depth of static, mean %", ("depth_abs_rel", "static", "mean"), 2, factor=100),
    Column("depth of objects, mean %", ("depth_abs_rel", "moving", "mean"), 2, factor=100),
    Column("tracks on objects, median %", ("tracks", "moving", "median"), 2),
    Column("tracks on objects after 12 frames, median %", ("tracks", "moving", "last"), 2),
    Column("tracks on objects within 5 %, %", ("tracks", "moving", "within_5"), 1),
    Column("tracks on static, median %", ("tracks", "static", "median"), 2),
)


def _truth(results: Sequence[Result]) -> Iterator[Table]:
    """Yield how far flow, depth and tracks are from the truth, where there is one; and rendered flow from its prior."""
    used = [column for column in _ERRORS if column.is_in(results)]
    if not used:
        return
    rows = [(label(result), _how(result), *(column.cell(result) for column in used)) for result in results]
    note = (
        "Rendered flow and depth on training frames. Tracks: true points are asked for at their pixel and followed through the "
        "model over 12 frames; their distance from the truth is in percent of their depth. Estimated cameras get one scale a clip."
    )
    yield Table("Flow, depth and tracks", note, ("scene", "run", *(column.header for column in used)), rows)


_SIZES = (
    Column("peak memory, GiB", ("peak_memory_gib",), 2),
    Column("Gaussians active, mean", ("gaussians", "active_mean"), 0),
    Column("Gaussians", ("gaussians", "total"), 0),
    Column("images a second", ("images_a_second",), 1),
    Column("PSNR of training frames", ("training_frames", "psnr"), 2),
)


def _cost(results: Sequence[Result]) -> Table:
    rows: list[tuple[str, ...]] = []
    for result in results:
        seconds = result["seconds"]
        stages = ", ".join(f"{name} {value:.0f}" for name, value in seconds.items())
        width, height = result["size"]
        test = result["test"]
        rows.append((
            label(result), _how(result), f"{result['frames']} of {width}x{height}", f"{test['count']} {test['kind']}", stages,
            text(sum(value for name, value in seconds.items() if name != "static"), 0), *(each.cell(result) for each in _SIZES),
        ))  # fmt: skip
    header = (
        "scene", "run", "frames", "test images", "seconds by stage", "seconds", *(each.header for each in _SIZES),
    )  # fmt: skip
    note = "By the clock, on this machine; the sum leaves out the static scene, which is there for comparison only."
    return Table("Time, memory and size", note, header, rows)
