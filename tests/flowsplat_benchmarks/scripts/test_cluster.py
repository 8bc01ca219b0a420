"""The simulated cluster in small: workers that die at random lose nothing, and no two are ever at work on one clip."""

from __future__ import annotations

import pytest

from flowsplat_benchmarks.scripts.cluster import simulate

pytest.importorskip("fcntl", reason="its workers are killed by SIGKILL")


def test_workers_that_die_lose_nothing_and_do_nothing_twice(tmp_path):
    found = simulate(tmp_path / "out", clips=80, workers=8, seconds=0.1, deaths=0.1, beat=0.3, lost=3.0, poll=0.5)
    assert found["workers that died"] > 0
    assert (found["done"], found["not done"], found["done twice"], found["two at work at a time"]) == (80, 0, 0, 0)
    assert found["attempts"] == 80 + found["workers that died"]
    assert found["claims left"] == 0
    assert found["calls to the folder a clip"] < 200
