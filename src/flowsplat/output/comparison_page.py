"""``compare.html``: runs beside each other, in one file that needs neither a network nor their folders."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from markupsafe import Markup

from flowsplat.common.files.opening import read_bytes
from flowsplat.images.html import NOTHING, image_tag, shrink_to_page, table
from flowsplat.output.page import POLICY, script_policy, write_page
from flowsplat.output.report import Comparison, video_title

MAX_VIDEO_BYTES = 256 * 2**20
"""Bytes of a video; those of a run at the usual size have 5 to 20 MiB. Chosen by eye."""

_TYPES = {".mp4": "video/mp4", ".webm": "video/webm"}
"""What a page can play; an animated image cannot be paused."""

_SHOWN_IMAGES = 2
"""Held-out images of each kind. Chosen by eye."""

SCRIPT = """
const chosen = document.getElementById('path'), play = document.getElementById('play'), bar = document.getElementById('bar');
const speed = document.getElementById('speed'), clock = document.getElementById('clock');
const groups = [...document.querySelectorAll('.group')];
let films = [], leader, frame = 1 / 24, playing = false;
const middle = (t) => (Math.floor(t / frame + 1e-6) + 0.5) * frame;
function seek(t) {
  for (const film of films) film.currentTime = Math.min(Math.max(t, 0), Math.max(film.duration - frame / 2, 0));
  show(t);
}
function show(t) {
  bar.value = t;
  clock.textContent = `${t.toFixed(2)} s`;
}
function setPlaying(on) {
  if (!leader || on === playing) return;
  playing = on;
  play.textContent = on ? 'Pause' : 'Play';
  if (on) {
    if (leader.ended || leader.currentTime > leader.duration - frame) seek(0);
    for (const film of films) film.play().catch(() => {});
    requestAnimationFrame(keepInStep);
  } else {
    for (const film of films) film.pause();
    seek(middle(leader.currentTime));
  }
}
function keepInStep() {
  if (!playing) return;
  const t = leader.currentTime;
  for (const film of films) {
    const wanted = Math.min(t, film.duration);
    if (film !== leader && !film.seeking && Math.abs(film.currentTime - wanted) > frame) film.currentTime = wanted;
  }
  if (leader.ended) {
    seek(0);
    for (const film of films) film.play().catch(() => {});
  } else {
    show(t);
  }
  requestAnimationFrame(keepInStep);
}
function choose() {
  setPlaying(false);
  leader = undefined;
  for (const group of groups) group.hidden = group.dataset.name !== chosen.value;
  const group = groups.find((each) => !each.hidden);
  films = [...group.querySelectorAll('video')];
  frame = 1 / Number(group.dataset.fps);
  const ready = () => {
    if (leader || films.some((film) => film.readyState < 1)) return;
    leader = films.reduce((one, other) => (other.duration > one.duration ? other : one));
    bar.max = leader.duration;
    bar.step = frame;
    setSpeed();
    seek(frame / 2);
  };
  for (const film of films) film.addEventListener('loadedmetadata', ready);
  ready();
}
function setSpeed() {
  for (const film of films) film.playbackRate = Number(speed.value);
}
if (groups.length) {
  play.addEventListener('click', () => setPlaying(!playing));
  speed.addEventListener('input', setSpeed);
  chosen.addEventListener('input', choose);
  bar.addEventListener('input', () => {
    setPlaying(false);
    if (leader) seek(middle(Number(bar.value)));
  });
  document.addEventListener('keydown', (event) => {
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (event.target.closest('button, select, input, summary, a') && event.target !== bar) return;
    if (event.key === ' ') setPlaying(!playing);
    else if (step && leader) { setPlaying(false); seek(middle(leader.currentTime) + step * frame); }
    else return;
    event.preventDefault();
  });
  choose();
}
"""


@dataclass(frozen=True)
class ComparedRun:
    """A run on the page.

    Attributes:
        label: what it is called there; no two are called the same.
        verdict: how good it is, in words.
        metrics: the content of ``metrics.json``.
        settings: by the names of the command line.
        folder: where its videos are.
        videos: names of their files by name, as ``output.videos.list_rendered`` tells them.
        frame_rates: of its videos, as ``output.videos.list_frame_rates`` tells them.
    """

    label: str
    verdict: str
    metrics: Mapping[str, Any]
    settings: Mapping[str, Any]
    folder: Path
    videos: Mapping[str, str]
    frame_rates: Mapping[str, float]


@dataclass(frozen=True)
class ComparedFigure:
    """A figure of every run.

    Attributes:
        label: what was measured.
        values: of every run as text, None where it was not measured.
        best: which of them are the best.
    """

    label: str
    values: Sequence[str | None]
    best: Sequence[int]


def write_comparison(
    path: Path, runs: Sequence[ComparedRun], *, figures: Sequence[ComparedFigure], is_same_clip: bool,
    images: Sequence[Sequence[Comparison]] = (),
) -> None:  # fmt: skip
    """Write the page. Videos that at least two of the runs have are in it, and play in step.

    Args:
        path: of the page.
        runs: two or more.
        figures: one row each.
        is_same_clip: whether the figures are of the same images.
        images: of every run the held-out images and their renderings; those that all have are shown.

    Raises:
        InputError: a video cannot be read, or the page cannot be written.
    """
    labels = [run.label for run in runs]
    videos = list(_videos(runs))
    write_page(
        path, "compare.html.jinja", policy=script_policy(SCRIPT) if videos else POLICY, script=Markup(SCRIPT),
        title=" · ".join(labels),
        verdict="" if is_same_clip else "These runs are of different frames: their figures cannot be compared one to one.",
        runs=runs, videos=videos, figures=_figures_table(labels, figures), settings=_settings(labels, runs),
        images=list(_images(labels, images)),
    )  # fmt: skip


def _videos(runs: Sequence[ComparedRun]) -> Iterator[dict[str, Any]]:
    """Yield the videos of one name of those runs that have it, color alone where that is there."""
    for name in dict.fromkeys(name for run in runs for name in run.videos if not name.endswith("_color")):
        having = [run for run in runs if name in run.videos]
        files = {run.label: run.folder / run.videos.get(f"{name}_color", run.videos[name]) for run in having}
        shown = {label: file for label, file in files.items() if _can_be_shown(file)}
        if len(shown) > 1:
            films = [{"label": label, "address": _address(file)} for label, file in shown.items()]
            rate = max(run.frame_rates[name] for run in having)
            yield {"name": name, "title": video_title(name), "films": films, "fps": rate}


def _can_be_shown(file: Path) -> bool:
    """Return whether it is a film that lies where its run says: whatever a link leads to would be in a page that is made to be
    shared."""
    return file.suffix in _TYPES and file.is_file() and file.resolve().parent == file.parent.resolve()


def _address(file: Path) -> str:
    return f"data:{_TYPES[file.suffix]};base64,{base64.b64encode(read_bytes(file, MAX_VIDEO_BYTES)).decode()}"


def _figures_table(labels: Sequence[str], figures: Sequence[ComparedFigure]) -> Markup:
    rows: list[list[str]] = []
    for figure in figures:
        cells = [NOTHING if value is None else value for value in figure.values]
        rows.append([figure.label, *(Markup("<b>{}</b>").format(c) if k in figure.best else c for k, c in enumerate(cells))])
    return table(("", *labels), rows)


def _settings(labels: Sequence[str], runs: Sequence[ComparedRun]) -> Markup | None:
    """Return those that are not the same in all runs; None where there are none."""
    names = dict.fromkeys(name for run in runs for name in run.settings)
    values = {name: [run.settings.get(name) for run in runs] for name in names}
    differing = {name: found for name, found in values.items() if any(value != found[0] for value in found[1:])}
    rows = [(name, *map(_text, found)) for name, found in differing.items()]
    return table(("setting", *labels), rows) if rows else None


def _text(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return {None: "none", True: "yes", False: "no"}[value]
    return " ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)


def _images(labels: Sequence[str], images: Sequence[Sequence[Comparison]]) -> Iterator[dict[str, Any]]:
    """Yield a row for each held-out image that all runs have: the image and what each made of it."""
    if not images:
        return
    renderings = [{each.label: each.rendering for each in of_run} for of_run in images]
    count = dict[str, int]()
    for label, image, _ in sorted(images[0], key=lambda each: each.label):
        kind = label.rsplit(" ", 1)[0]
        if all(label in found for found in renderings) and count.get(kind, 0) < _SHOWN_IMAGES:
            count[kind] = count.get(kind, 0) + 1
            shown = [("clip", image), *zip(labels, (found[label] for found in renderings), strict=True)]
            panels = [{"name": name, "image": image_tag(shrink_to_page(each), f"{label}, {name}")} for name, each in shown]
            yield {"label": label, "panels": panels}
