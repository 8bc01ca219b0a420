"""The sheet on how to film: served by the studio, linked from its start page, and as large as a phone."""

from __future__ import annotations

from pathlib import Path

from flowsplat.studio.handlers import ASSETS, SHEET
from tests.studio.serving import Page


def test_the_start_page_links_it_and_it_runs_nothing(page: Page):
    assert f'href="/{SHEET}"' in page.get("/").decode()
    status, sheet, headers = page.ask("GET", f"/{SHEET}")
    assert status == 200
    assert b"How to film it" in sheet
    policy = headers["Content-Security-Policy"]
    assert "sandbox" in policy
    assert "script-src" not in policy
    assert "default-src 'none'" in policy
    assert b"<script" not in sheet
    assert b"://" not in sheet, "it asks nobody for anything"


def test_it_fits_on_a_phone_(chromium):
    page = chromium.new_page(viewport={"width": 390, "height": 844})
    page.goto((Path(ASSETS) / SHEET).as_uri())
    width, height = page.evaluate("[document.documentElement.scrollWidth, document.querySelector('main').offsetHeight]")
    assert width == 390
    assert height <= 844, "all of it without scrolling"
    page.close()
