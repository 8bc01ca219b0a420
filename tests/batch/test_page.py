"""The page of a batch, in a real browser."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flowsplat.batch.page import write_results
from flowsplat.batch.records import Outcome, Records, after_attempt
from flowsplat.images.video import write_mp4
from flowsplat.scenes.layers import write_image
from tests.browser import Complaints

NASTY = '<b onclick="x">&\''


@pytest.fixture
def out(tmp_path) -> Path:
    records = Records(tmp_path)
    for k, (how, psnr) in enumerate([("done", 30.5), ("done", 9.25), ("refused", None), ("done", 100.0)]):
        name, image = f"clip-{k}", np.full((48, 64, 3), 60 * k, np.uint8)
        result = {}
        if how == "done":
            write_image(tmp_path / ".batch" / "thumbs" / f"{name}.png", image)
            write_mp4(tmp_path / name / "renders" / "input path.mp4", [image] * 12, 24)
            (tmp_path / name / "report.html").write_text("report")
            result = {
                "psnr": psnr, "ssim": 0.9, "gaussians": 1000 * k, "grade": "better" if k else "worse", "verdict": NASTY,
                "thumb": f".batch/thumbs/{name}.png", "video": f"{name}/renders/input path.mp4",
            }  # fmt: skip
        records.write(after_attempt(None, name, "k", 1, Outcome(how, "no film" if psnr is None else "", result, 10.0 * k, 1.0)))
    wanted = {f"clip-{k}": f"/trip/{NASTY}{k}.mp4" for k in range(5)}
    entries = write_results(tmp_path, records, wanted, {"clip-4": "process 3 on host"})
    assert [entry["state"] for entry in entries] == ["done", "done", "refused", "done", "running"]
    return tmp_path


def test_it_sorts_filters_and_plays(chromium, out):
    page = chromium.new_context().new_page()
    complaints = Complaints(page)
    page.goto((out / "index.html").as_uri())

    def shown() -> list[str]:
        rows = "[...document.querySelectorAll('tbody tr')].filter((r) => !r.hidden)"
        return page.evaluate(f"{rows}.map((r) => r.cells[1].dataset.value)")

    assert shown() == [f"clip-{k}" for k in range(5)]
    head = "[...document.querySelectorAll('thead button')].find((b) => b.textContent === 'PSNR').click()"
    page.evaluate(head)
    assert shown() == ["clip-1", "clip-0", "clip-3", "clip-2", "clip-4"], "by number; what has none is last"
    page.evaluate(head)
    assert shown() == ["clip-3", "clip-0", "clip-1", "clip-2", "clip-4"]
    choose = "const s = document.getElementById('show'); s.value = '{}'; s.dispatchEvent(new Event('input'))"
    for value, left in (("refused", ["clip-2"]), ("worse", ["clip-0"]), ("running", ["clip-4"])):
        page.evaluate(f"() => {{ {choose.format(value)} }}")
        assert shown() == left
    assert page.evaluate("document.getElementById('count').textContent") == "1 of 5"
    page.evaluate(f"() => {{ {choose.format('')} }}")
    page.evaluate("() => { const w = document.getElementById('words'); w.value = 'FILM'; w.dispatchEvent(new Event('input')) }")
    assert shown() == ["clip-2"]
    page.evaluate("() => { const w = document.getElementById('words'); w.value = ''; w.dispatchEvent(new Event('input')) }")
    page.evaluate("document.querySelector('.thumb').dispatchEvent(new PointerEvent('pointerenter'))")
    for _ in range(100):
        if page.evaluate("(document.querySelector('.thumb video')?.currentTime ?? 0) > 0"):
            break
        page.wait_for_timeout(50)
    assert page.evaluate("document.querySelector('.thumb video').currentTime") > 0
    page.evaluate("document.querySelector('.thumb').dispatchEvent(new PointerEvent('pointerleave'))")
    assert page.evaluate("document.querySelector('.thumb video')") is None
    assert page.evaluate("document.querySelector('.thumb img').naturalWidth") == 64
    assert page.evaluate("document.querySelector('td b')") is None, "names are text"
    assert complaints == []
    page.context.close()


def test_nothing_else_runs_or_is_fetched(chromium, out):
    text = (out / "index.html").read_text()
    at = text.index("<main>") + len("<main>")
    beside = '<script>window.bad = true</script><img src="x" onerror="window.worse = true">'
    (out / "index.html").write_text(text[:at] + beside + text[at:])
    page = chromium.new_context().new_page()
    page.goto((out / "index.html").as_uri())
    page.wait_for_timeout(200)
    assert page.evaluate("window.bad === undefined && window.worse === undefined")
    tried = page.evaluate("fetch('http://127.0.0.1:9/').then(() => 'done', (e) => String(e))")
    assert "Failed to fetch" in tried or "Content Security" in tried
    assert page.evaluate("document.getElementById('count').textContent") == "5 of 5", "our own script runs"
    page.context.close()
