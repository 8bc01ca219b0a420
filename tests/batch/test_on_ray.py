"""Work on a Ray cluster of several nodes on this machine, one of which is lost."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from flowsplat.batch.on_ray import OnRay
from flowsplat.batch.records import Records
from flowsplat.batch.scheduler import Scheduler
from flowsplat.batch.work import Job
from flowsplat.common.errors import InputError
from flowsplat.common.files import Claims
from tests.batch.helpers import Deed

TOP = str(Path(__file__).parents[2])


@pytest.fixture
def cluster() -> Iterator[Any]:
    """A head without cores and two nodes with one each."""
    ray = pytest.importorskip("ray", reason="Ray is not installed: nothing was tested on a cluster (pip install 'flowsplat[ray]')")
    from ray.cluster_utils import Cluster

    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    store = {"object_store_memory": 80 * 2**20}
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False, **store})
    made.nodes = [made.add_node(num_cpus=1, **store) for _ in range(2)]
    paths = os.pathsep.join([TOP, *(path for path in sys.path if path)])
    ray.init(address=made.address, log_to_driver=False, runtime_env={"env_vars": {"PYTHONPATH": paths}})
    yield made
    ray.shutdown()
    made.shutdown()


def scheduler(out: Path, work: list[Job], engine: OnRay) -> Scheduler:
    return Scheduler(work, engine, Records(out), Claims(out / "claims"))


@pytest.mark.slow
def test_every_way_to_end_and_a_node_that_is_lost(cluster, tmp_path):
    (tmp_path / "logs").mkdir()
    deeds = {how: Deed(how, tmp_path, how) for how in ("done", "refused", "wrong", "killed")}
    work = [Job(how, "k", deed) for how, deed in deeds.items()]
    states = scheduler(tmp_path, work, OnRay(tmp_path / "logs")).run()
    assert states == {"done": "done", "refused": "refused", "wrong": "failed", "killed": "failed"}
    assert Records(tmp_path).read("refused")["reason"] == "a.mp4 is no film."
    assert len(deeds["refused"].begun()) == 2, "asked what it needs, and begun"
    assert len(deeds["killed"].begun()) == 2 * 4
    assert Records(tmp_path).read("done")["result"]["threads"] == "1"
    assert "a mistake of ours" in (tmp_path / "logs" / "wrong.log").read_text()
    # A node is lost while both are at work.
    naps = [Deed("dozes", tmp_path, f"clip-{k}") for k in range(4)]
    engine = OnRay(tmp_path / "logs")
    going = scheduler(tmp_path, [Job(deed.name, "k", deed) for deed in naps], engine)
    ends, removed = time.monotonic() + 120, False
    while not going._is_over() and time.monotonic() < ends:
        going._step()
        if not removed and sum(len(deed.begun()) >= 2 for deed in naps) >= 2:
            cluster.remove_node(cluster.nodes[0], allow_graceful=False)
            removed = True
    assert removed
    assert going.ended == {deed.name: "done" for deed in naps}
    records = [Records(tmp_path).read(deed.name) for deed in naps]
    assert max(record["attempt"] for record in records) > 1
    assert sum(record["orphaned"] for record in records) > 0
    assert all(record["crashes"] == 0 for record in records), "that a machine is lost says nothing about a clip"
    going._claims.close()


@pytest.mark.slow
def test_asked_to_stop(cluster, tmp_path):
    (tmp_path / "logs").mkdir()
    engine, deed = OnRay(tmp_path / "logs"), Deed("sleeps", tmp_path)
    engine.start(Job("a", "k", deed), fewer=False)
    ends = time.monotonic() + 60
    while len(deed.begun()) < 2 and time.monotonic() < ends:
        assert engine.wait(0.2) == []
    assert [each.outcome.how for each in engine.stop()] == ["stopped"]
    assert engine.list_running() == []


def test_without_ray_it_is_a_line(tmp_path):
    program = "import sys; sys.modules['ray'] = None\nfrom flowsplat.batch.on_ray import OnRay\nOnRay(None)"
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert "needs Ray: pip install" in ended.stderr
    with pytest.raises(InputError, match="--workers"):
        OnRay(tmp_path, workers=0)
