"""Clients come and go for a long time, and the viewer stays as large as it was.

``pytest tests/output/viewer/test_soak.py --requests 10000`` takes many more requests, and says what memory they took.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
import urllib.request
from pathlib import Path

import numpy as np
import pytest

from tests.output.tiny import tiny_run

pytest.importorskip("viser", reason="viser is not installed: pip install 'flowsplat[view]'")

from tests.output.viewer.browser import Browser, free_port, heed_ctrl_c

pytestmark = pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory of a process is read on Linux only")

CLIENTS = 3
ORDINARY = 600
A_VISIT = 40
"""Requests of a client before it goes and another one comes."""
MOST_GROWTH = 48.0
"""MiB, from a fifth of the requests on to their end."""


def resident(process: int) -> float:
    """MiB."""
    text = Path(f"/proc/{process}/status").read_text()
    return next(int(line.split()[1]) / 1024 for line in text.splitlines() if line.startswith("VmRSS:"))


class Visitors:
    """Three at a time, until ``wanted`` requests were answered."""

    def __init__(self, port: int, wanted: int):
        self.port, self.left, self.answered, self.visits = port, wanted, 0, 0
        self.failed: list[str] = []
        self._lock = threading.Lock()
        self.threads = [threading.Thread(target=self._come_and_go, args=(number,), daemon=True) for number in range(CLIENTS)]
        for thread in self.threads:
            thread.start()

    def _come_and_go(self, number: int) -> None:
        rng = np.random.default_rng(number)
        try:
            while self._take(A_VISIT):
                with Browser(self.port) as browser:
                    browser.wait(lambda browser=browser: browser.images)
                    for k in range(A_VISIT):
                        self._ask(browser, rng, k)
        except Exception as error:
            self.failed.append(repr(error))

    def _take(self, count: int) -> bool:
        """Whether there is something left to ask."""
        with self._lock:
            if self.left <= 0:
                return False
            self.left -= count
            self.visits += 1
            return True

    def _ask(self, browser: Browser, rng: np.random.Generator, k: int) -> None:
        seen = len(browser.images)
        if k % 4:
            browser.look(position=browser.position + rng.normal(0, 0.05, 3))
        else:
            browser.set("Seconds", float(rng.uniform(0, 1)))
        browser.wait(lambda: len(browser.images) > seen)
        del browser.images[:-1], browser.depths[:-1]
        with self._lock:
            self.answered += 1


@pytest.mark.slow
def test_clients_that_come_and_go_leave_nothing_behind(tmp_path, request, capsys):
    wanted = request.config.getoption("--requests") or ORDINARY
    port, folder = free_port(), tiny_run(tmp_path / "out")
    process = subprocess.Popen(
        [sys.executable, "-m", "flowsplat.cli", "view", str(folder), "--port", str(port)], stderr=subprocess.PIPE, text=True,
        preexec_fn=heed_ctrl_c,
    )  # fmt: skip
    try:
        end = time.monotonic() + 90
        while time.monotonic() < end:
            try:
                urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=5).read()
                break
            except OSError:
                time.sleep(0.2)
        visitors, sizes = Visitors(port, wanted), []
        while any(thread.is_alive() for thread in visitors.threads):
            time.sleep(0.5)
            sizes.append((visitors.answered, resident(process.pid)))
        assert visitors.failed == []
        assert visitors.answered >= wanted
        early = max(size for answered, size in sizes if answered <= max(wanted / 5, sizes[0][0]))
        late = max(size for answered, size in sizes if answered >= wanted * 4 / 5)
        with capsys.disabled():
            print(f"\n{visitors.answered:,} requests, {visitors.visits} visits: {early:.0f} MiB early, {late:.0f} MiB late")
        assert late - early < MOST_GROWTH
    finally:
        process.send_signal(signal.SIGINT)
        _, told = process.communicate(timeout=60)
    assert "could not be made" not in told
    assert "Traceback" not in told
    assert process.returncode == 0
