"""Write what ``everything`` found as a page; parts that are missing, or failed, say so."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

Result = dict[str, Any]


def page(result: Result) -> Iterator[str]:
    """Yield lines of Markdown."""
    machine = result.get("machine", {})
    yield f"## {machine.get('card', 'no card')}"
    yield ""
    about = {"driver": "driver", "cuda": "CUDA", "torch": "PyTorch", "triton": "Triton", "python": "Python"}
    versions = ", ".join(f"{what} {machine[name]}" for name, what in about.items() if machine.get(name))
    yield f"{machine.get('memory_gib', 0)} GiB, {machine.get('cores')} cores beside it; {versions}."
    yield f"{_commit(result)}; parts of another commit say so."
    for name, write in PARTS.items():
        found = result["parts"].get(name)
        if found is None:
            continue
        yield ""
        yield f"### {TITLES[name]}"
        yield ""
        if "commit" in found and _commit(found) != _commit(result):
            yield f"{_commit(found)}."
            yield ""
        if found["outcome"] != "done":
            yield f"**{found['outcome'].capitalize()}**: what it had found by then."
            yield ""
        yield from write({**found["figures"]})


def _commit(about: Result) -> str:
    return f"Commit {str(about.get('commit'))[:7]}{' and changes' if about.get('changed') else ''}, {about['date'][:10]}"


def _table(head: list[str], rows: list[list[str]]) -> Iterator[str]:
    yield f"| {' | '.join(head)} |"
    yield f"| --- {'| ---: ' * (len(head) - 1)}|"
    yield from (f"| {' | '.join(row)} |" for row in rows)


def _kernels(found: Result) -> Iterator[str]:
    tests = found.get("tests", {})
    yield f"{tests.get('passed', 0)} tests passed, {tests.get('failed', 0)} failed, {tests.get('skipped', 0)} were skipped."
    for name in tests.get("failures", {}):
        yield f"- failed: `{name}`"


def _step(found: Result) -> Iterator[str]:
    presets = {name: row for name, row in found.items() if isinstance(row, dict) and "step" in row}
    rows = [
        [name, f"{row['step']['min_ms']:.1f}", f"{row['step']['median_ms']:.1f}", f"{row['peak_memory_gib']:.2f}"]
        for name, row in presets.items()
    ]
    yield from _table(["preset", "fastest ms", "median ms", "peak GiB"], rows)
    profile = found.get("kernels")
    if profile and profile.get("launches"):
        yield ""
        yield f"Of a step of the default the card is busy for **{profile['busy_ms']:.2f} ms**, in {profile['launches']} launches:"
        yield ""
        named = [[f"`{name}`", f"{row['ms']:.3f}", f"{row['launches']:.0f}"] for name, row in list(profile["kernels"].items())[:12]]
        yield from _table(["kernel", "ms", "launches"], named)
    if "warps" in found:
        yield ""
        chosen = found["warps"].get("chosen", {})
        tried = found["warps"].get("ms of its kernel", {})
        lines = [
            [f"`{name}`", chosen.get(name, ""), ", ".join(f"{value}: {ms:.3f}" for value, ms in values.items())]
            for name, values in tried.items()
        ]
        yield from _table(["setting of the kernels", "as it is", "ms of its kernel with other values"], lines)


def _frames(found: Result) -> Iterator[str]:
    limits = found.get("limits", {})
    if "copy_bytes_per_second" in limits:
        yield (
            f"Measured limits: {limits['copy_bytes_per_second'] / 1e9:,.0f} GB/s copied, "
            f"{limits['flops_per_second'] / 1e12:.1f} TFLOP/s of FMAs."
        )
        yield ""
    rows = []
    for name, row in found.items():
        if isinstance(row, dict) and "frames_per_second" in row:
            graph = "" if row["graph"] is None else f"{row['graph']['median_ms']:.3f}"
            both = f"{row['forward_and_backward']['median_ms']:.2f}"
            stages = [f"{row['stages'][stage]['median_ms']:.3f}" for stage in ("cull", "slice", "project", "features", "blend")]
            rows.append([name, f"{row['active']:,}", f"{row['forward']['median_ms']:.2f}", graph, both, *stages])
    yield from _table(
        [
            "image, channels",
            "active",
            "frame ms",
            "by a CUDA graph",
            "with gradients",
            "cull",
            "slice",
            "project",
            "features",
            "blend",
        ],
        rows,
    )


def _describe_agreement(found: Result) -> Iterator[str]:
    ours, other = found.get("card", {}), found.get("CPU, one rounding beside", {})
    steps = list(ours)
    rows = []
    for name in next(iter(ours.values()), {}):
        if any(ours[step][name] is not None for step in steps):
            values = [" / ".join(_small(side[step][name]) for side in (ours, other)) for step in steps]
            rows.append([f"`{name}`", *values])
    yield from _table(["card / CPU nudged", *(f"after {step}" for step in steps)], rows)
    yield ""
    for name, row in found.get("images", {}).items():
        aim, beside = row["to the aim"], row["to the CPU's"]
        yield f"- {name}: {aim:.2f} dB against what was to be learned, {beside:.1f} dB against the CPU's image"


def _small(value: float | None) -> str:
    return "" if value is None else f"{value:.1e}"


def _memory(found: Result) -> Iterator[str]:
    rows = [
        [name, f"{row['active']:,}", f"{row['forward']['median_ms']:.2f}", f"{row['forward_and_backward']['median_ms']:.2f}",
         f"{row['peak_memory_gib']:.2f}"]
        for name, row in found.items() if isinstance(row, dict) and "active" in row
    ]  # fmt: skip
    yield from _table(["Gaussians", "active", "frame ms", "with gradients", "peak GiB"], rows)


def _gsplat(found: Result) -> Iterator[str]:
    rows = []
    for name, row in found.items():
        if isinstance(row, dict) and "ratio" in row:
            ours, theirs = row["flowsplat"], row["gsplat"]
            cells = [f"{side[way]['min_ms']:.2f}" for way in ("forward", "both") for side in (ours, theirs)]
            rows.append([name, *cells, f"{row['ratio']['forward']:.2f} / {row['ratio']['both']:.2f}"])
    head = ["image, channels", "ours ms", "gsplat ms", "ours with gradients", "gsplat with gradients", "gsplat / ours"]
    yield from _table(head, rows)


def _describe_training(found: Result) -> Iterator[str]:
    rows = []
    for name, row in found.items():
        if isinstance(row, dict) and "training_seconds" in row:
            psnr = ", ".join(f"{what.replace('_', ' ')} {value:.2f}" for what, value in row["psnr"].items())
            rows.append([name, f"{row['steps']}", f"{row['training_seconds']:.0f}", f"{row['peak_memory_gib']:.2f}", psnr])
    yield from _table(["scene, where", "steps", "training s", "peak GiB", "PSNR in dB"], rows)


def _describe_viewing(found: Result) -> Iterator[str]:
    rows = []
    for name, row in found.items():
        if isinstance(row, dict) and "gaussians" in row:
            rows += [
                [f"{name.removeprefix('trained: ')}, {way}", f"{row['gaussians']:,}", f"{value:,.0f}"]
                for way, value in row.items() if way != "gaussians"
            ]  # fmt: skip
    yield from _table(["scene, image", "Gaussians", "frames a second"], rows)


PARTS = {
    "kernels": _kernels, "viewing": _describe_viewing, "training": _describe_training, "step": _step, "agreement":
    _describe_agreement, "frames": _frames, "memory": _memory, "gsplat": _gsplat,
}  # fmt: skip
TITLES = {
    "kernels": "Kernels against their oracles", "viewing": "Frames a second of a trained scene",
    "training": "Whole trainings", "step": "A training step, 196,000 Gaussians, 854x480",
    "agreement": "The same model after so many steps", "frames": "Frames of 196,000 drawn Gaussians",
    "memory": "Ever more Gaussians, 854x480, six channels", "gsplat": "Beside gsplat's kernels",
}  # fmt: skip
