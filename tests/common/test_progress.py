"""Progress on a terminal, in a pipe and in a notebook."""

from __future__ import annotations

import io
import re
import subprocess
import sys
import time

import pytest
from rich.console import Console

from flowsplat.common import progress
from flowsplat.common.progress import progress_bar, spinner, track

WORK = """
import time
from flowsplat.common import progress
progress.EVERY = 0.2
with progress.spinner("Cameras"):
    time.sleep(0.5)
    with progress.progress_bar("Training", 40, 10) as bar:
        for step in range(10, 40):
            time.sleep(0.02)
            bar.advance(1, f"PSNR {step}.00")
for _ in progress.track(range(3), "Frames"):
    pass
"""


def test_what_goes_on_as_one_shows_no_parts(capsys):
    with progress.as_one("Whole"):
        progress.report("Part.")
        for _ in track(range(2), "Parts"):
            pass
    progress.report("After.")
    assert capsys.readouterr().err.splitlines() == ["Whole ...", "After."]


def test_a_pipe_gets_a_line_now_and_then():
    done = subprocess.run([sys.executable, "-c", WORK], capture_output=True, text=True, check=True)
    assert done.stdout == ""
    lines = done.stderr.splitlines()
    assert [line for line in lines if line.endswith("...")] == ["Cameras ...", "Training ...", "Frames ..."]
    told = [line for line in lines if not line.endswith("...")]
    assert re.fullmatch(r"Cameras: 0\.[1-4] s so far", told[0])
    training = [re.fullmatch(r"Training: (\d+) of 40, \d\.\d s left  PSNR (\d+)\.00", line) for line in told if "Training" in line]
    assert len(training) >= 2
    assert all(match and 10 < int(match[1]) == int(match[2]) + 1 for match in training)
    assert len(lines) < 15, "and not more"


def test_bars_inside_others_are_drawn_together(monkeypatch):
    screen = io.StringIO()
    monkeypatch.setattr(progress, "console", Console(file=screen, force_terminal=True, width=100))
    with spinner("Cameras"):
        for _ in track(range(4), "Following points"):
            time.sleep(0.03)
        assert len(progress._shown) == 1
    assert progress._shown == []
    last = screen.getvalue().split("Cameras")[-1]
    assert "Following points" in last
    assert "4/4" in last
    assert "0/0" not in last


def test_a_bar_that_failed_leaves_nothing_behind():
    with pytest.raises(ZeroDivisionError), spinner("Cameras"), progress_bar("Training", 3):
        raise ZeroDivisionError
    assert progress._lines.bars == []


def test_a_notebook_shows_bars_that_move():
    jupyter = pytest.importorskip("jupyter_client", reason="needs a notebook kernel: ipykernel and ipywidgets")
    pytest.importorskip("ipykernel", reason="needs a notebook kernel: ipykernel and ipywidgets")
    pytest.importorskip("ipywidgets", reason="needs a notebook kernel: ipykernel and ipywidgets")
    kernel, client = jupyter.manager.start_new_kernel()
    messages: list[dict] = []
    try:
        client.execute_interactive(WORK, timeout=60, output_hook=messages.append)
    finally:
        client.stop_channels()
        kernel.shutdown_kernel(now=True)
    assert not [message for message in messages if message["msg_type"] == "error"], messages
    shown = [message["content"]["data"] for message in messages if message["msg_type"] == "display_data"]
    assert any("application/vnd.jupyter.widget-view+json" in data for data in shown)
    drawn = [data.get("text/plain", "") for data in shown]
    assert any(re.search(r"Training .*3\d/40.*PSNR", text) for text in drawn), drawn[-3:]
    assert not any("of 40" in text for text in drawn), "no lines where bars move"
