"""A result as a page of tables, and beside an earlier one."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from flowsplat_benchmarks.scripts.cpu_parts.floor import backward_flops, forward_flops

Json = dict[str, Any]
MIN_LISTED_SHARE = 0.01
"""Parts of a training step below this share of it are not listed. Chosen by eye."""


def format_page(result: Json) -> str:
    """Return the page for the docs: every part that was measured."""
    parts = {
        "limits": _limits, "rasterizer": _rasterizer, "torch": _torch, "training": _describe_training, "viewing": _describe_viewing,
        "scaling": _describe_scaling, "large": _large, "startup": _startup, "variants": _variants,
    }  # fmt: skip
    return "\n\n".join([_head(result), *(write(result[name]) for name, write in parts.items() if result.get(name))]) + "\n"


def _head(result: Json) -> str:
    machine, changed = result["machine"], " with uncommitted changes" if result["changed"] else ""
    loads = " and ".join(str(load[0]) for load in (result["load_before"], result["load_after"]) if load)
    versions = (
        f"Python {machine['python']}, torch {machine['torch']}, Numba {machine['numba']} ({machine['threading_layer']} threads)"
    )
    short = "\n\n**A short run: few repetitions.**" if result["quick"] else ""
    return f"""# Benchmarks on the CPU

Written by `python -m flowsplat_benchmarks.scripts.cpu --docs docs/benchmarks_cpu.md`. Times are in milliseconds,
**minimum / median** of many repetitions; whatever is compared took turns in one process. Compare ratios, not machines.

| | |
| --- | --- |
| processor | {machine["processor"]}, {machine["cores"]} cores, {machine["memory_gib"]} GiB, {machine["system"]} |
| vectors | {machine["instructions"]}, compiled for {machine["compiled_for"]} |
| versions | {versions} |
| commit | {(result["commit"] or "unknown")[:12]}{changed} |
| date | {result["date"]} |
| other load (1 minute) | {loads or "unknown"} before and after |{short}"""


def _limits(limits: Json) -> str:
    rows = [
        (name, _best(value["fma_gflops"]), _best(value["triad_gbs"]) if "triad_gbs" in value else "")
        for name, value in limits.items()
    ]
    return "## What the machine can do\n\n" + _table(("", "FMA, GFLOP/s, best / median", "memory (triad), GB/s"), rows)


def _rasterizer(part: Json) -> str:
    counts = [
        (size, f"{c['visible']:,}", f"{c['instances']:,}", f"{c['pairs'] / 1e6:.2f} M", f"{c['pairs_per_pixel']:.1f}")
        for size, c in part["work_load"].items()
    ]  # fmt: skip
    text = f"""## The rasterizer

The work load: Gaussians on a surface, 85 % with a standard deviation of about 1.35 pixels and 15 % of about 4 (as many pixels at
every size). A pair is a pixel inside the alpha >= 1/255 ellipse of a Gaussian; an instance is a Gaussian in a tile of 16 x 16.

{_table(("size", "visible", "instances", "pairs", "pairs a pixel"), counts)}

The floor is the time that the arithmetic of the pairs takes at the FMA peak above: 20 + 2 C operations a pair forward
({forward_flops(3)} at C = 3) and 34 + 4 C backward ({backward_flops(3)});
`flowsplat_benchmarks/scripts/cpu_parts/floor.py` counts them.
Projecting, sorting, tiling, memory and branches cost nothing in it, and pixels that have stopped still count.

"""
    rows = [
        (name, _time(row["forward"]), f"{row['forward_floor_ms']:.2f}", f"{row['forward_ratio']:.1f}", _time(row["backward"]),
         f"{row['backward_floor_ms']:.2f}", f"{row['backward_ratio']:.1f}")
        for name, row in part["rows"].items()
    ]  # fmt: skip
    text += _table(("", "forward", "floor", "ratio", "backward", "floor", "ratio"), rows)
    for way in ("forward", "backward"):
        names = _union(row[f"{way}_stages"] for row in part["rows"].values())
        rows = [
            (name, *(_time(row[f"{way}_stages"][stage]) if stage in row[f"{way}_stages"] else "" for stage in names))
            for name, row in part["rows"].items()
        ]
        text += f"\n\nStages of the {way} pass (the rest is torch and allocation):\n\n{_table(('', *names), rows)}"
    return text


def _torch(part: Json) -> str:
    rows = [
        (
            f"{name}, {way}",
            _time(row["flowsplat"][way]),
            *(cell for kind in ("simple", "careful") for cell in (_time(row[kind][way]), f"{row[kind][f'{way}_ratio']:.0f}")),
        )
        for name, row in part.items()
        for way in ("forward", "backward")
    ]
    return f"""## Beside plain torch

Tiles of 16 x 16 under autograd, with the same rules and the same image
(`flowsplat_benchmarks/scripts/cpu_parts/torch_tiles.py`).
*Simple* is what anyone would write first: every tile takes its Gaussians from the whole scene. *Careful* was made as fast as plain
torch allowed: Gaussians are sorted into tiles and gathered once a row of tiles, and every row is differentiated as soon as it is
drawn. Their many small operations gain little from threads.

{_table(("", "flowsplat", "simple", "times slower", "careful", "times slower"), rows)}"""


def _describe_training(part: Json) -> str:
    text = f"""## A training step

One frame rendered, differentiated and stepped at {_size(part)} with {_threads(part)}: `Trainer` on a synthetic clip of six frames.
Of the Gaussians, 40 % are background, always active; 60 % are objects, a sixth of them active in each frame. All losses of the
preset take part. Neighbors of the rigid loss are found already, which has to be done again after some hundred steps.

"""
    columns = (
        "preset",
        "Gaussians",
        "active",
        "moving",
        "numbers each",
        "SH",
        "flow",
        "neighbors",
        "to find them",
        "depth loss",
        "step",
    )
    rows = [
        (name, f"{p['gaussians']:,}", f"{p['active']:,}", f"{p['active_moving']:,}", p["numbers_per_gaussian"], p["sh_degree"],
         p["flow_model"], p["rigid_neighbors"],
         f"{p['neighbors_ms']:,.0f}, every {p['neighbors_every']:,} steps", "yes" if p["depth_loss"] else "no", _time(p["step"]))
        for name, p in part["presets"].items()
    ]  # fmt: skip
    text += _table(columns, rows)
    for name, preset in part["presets"].items():
        least = MIN_LISTED_SHARE * preset["step"]["min_ms"]
        parts = sorted(preset["parts"].items(), key=lambda item: -item[1]["min_ms"])
        listed = [(label, _time(value)) for label, value in parts if value["min_ms"] >= least]
        text += f"\n\nParts of the step of `{name}`, by Python's profiler (those above 1 %):\n\n{_table(('part', 'time'), listed)}"
    return text


def _describe_viewing(part: Json) -> str:
    rows = [(name, _time(value), f"{value['frames_per_second']:.1f}") for name, value in part["ways"].items()]
    return f"""## Rendering to look at

A 4D scene, {part["active"]:,} active of {part["gaussians"]:,} Gaussians, {_size(part)}, {_threads(part)}, without gradients:
colors alone (C = 3); `render`, with depth; `SceneModel.render`, with holes filled and arrays to take away.

{_table(("", "a frame", "frames a second (median)"), rows)}"""


def _describe_scaling(part: Json) -> str:
    titles = {
        "gaussians": "More Gaussians, as much smaller as they are more (854x480, C = 3)",
        "pixels": "More pixels, the same 100,000 Gaussians (C = 3)",
        "channels": "More channels (100,000 Gaussians, 854x480)",
    }
    text = "## How the cost grows"
    for family, rows in part.items():
        table = [
            (name, f"{row['pairs'] / 1e6:.1f} M", f"{row['instances']:,}", _time(row["forward"]), f"{row['forward_ratio']:.1f}",
             _time(row["backward"]), f"{row['backward_ratio']:.1f}")
            for name, row in rows.items()
        ]  # fmt: skip
        text += f"\n\n{titles[family]}, {_threads(next(iter(rows.values())))}:\n\n"
        text += _table(("", "pairs", "instances", "forward", "x floor", "backward", "x floor"), table)
    return text


def _large(part: Json) -> str:
    memory = part["memory_mib"]
    rows = [
        ("render", _time(part["forward"]), f"{memory['forward']:,}"),
        ("render and differentiate", _time(part["forward_and_backward"]), f"{memory['forward_and_backward']:,}"),
    ]
    return f"""## A large image

{part["gaussians"]:,} Gaussians at {_size(part)}, C = {part["channels"]}, {_threads(part)}, in a process of its own that holds
{memory["before"]:,} MiB with everything loaded before the first image.

{_table(("", "time", "peak memory, MiB"), rows)}"""


def _startup(part: Json) -> str:
    rows: list[tuple[str, ...]] = [("import torch", _time(part["import torch"]), "", "", "")]
    for name, value in part.items():
        if name != "import torch":
            beyond = [f"{value[f'{way}_beyond_torch_ms']:,.0f}" for way in ("warm", "cold")]
            rows.append((name, _time(value["warm"]), beyond[0], _time(value["cold"]), beyond[1]))
    columns = ("whole process", "warm", "beyond torch", "cold", "beyond torch")
    return f"""## Starting

Whole processes, from the command to its end. Warm: compiled kernels lie in Numba's cache. Cold: the cache is empty, as at the first
start after installing. The images are 854x480 of 5,000 Gaussians.

{_table(columns, rows)}"""


def _variants(part: Json) -> str:
    titles = {"avx2": "Compiled for AVX2 only", "workqueue": "With Numba's fallback threads (workqueue)"}
    text = "## Otherwise compiled or threaded\n\nThe rasterizer in processes that took turns with normal ones."
    for variant, value in part.items():
        limits = ", ".join(f"{_best(limit['fma_gflops'])} GFLOP/s ({name})" for name, limit in value["limits"].items())
        rows = []
        for name, row in value["rows"].items():
            times = value["times_normal"][name]
            rows.append(
                (name, _time(row["forward"]), f"{row['forward_ratio']:.1f}", f"{times['forward']:.2f}", _time(row["backward"]),
                 f"{row['backward_ratio']:.1f}", f"{times['backward']:.2f}")
            )  # fmt: skip
        columns = ("", "forward", "x floor", "x normal", "backward", "x floor", "x normal")
        text += f"\n\n{titles[variant]}; FMA peak best / median {limits}:\n\n{_table(columns, rows)}"
    return text


def comparison(result: Json, earlier: Json) -> str:
    """Return every time that both results have: now, then, and now / then (minima; below 1 is faster now)."""
    now, then = dict(_times(result)), dict(_times(earlier))
    rows = [(name, f"{now[name]:.4g}", f"{then[name]:.4g}", f"{now[name] / then[name]:.2f}") for name in now if name in then]
    title = f"## Beside {(earlier['commit'] or 'an unknown commit')[:12]} of {earlier['date']}"
    return f"{title}\n\n{_table(('minimum, ms', 'now', 'then', 'ratio'), rows)}\n"


def _times(value: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, float]]:
    if isinstance(value, dict):
        if "min_ms" in value:
            yield " / ".join(path), value["min_ms"]
        for name, item in value.items():
            yield from _times(item, (*path, name))


def _table(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)


def _time(value: Json) -> str:
    return f"{_digits(value['min_ms'])} / {_digits(value['median_ms'])}"


def _digits(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.1f}" if value >= 10 else f"{value:.2f}"


def _best(value: Json) -> str:
    return f"{_digits(value['best'])} / {_digits(value['median'])}"


def _size(part: Json) -> str:
    return f"{part['size'][0]}x{part['size'][1]}"


def _threads(part: Json) -> str:
    return f"{part['threads']} thread{'s' if part['threads'] > 1 else ''}"


def _union(names: Iterable[Iterable[str]]) -> list[str]:
    return list(dict.fromkeys(name for group in names for name in group))
