"""Draw the packages, from what they import, and the way of the data through the stages of a run.

    python docs/tools/drawings.py

writes ``packages.svg`` and ``stages.svg`` into ``docs/images``. Colors can be read on light and on dark pages.
"""

from __future__ import annotations

import ast
import html
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

TOP = Path(__file__).parents[2]
SOURCE, IMAGES = TOP / "src", TOP / "docs" / "images"
BENCHMARKS = "flowsplat_benchmarks"
SAYS = {
    "common": "files, errors, kernels, progress",
    "images": "colors, video, HTML",
    "geometry": "cameras, projection, rotations",
    "splatting": "the rasterizer",
    "scenes": "clips, frames, layers",
    "priors": "cameras, flow, masks, depth",
    "gaussians": "Gaussians4D, motion, flow",
    "training": "losses, strategies, optimizer",
    "evaluation": "metrics, baselines",
    "output": "videos, report, viewer, export",
    "pipeline": "the stages of a run",
    "batch": "many clips",
    "studio": "a page for all of it",
    "cli": "the commands",
    "gsplat_ops": "gsplat's operators",
    BENCHMARKS: "protocols, tables, worlds",
}
"""What is in each package, in a few words."""
BESIDE = ("gsplat_ops",)
"""What nothing of the chain needs: it stands beside it."""
STAGES = (
    ("input", "a video, images, DAVIS, a rig, NVIDIA ...", ""),
    ("coarse", "a small scene to look at meanwhile", "coarse/"),
    ("prepare", "ingest: frames, size, what is held out", "scene/frames, scene/heldout"),
    ("prepare", "priors: cameras, flow, masks, tracks, objects, depth", "scene/cameras.json, flow, masks, ..."),
    ("train", "first Gaussians, then steps", "training/, model/"),
    ("evaluate", "held-out frames and views, baselines", "evaluation/, metrics.json"),
    ("all_frames", "the final fit, with the held-out frames", "model_all_frames/"),
    ("render", "videos along camera paths, the report", "renders/, report.html"),
    ("on demand", "view, export, tracks, compare", "export/, viewer/"),
)
"""Name of the stage, what it does, and what it leaves in the folder of the run."""
STYLE = (
    ".d{font:13px system-ui,sans-serif}.d rect{fill:#2f5f7a;rx:5}.d .b{fill:#fff;font-weight:600}.d .s{fill:#dce7ee;font-size:11px}"
    ".d .o{fill:#7d8894;font-size:12px}.d path{stroke:#8a94a0;stroke-width:1.5;fill:none}.d .h{fill:#8a94a0;stroke:none}"
)
WIDE, HIGH, GAP_X, GAP_Y = 196, 44, 56, 34
"""Pixels of a box, and between two."""
MARGIN = 16
"""Pixels round all of them."""


def imports() -> dict[str, set[str]]:
    """Return which packages each package of ours imports, from its source; what is imported for types alone counts, too."""
    found: dict[str, set[str]] = {name: set() for name in SAYS}
    for path in sorted([*(SOURCE / "flowsplat").rglob("*.py"), *(SOURCE / BENCHMARKS).rglob("*.py")]):
        parts = path.relative_to(SOURCE).with_suffix("").parts
        package = BENCHMARKS if parts[0] == BENCHMARKS else parts[1]
        if package not in found:
            continue  # flowsplat/__init__.py, which shows what the others offer
        for target in _targets(ast.parse(path.read_text(encoding="utf-8"))):
            if target in found and target != package:
                found[package].add(target)
    return found


def _targets(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        for name in names:
            parts = name.split(".")
            if parts[0] == BENCHMARKS:
                yield BENCHMARKS
            elif parts[0] == "flowsplat" and len(parts) > 1:
                yield parts[1]


def without_detours(edges: Mapping[str, set[str]]) -> dict[str, set[str]]:
    """Return the edges without those that a longer way implies."""

    def reached(name: str) -> set[str]:
        return set().union(*({each} | reached(each) for each in edges[name]))

    return {
        name: {t for t in targets if not any(t in reached(other) for other in targets - {t})} for name, targets in edges.items()
    }


def levels(edges: Mapping[str, set[str]]) -> list[list[str]]:
    """Return the packages in rows: each below all that it imports."""
    depth: dict[str, int] = {}

    def find(name: str) -> int:
        if name not in depth:
            depth[name] = 1 + max((find(each) for each in edges[name]), default=-1)
        return depth[name]

    return [[name for name in edges if find(name) == level] for level in range(max(map(find, edges)) + 1)]


def draw_packages() -> str:
    """Return the SVG of the packages: what is imported stands above."""
    edges = without_detours(imports())
    rows = levels(edges)
    chain = [[name for name in row if name not in BESIDE] for row in rows]
    width = max(map(len, chain)) * (WIDE + GAP_X) + GAP_X
    places: dict[str, tuple[float, float]] = {}
    for level, row in enumerate(chain):
        # Each as near as it can be below what it imports, so that few lines cross.
        row = sorted(row, key=lambda name: _mean([places[each][0] for each in edges[name] if each in places], width / 2))
        left = (width - len(row) * (WIDE + GAP_X) + GAP_X) / 2
        for k, name in enumerate(row):
            places[name] = left + k * (WIDE + GAP_X), MARGIN + level * (HIGH + GAP_Y)
        places.update({name: (width, MARGIN + level * (HIGH + GAP_Y)) for name in rows[level] if name in BESIDE})
    width += WIDE + MARGIN
    body = []
    for name, targets in edges.items():
        x, y = places[name]
        for target in sorted(targets):
            to_x, to_y = places[target]
            body.append(_arrow(x + WIDE / 2 + _aside(x, to_x), y, to_x + WIDE / 2 + _aside(to_x, x), to_y + HIGH))
    body += [_box(*place, name, SAYS[name]) for name, place in places.items()]
    return _svg("The packages, and which of them each imports", width, MARGIN + len(rows) * (HIGH + GAP_Y), body)


def draw_stages() -> str:
    """Return the SVG of the stages of a run, and of what each leaves."""
    wide, step = 400, HIGH + 22
    body = []
    for k, (name, says, leaves) in enumerate(STAGES):
        y = 12 + k * step
        if k:
            body.append(_arrow(12 + wide / 2, y - 22, 12 + wide / 2, y))
        body.append(_box(12, y, name, says, wide))
        if leaves:
            body.append(f'<text class="o" x="{wide + 28}" y="{y + HIGH / 2 + 4:g}">{html.escape(leaves)}</text>')
    return _svg("The stages of a run, and what each leaves in its folder", wide + 290, 12 + len(STAGES) * step, body)


def _mean(values: Sequence[float], otherwise: float) -> float:
    return sum(values) / len(values) if values else otherwise


def _aside(x: float, other: float) -> float:
    """Lines leave a box towards where they go, so that they can be told apart."""
    return max(-WIDE / 3, min(WIDE / 3, (other - x) / 8))


def _box(x: float, y: float, name: str, says: str, wide: float = WIDE) -> str:
    middle = x + wide / 2
    return (
        f'<rect x="{x:g}" y="{y:g}" width="{wide:g}" height="{HIGH}"/><g text-anchor="middle">'
        f'<text class="b" x="{middle:g}" y="{y + 18:g}">{html.escape(name)}</text>'
        f'<text class="s" x="{middle:g}" y="{y + 34:g}">{html.escape(says)}</text></g>'
    )


def _arrow(x: float, y: float, to_x: float, to_y: float) -> str:
    """A line with its head at the second point."""
    up = -1 if to_y < y else 1
    half = (y + to_y) / 2
    line = f"M{x:g} {y:g}C{x:g} {half:g} {to_x:g} {half:g} {to_x:g} {to_y - 6 * up:g}"
    return f'<path d="{line}"/><path class="h" d="M{to_x - 4:g} {to_y - 7 * up:g}h8L{to_x:g} {to_y:g}z"/>'


def _svg(title: str, width: float, height: float, body: Sequence[str]) -> str:
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" class="d" viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{title}">'
        f"<style>{STYLE}</style><title>{title}</title>\n" + "\n".join(body) + "\n</svg>\n"
    )


def main() -> None:
    """Write both."""
    (IMAGES / "packages.svg").write_text(draw_packages(), encoding="utf-8")
    (IMAGES / "stages.svg").write_text(draw_stages(), encoding="utf-8")


if __name__ == "__main__":
    main()
