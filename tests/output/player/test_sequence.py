"""The page of several shots: each is the player's own page, and they play one after the other."""

from __future__ import annotations

import html
import re
import time

import pytest

from flowsplat.output.player.sequence import write_sequence
from tests.browser import Complaints
from tests.output.small import small_model, small_player

NAMES = ["01 (0.00 to 2.00 s)", "02 (2.50 to 4.50 s)", "03 </script> & more"]


@pytest.fixture
def pages(tmp_path):
    small_player(tmp_path / "one.html", small_model(), "one </script> scene")
    page = (tmp_path / "one.html").read_text(encoding="utf-8")
    return [page, page, page]


def test_the_page_holds_the_page_of_every_shot_and_asks_for_nothing(pages, tmp_path):
    path = write_sequence(tmp_path / "all.html", pages, NAMES, "a <clip>")
    text = path.read_text(encoding="utf-8")
    policy = html.unescape(re.findall(r'Content-Security-Policy" content="(.*?)"', text)[0])
    assert len(text) > 3 * len(pages[0])
    assert "<title>a &lt;clip&gt;</title>" in text
    assert "03 &lt;/script&gt; &amp; more" in text
    assert "default-src 'none'" in policy
    assert policy.count("'sha256-") == 2


def wait_until(page, condition: str, seconds: float = 90) -> None:
    """The page's policy forbids playwright's own waiting, which evaluates strings."""
    end = time.monotonic() + seconds
    while not page.evaluate(f"Boolean({condition})"):
        assert time.monotonic() < end, condition
        page.wait_for_timeout(50)


def test_shots_play_one_after_the_other_in_a_real_browser(pages, tmp_path, chromium):
    path = write_sequence(tmp_path / "all.html", pages, NAMES, "clip")
    context = chromium.new_context(offline=True, viewport={"width": 480, "height": 400})
    try:
        page = context.new_page()
        complaints, requests = Complaints(page), list[str]()
        page.on("request", lambda request: requests.append(request.url))
        page.goto(path.as_uri())
        state = "sequence.frame?.contentWindow?.flowsplat?.state"
        wait_until(page, f"{state} && sequence.next?.contentWindow?.flowsplat?.state")
        wait_until(page, "sequence.frame.contentDocument.body.classList.contains('shown')")
        assert page.evaluate("sequence.number") == 0
        assert page.evaluate(f"{state}.isPlaying")
        assert not page.evaluate("sequence.next.contentWindow.flowsplat.state.isPlaying")
        page.evaluate(f"{state}.setTime(0.97)")
        # One after the other no longer, before this one ends.
        wait_until(page, f"sequence.number === 1 && {state} && (document.getElementById('in-turn').checked = false, true)")
        assert page.evaluate(f"{state}.isPlaying")
        assert page.locator("button[aria-pressed=true]").inner_text() == f"Shot {NAMES[1]}"
        assert page.locator("iframe:not(.waiting)").count() == 1

        # Now it begins again, until a person chooses a shot.
        page.evaluate(f"{state}.setTime(0.97)")
        wait_until(page, f"{state}.time < 0.5")
        assert page.evaluate("sequence.number") == 1
        page.click("button[data-number='0']")
        wait_until(page, f"sequence.number === 0 && {state}")
        wait_until(page, "sequence.frame.contentDocument.body.classList.contains('shown')")
        assert complaints == []
        assert [url for url in requests if not url.startswith(("file:", "blob:", "data:", "about:"))] == []
    finally:
        context.close()
