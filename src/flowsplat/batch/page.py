"""The result of a batch: ``OUT/batch.json`` and ``OUT/index.html``."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePath
from typing import Any
from urllib.parse import quote

from markupsafe import Markup

from flowsplat import __version__
from flowsplat.batch.records import FOLDER, Record, Records
from flowsplat.common.durations import format_duration
from flowsplat.common.files import write_json
from flowsplat.output.page import script_policy, write_page

NAME, DATA = "index.html", "batch.json"
WORDS = {
    "done": "done", "failed": "failed", "refused": "refused", "open": "to be continued", "running": "running", "waiting": "waiting",
}  # fmt: skip

SCRIPT = """
const rows = [...document.querySelectorAll('tbody tr')], body = document.querySelector('tbody');
const chosen = document.getElementById('show'), words = document.getElementById('words'), count = document.getElementById('count');
function filter() {
  const text = words.value.toLowerCase();
  let shown = 0;
  for (const row of rows) {
    const fits = !chosen.value || row.dataset.state === chosen.value || row.dataset.grade === chosen.value;
    row.hidden = !fits || !row.textContent.toLowerCase().includes(text);
    shown += !row.hidden;
  }
  count.textContent = `${shown} of ${rows.length}`;
}
chosen.addEventListener('input', filter);
words.addEventListener('input', filter);
const value = (row, k) => row.cells[k].dataset.value ?? row.cells[k].textContent;
document.querySelectorAll('thead th').forEach((head, k) => head.firstElementChild?.addEventListener('click', () => {
  const up = head.getAttribute('aria-sort') !== 'ascending', number = head.dataset.kind === 'number';
  for (const other of head.parentNode.children) other.removeAttribute('aria-sort');
  head.setAttribute('aria-sort', up ? 'ascending' : 'descending');
  const nothing = (text) => number && text === '';
  rows.sort((a, b) => {
    const x = value(a, k), y = value(b, k);
    if (nothing(x) || nothing(y)) return nothing(x) - nothing(y);
    return (up ? 1 : -1) * (number ? x - y : x.localeCompare(y));
  });
  body.append(...rows);
}));
for (const link of document.querySelectorAll('.thumb[data-video]')) {
  let video;
  const play = () => {
    video ??= Object.assign(document.createElement('video'), { muted: true, loop: true, playsInline: true });
    video.src ||= link.dataset.video;
    link.append(video);
    video.play().catch(() => {});
  };
  const rest = () => { video?.pause(); video?.remove(); };
  link.addEventListener('pointerenter', play);
  link.addEventListener('focus', play);
  link.addEventListener('pointerleave', rest);
  link.addEventListener('blur', rest);
}
filter();
"""


def write_results(out: Path, records: Records, wanted: Mapping[str, str], running: Mapping[str, str]) -> list[dict[str, Any]]:
    """Write both.

    Args:
        wanted: the input of every clip of the batch by its id, in their order; records of others come behind them.
        running: who works on what, by id.

    Returns:
        the records as ``batch.json`` holds them: ``id``, ``input``, ``state`` (done, failed, refused, open: was begun and is to be
        continued; running; waiting), ``reason``, ``attempts``, ``crashes``, ``fewer_gaussians``, ``seconds``,
        ``peak_memory_gib`` and what ``run_clip`` returned.

    Raises:
        InputError: they cannot be written.
    """
    states = records.states()
    names = [*wanted, *sorted(set(states) - set(wanted))]
    clips = [_entry(name, wanted.get(name), records.read(name) if name in states else None, running.get(name)) for name in names]
    counts = Counter(clip["state"] for clip in clips)
    written = time.strftime("%Y-%m-%dT%H:%M:%S%z")
    value = {"version": 1, "flowsplat": __version__, "written": written, "counts": dict(counts), "clips": clips}
    write_json(Path(out) / DATA, value)
    grades = Counter(clip["grade"] for clip in clips if clip.get("grade"))
    write_page(
        Path(out) / NAME, "batch.html.jinja", policy=script_policy(SCRIPT), script=Markup(SCRIPT), title="Batch",
        verdict=summary(counts),
        rows=[_row(Path(out), clip) for clip in clips], states=[(state, WORDS[state], count) for state, count in counts.items()],
        grades=[(name, f"{name} than interpolation" if name != "even" else "as good as interpolation", grades[name])
                for name in ("better", "even", "worse") if grades[name]],
        written=written, time=_time(clips), fewer=sum(1 for clip in clips if clip["fewer_gaussians"]),
    )  # fmt: skip
    return clips


def summary(counts: Mapping[str, int]) -> str:
    """Return how far a batch is, in a sentence.

    >>> summary({"done": 38, "refused": 2})
    '38 of 40 clips are done, 2 refused.'
    """
    total, done = sum(counts.values()), counts.get("done", 0)
    others = [f"{counts[state]} {WORDS[state]}" for state in WORDS if state != "done" and counts.get(state)]
    return f"{', '.join([f'{done} of {total} clips are done', *others])}."


def _entry(name: str, source: str | None, record: Record | None, who: str | None) -> dict[str, Any]:
    state = "waiting" if record is None else record["state"]
    if who is not None and state in ("waiting", "open"):
        state = "running"
    found: dict[str, Any] = {"id": name, "input": source, "state": state, "reason": "", "attempts": 0, "crashes": 0,
                             "fewer_gaussians": False, "seconds": None, "peak_memory_gib": None}  # fmt: skip
    if who is not None:
        found["worker"] = who
    if record is not None:
        found |= {"reason": record["reason"], "attempts": record["attempt"], "crashes": record["crashes"],
                  "fewer_gaussians": record["fewer"], "seconds": record["seconds"],
                  "peak_memory_gib": record.get("peak_memory_gib"), **record["result"]}  # fmt: skip
    return found


def _time(clips: Sequence[Mapping[str, Any]]) -> str:
    seconds = [clip["seconds"] for clip in clips if clip["state"] == "done" and clip["seconds"]]
    return f"{format_duration(sum(seconds) / len(seconds))} a clip" if seconds else ""


def _row(out: Path, clip: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the template needs of a clip; addresses are relative to OUT."""

    def address(place: Any) -> str | None:
        return quote(str(place)) if place and (out / str(place)).exists() else None

    name, is_done = clip["id"], clip["state"] == "done"
    return {
        # Without the folders of this machine: a page is made to be shown.
        "input": PurePath(clip["input"] or "").name,
        **{key: clip.get(key) for key in ("id", "state", "psnr", "ssim", "gaussians", "seconds", "peak_memory_gib")},
        "grade": clip.get("grade") or "", "word": WORDS[clip["state"]], "fewer": clip["fewer_gaussians"],
        "text": clip.get("verdict") if is_done else clip["reason"], "attempts": clip["attempts"],
        "time": format_duration(clip["seconds"]) if clip["seconds"] else "",
        "thumb": address(clip.get("thumb")), "video": address(clip.get("video")), "report": address(f"{name}/report.html"),
        "priors": address(f"{name}/priors.html"), "log": address(f"{FOLDER}/logs/{name}.log"), "uploaded": clip.get("uploaded"),
    }  # fmt: skip
